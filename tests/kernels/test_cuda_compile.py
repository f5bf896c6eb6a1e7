"""Every kernel compiles for an H200 (sm_90), on machines without a GPU too.

The CPU compiler takes what NVRTC refuses: intrinsics of one side, overloads that only one side resolves, local arrays
that do not fit. Most changes are made and tested where there is no GPU, so without this such a change would break CUDA
unnoticed. It runs in two processes of its own, side by side.
"""

import importlib
import json
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

from beam_warp import kernels

pytestmark = pytest.mark.slow

MODULES = sorted(
    entry.name.removeprefix("beam_warp.kernels.")
    for entry in pkgutil.walk_packages(kernels.__path__, "beam_warp.kernels.")
    if not entry.ispkg
)

TRACING = {
    "trace.closest_surface",
    "materials.residues",
    "trace.surface_rays",
    "trace.visibility",
    "trace.visibility_adjoint",
}
"""Some of the modules that must have been compiled for every structure of occluders."""


COMPOSITES = ((4, False), (16, True))

RASTER = {
    "raster.composite_cuda": ("composite_cuda_kernel", (*COMPOSITES, (4, False, False), (16, True, True, 1))),
    "raster.composite_adjoint_cuda": ("composite_adjoint_cuda_kernel", COMPOSITES),
    "raster.back_projection_cuda": ("back_project_cuda_kernel", ((4,), (8,), (12,), (16,))),
}
"""Modules that make a kernel for each number of channels and mode of depth: by which function, some of them."""


def compile_all(folder, share):
    """Return {module: [kernels, error]} after compiling every second module under ``folder``, from the share-th on."""
    import warp as wp

    from beam_warp.kernels.common.launching import kernel_for
    from beam_warp.kernels.trace.occluders import OCCLUDER_TYPES

    found = {}
    for name, (function, choices) in list(RASTER.items())[1 - share :: 2]:
        maker = getattr(importlib.import_module(f"beam_warp.kernels.{name}"), function)
        try:
            local = 0
            for arguments in choices:
                (path,) = wp.compile_aot_module(maker(*arguments).module, arch=90, use_ptx=True, module_dir=folder)
                local += Path(path).read_text(encoding="utf-8", errors="ignore").count("__local_depot")
            found[name] = [len(choices), f"{local} uses of local memory" if local else ""]
        except Exception as error:  # reported by the module's own test
            found[name] = [0, f"{type(error).__name__}: {error}"]
    for name in MODULES[share::2]:
        module = importlib.import_module(f"beam_warp.kernels.{name}")
        own = [kernel for kernel in vars(module).values() if isinstance(kernel, wp.Kernel)]
        forms = [kernel_for(kernel, (type,)) for kernel in own if kernel.is_generic for type in OCCLUDER_TYPES]
        plain = [kernel for kernel in own if not kernel.is_generic and kernel.module.name == module.__name__]
        if not own:
            continue
        try:
            compiled = [*(form.module for form in forms), *([module] if plain else [])]
            paths = [path for each in compiled for path in wp.compile_aot_module(each, arch=90, module_dir=folder)]
            empty = any(Path(path).stat().st_size == 0 for path in paths)
            found[name] = [len(forms) + len(plain), "empty file" if empty else ""]
        except Exception as error:  # reported by the module's own test
            found[name] = [0, f"{type(error).__name__}: {error}"]
    return found


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sm_90")
    found, running = {}, []
    for share in ("0", "1"):
        (folder / share).mkdir()
        command = [sys.executable, __file__, folder / share, folder / f"{share}.json", share]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
    for share, process in enumerate(running):
        said, _ = process.communicate()
        result = folder / f"{share}.json"
        assert result.is_file(), said[-4000:]
        found |= json.loads(result.read_text())
    return found


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no CUDA compiler there")
@pytest.mark.parametrize("name", RASTER)
def test_the_rasterizer_keeps_its_sums_in_registers(compiled, name):
    """An array that is indexed by a loop which NVRTC does not unroll lies in local memory: 1.7 times as slow, once."""
    count, error = compiled[name]
    assert not error
    assert count == len(RASTER[name][1])


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no CUDA compiler there")
@pytest.mark.parametrize("name", [name for name in MODULES if name not in RASTER])
def test_compiles_for_sm_90(compiled, name):
    if name not in compiled:
        pytest.skip("holds no kernels of its own")
    count, error = compiled[name]
    assert not error
    assert count >= (2 if name in TRACING else 1)


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no CUDA compiler there")
def test_kernels_that_must_agree_round_every_operation(tmp_path):
    """No product is fused with a sum where pairs are counted and emitted: which one is depends on the kernel."""
    import warp as wp

    from beam_warp.kernels.raster import tile_lists_cuda

    module = tile_lists_cuda.emit_entries_kernel.module
    (path,) = wp.compile_aot_module(module, arch=90, use_ptx=True, module_dir=tmp_path)
    entries = Path(path).read_text(encoding="utf-8", errors="ignore").split(".entry ")
    for name in ("count_entries_kernel", "emit_entries_kernel"):
        (own,) = (entry for entry in entries if entry.startswith(name))
        assert "mul.rn.f32" in own
        assert not any(fused in own for fused in ("fma.rn.f32", "mul.f32", "add.f32"))


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(compile_all(sys.argv[1], int(sys.argv[3]))))
