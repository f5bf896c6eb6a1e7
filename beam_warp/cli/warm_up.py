"""``beam warm-up``: compile ahead, from the command line."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from beam_warp.cli.common.console import print_json
from beam_warp.cli.common.flags import Device, Json, Quiet


@dataclass(frozen=True)
class WarmUp:
    """Compile the kernels that jobs need, so that none of them waits for that.

    A small capture is made, reconstructed, decomposed and rendered, as `beam run` and `beam render` do, and thrown
    away. Compiled kernels stay in Warp's cache, which all processes of a user share; WARP_CACHE_PATH names another
    folder, such as one that machines of a cluster share. Once is enough for a version of the package and a kind of
    device.

    Example: beam warm-up
    """

    device: Device = None
    quiet: Quiet = False
    json: Json = False


def warm_up(args: WarmUp) -> int:
    """Run through the work, and say what was compiled."""
    import warp as wp

    from beam_warp.device.arrays import resolve_device

    device, started = resolve_device(args.device), time.perf_counter()
    cache = Path(wp.config.kernel_cache_dir)
    known = _modules(cache)
    with TemporaryDirectory() as name:
        _work(Path(name), str(device))
    found = {
        "cache": str(cache),
        "device": str(device),
        "compiled": len(_modules(cache) - known),
        "seconds": time.perf_counter() - started,
    }
    if args.json:
        print_json(found)
    elif not args.quiet:
        print(f"compiled {found['compiled']} kernel modules for {device} in {found['seconds']:.1f} s; see {cache}")
    return 0


def _modules(cache: Path) -> set[str]:
    """Return the names of what is compiled for any device."""
    return {str(path.relative_to(cache)) for path in cache.glob("*/*") if path.suffix in (".o", ".cubin", ".ptx")}


def _work(folder: Path, device: str) -> None:
    """Do a little of everything: both kinds of frames, materials and roughness, both renderers."""
    from beam_warp.decomposition.frames import ReconstructedFrames
    from beam_warp.decomposition.job import OverviewOptions, run_capture
    from beam_warp.decomposition.options import ESTIMATE, RunOptions
    from beam_warp.decomposition.work import MaterialWork
    from beam_warp.demo.capture import write_demo_capture
    from beam_warp.materials.direct import MaterialOptions
    from beam_warp.reconstruction.fit import FitOptions
    from beam_warp.reconstruction.job import ReconstructionWork
    from beam_warp.reconstruction.steps import FitAndTrack
    from beam_warp.reconstruction.track import TrackOptions
    from beam_warp.render.path import PathOptions, PathRenderer
    from beam_warp.world.camera import Camera
    from beam_warp.world.environment import EnvironmentMap
    from beam_warp.world.shot import Shot

    capture = write_demo_capture(
        folder / "capture", frame_count=2, camera_count=8, test_camera_count=0, size=64, samples=1, device=device
    )
    assert capture.environment_path is not None
    light = EnvironmentMap.read(capture.environment_path)
    few = {"gaussian_count": 1000, "color_iterations": 12, "normal_iterations": 12, "refine_every": 6}
    usual = TrackOptions()
    steps = FitAndTrack(
        fitting=FitOptions(**few),
        tracking=TrackOptions(refinement=FitOptions(**{**vars(usual.refinement), "normal_iterations": 6})),
        environment=light,
        device=device,
    )
    (folder / "out").mkdir()
    frames = ReconstructionWork.prepare(capture, folder / "out" / "reconstruction", steps, None)
    options = RunOptions(materials=MaterialOptions(sample_count=16), roughness=ESTIMATE, device=device)
    work = MaterialWork(folder / "out", ReconstructedFrames(frames, None), light, options)
    made = run_capture(frames, work, OverviewOptions(height=64), time.perf_counter()).result
    cloud = made.sequence[0]
    camera = Camera.frame_points(cloud.positions, azimuth=30.0, elevation=10.0, width=64, height=64)
    PathRenderer(PathOptions(samples=1), device=device).draw(Shot(cloud=cloud, camera=camera, environment=light))
