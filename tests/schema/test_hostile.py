"""Values that a layer may state against the schema, by their type or their size, are refused in one line."""

import json
import os
import re
import subprocess
import sys

import pytest
from pxr import Usd

from beam_warp.errors import AssetFormatError, MissingFileError, SchemaVersionError
from beam_warp.schema.files import require_asset_file, size_around
from beam_warp.schema.reader import read_asset
from beam_warp.schema.stage_queries import MAX_HELD_FRAMES
from beam_warp.schema.writer import write_asset


@pytest.fixture
def text(tmp_path, sequence):
    """A sound asset of two frames as one text layer."""
    metadata = {"capture_frames": "0 1", "raster_low_pass": "0.3", "raster_antialiased": "true"}
    write_asset(sequence(2, metadata=metadata), tmp_path / "a.usda")
    Usd.Stage.Open(str(tmp_path / "a.usda")).Flatten().Export(str(tmp_path / "flat.usda"))
    return (tmp_path / "flat.usda").read_text()


def read_all(folder, text, old, new):
    """Replace the first match of a pattern, and read every frame of the result."""
    changed, count = re.subn(old, lambda _: new, text, count=1)
    assert count == 1
    (folder / "b.usda").write_text(changed)
    sequence = read_asset(folder / "b.usda", trusted=True)
    return [sequence[frame] for frame in range(len(sequence))]


COUNT, LOW_PASS = "int beam:sequence:frameCount = 2", "float beam:rasterLowPass = 0.3"
CAPTURE_FRAMES, OPACITY = r"int\[\] beam:sequence:captureFrames = \[0, 1\]", r"half\[\] opacitiesh = [^\n]*"
POSITIONS = r"point3f\[\] positions.timeSamples = {[^}]*}"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (COUNT, "int beam:sequence:frameCount = 2147483647", r"in \[1, 16384\] for 2 time samples, got 2147483647"),
        (COUNT, "int beam:sequence:frameCount = 1000000", r"in \[1, 16384\] for 2 time samples, got 1000000"),
        (COUNT, "int beam:sequence:frameCount = 0", r"in \[1, 16384\] for 2 time samples, got 0"),
        (COUNT, 'string beam:sequence:frameCount = "2"', r"b\.usda: .*frameCount must be of type int, got str"),
        (COUNT, "double beam:sequence:frameCount = 2", "frameCount must be of type int, got float"),
        (COUNT, "int[] beam:sequence:frameCount = [2]", "frameCount must be of type int, got IntArray"),
        (CAPTURE_FRAMES, "double beam:sequence:captureFrames = 1", "captureFrames must be of type IntArray, got float"),
        (LOW_PASS, 'string beam:rasterLowPass = "x"', "rasterLowPass must be of type float, got str"),
        ("metersPerUnit = 1", "metersPerUnit = 1e-300", r"metersPerUnit in \[1e-09, 1e\+16\], got 1e-300"),
        ("metersPerUnit = 1", "metersPerUnit = nan", r"metersPerUnit in \[1e-09, 1e\+16\], got nan"),
        ("timeCodesPerSecond = 24", "timeCodesPerSecond = 1e-320", r"got 9\.99.*e-321 from time 0"),
        ("timeCodesPerSecond = 24", "timeCodesPerSecond = inf", "got inf from time 0"),
        (POSITIONS, "point3f positions = (1, 2, 3)", r"positions must be point3f\[\], got Vec3f"),
        (POSITIONS, "point3d[] positions = [(1e300, 2, 3)]", "positions must be finite"),
        (OPACITY, "half opacitiesh = 1", r"opacitiesh must be float\[\], got float"),
        (OPACITY, 'string[] opacitiesh = ["a"]', "opacities must have 6 elements, got 1"),
    ],
)
def test_values_of_other_types_and_sizes(tmp_path, text, old, new, message):
    with pytest.raises(AssetFormatError, match=message):
        read_all(tmp_path, text, old, new)


def test_a_version_of_many_digits(tmp_path, text):
    with pytest.raises(SchemaVersionError, match=r"schema version 1\.3, got '1\.9{38}' at"):
        read_all(tmp_path, text, 'beam:schemaVersion = "1.3"', f'beam:schemaVersion = "1.{5000 * "9"}"')


@pytest.mark.parametrize(
    ("last", "x", "message"),
    [
        ("0", "1e300", "positions must be finite"),
        ("0.5", "0", r"a transform whose last column is \[0\.5, 0\.0, 0\.0, 1\.0\]"),
        ("0", "nan", "a transform whose last column is"),
    ],
)
def test_transforms_that_place_nothing(tmp_path, text, last, x, message):
    header = r'def ParticleField3DGaussianSplat "Splats"[^{]*{'
    rows = f"(1, 0, 0, {last}), (0, 1, 0, 0), (0, 0, 1, 0), ({x}, 0, 0, 1)"
    order = 'uniform token[] xformOpOrder = ["xformOp:transform"]'
    match = re.search(header, text)
    assert match is not None
    with pytest.raises(AssetFormatError, match=message):
        read_all(tmp_path, text, header, f"{match.group()}\nmatrix4d xformOp:transform = ({rows})\n{order}\n")


def test_frames_are_held_where_samples_end(tmp_path, text):
    clouds = read_all(tmp_path, text, COUNT, "int beam:sequence:frameCount = 4")
    assert len(clouds) == 4 < MAX_HELD_FRAMES
    assert (clouds[3].positions == clouds[1].positions).all()


LAYERS = {
    "sublayer": "#usda 1.0\n(\n  subLayers = [@./pipe.usda@]\n)\n",
    "reference": "#usda 1.0\n(\n  subLayers = [@./inner.usda@]\n)\n",
    "clip": """#usda 1.0
def Xform "A" (
    clips = {
        dictionary default = {
            asset[] assetPaths = [@./pipe.usda@]
            string primPath = "/A"
            double2[] active = [(0, 0)]
        }
    }
)
{
}
""",
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with names, as POSIX has them")
@pytest.mark.parametrize("kind", LAYERS)
def test_a_layer_that_is_a_pipe_is_not_waited_for(tmp_path, kind):
    """The probe runs in a child; a reader of a pipe without a writer never returns."""
    os.mkfifo(tmp_path / "pipe.usda")
    (tmp_path / "inner.usda").write_text('#usda 1.0\ndef Xform "A" (\n  prepend references = @pipe.usda@\n)\n{\n}\n')
    (tmp_path / "a.usda").write_text(LAYERS[kind])
    probe = [sys.executable, "-m", "beam_warp.schema.probe", str(tmp_path / "a.usda")]
    done = subprocess.run(probe, capture_output=True, text=True, timeout=60, check=True)
    assert json.loads(done.stdout)["error"] == f"{tmp_path / 'pipe.usda'}, which is no regular file"
    with pytest.raises(MissingFileError, match="got a folder, pipe or device"):
        require_asset_file(tmp_path / "pipe.usda")


@pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_DATA counts mapped memory on Linux")
def test_a_child_process_has_its_share_of_memory(tmp_path):
    (tmp_path / "a[1].usda").write_bytes(bytes(2**20))
    code = (
        "import sys; from pathlib import Path; from beam_warp.schema.probe import limit_memory\n"
        "limit_memory(Path(sys.argv[1])); import numpy\n"
        "numpy.ones(2**26); numpy.ones(2**27)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a[1].usda")], capture_output=True, text=True)
    assert done.returncode == 1
    assert "1.00 GiB" in done.stderr
    assert size_around(tmp_path / "a[1].usda") == 2**20
