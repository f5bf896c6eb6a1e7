"""What the documentation shows runs, and does what it says."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
from support.drawn_ball import relightable

from beam_warp import converters
from beam_warp.image.files import write_exr
from beam_warp.stage import files
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import LIGHT_TYPES

DOCS = Path(__file__).parent.parent / "docs"


def blocks(page):
    """The Python examples of a page."""
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def standing_cloud(x):
    """Six relightable Gaussians on a frame that stands off the origin."""
    places = np.array([(i, 3.0 + j, 1.0 + k) for i in (x, x + 1.0) for j, k in ((0, 0), (1, 0.5), (0.5, 2))])
    normals = np.tile([0.0, -1.0, 0.0], (6, 1))
    return relightable(places, scales=np.full((6, 3), 0.1), normals=normals, ids=np.arange(6), axes="rfu")


def test_the_fit_of_the_rasterizer_page(capsys):
    """Every loss falls, and the numbers printed are about those of the page, which are a CPU's."""
    page = (DOCS / "rasterizing.md").read_text(encoding="utf-8")
    example = next(block for block in blocks("rasterizing.md") if "def step()" in block)
    exec(compile(example, "docs/rasterizing.md", "exec"), {})
    printed = [[float(word) for word in line.split()] for line in capsys.readouterr().out.splitlines()]
    shown = re.search(r"prints, on a CPU:\n\n```\n(.*?)```", page, re.DOTALL).group(1)
    expected = [[float(word) for word in line.split()] for line in shown.splitlines()]
    assert [row[0] for row in printed] == [row[0] for row in expected] == [0, 100, 200]
    assert printed[0] == expected[0]
    for start, end in zip(printed[0][1:], printed[-1][1:], strict=True):
        assert end < 0.2 * start


def test_the_example_of_the_tracking_page():
    """Joints that moved away from the middle by a tenth carry the skins along, and every force arrives at one."""
    scope = {}
    exec(compile(blocks("tracking.md")[0], "docs/tracking.md", "exec"), scope)
    length = (scope["moved"].numpy() ** 2).sum(axis=1) ** 0.5
    # x' = x + 0.1 sum w x_a: the mean of joints within 2 spacings of 0.16 lies at most 0.06 below the sphere of 0.8
    assert abs(length / 0.88 - 1.0).max() < 0.1 * 0.06 / 0.88
    assert scope["energy"].numpy()[0] > 0.0
    assert abs(scope["to_positions"].numpy().sum(axis=0) - 5000.0).max() < 0.1


def test_the_example_of_the_stages_page(tmp_path, monkeypatch, capsys, trusted_files):
    """The stage reads, and what it shows is what the page says of it."""
    clouds = [standing_cloud(0.1 * frame) for frame in range(4)]
    converters.write(GaussianSequence.from_clouds(clouds, frames_per_second=24.0), tmp_path / "walker.usdz")
    still = GaussianSequence.from_clouds(clouds[:1])
    converters.write(still, tmp_path / "statue.ply", converters.WriteOptions(profile="beam"))
    write_exr(tmp_path / "studio.exr", {name: np.ones((4, 8), np.float32) for name in "RGB"})
    (example,) = re.findall(r"```json\n(.*?)```", (DOCS / "stages.md").read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "stage.json").write_text(example.replace("studio.hdr", "studio.exr"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    scope = {}
    exec(compile(blocks("stages.md")[0], "docs/stages.md", "exec"), scope)
    stage, lines = scope["stage"], capsys.readouterr().out.splitlines()
    assert stage.frame_count == 96
    assert len(lines) == 97
    assert lines[0].startswith("0 12 [-2.  -4.   1.4] 45.0")
    shot = stage.shot(2.0, 640, 360)
    assert shot.environment_rotation == 75.0
    np.testing.assert_allclose(shot.camera.position, [0.0, -3.5, 1.2])
    np.testing.assert_allclose(shot.environment.radiance, 2.0**-0.5, rtol=1e-6)
    assert shot.mesh.catches_shadows.all()
    assert (shot.mesh.surface.vertices[:, 2] == 0.0).all()
    middle, lowest = shot.cloud.positions[6:, :2].mean(axis=0), shot.cloud.positions[6:, 2].min()
    np.testing.assert_allclose([*middle, lowest], [0.7, 0.2, 0.0], atol=1e-6)


def test_the_stages_page_lists_every_field():
    """The tables name the fields that are read, and no others."""
    sections = re.split(r"^##+ ", (DOCS / "stages.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    listed = {}
    for section in sections:
        cells = [line.split("|")[1:3] for line in section.splitlines() if line.startswith("| ")]
        listed[section.splitlines()[0]] = {
            name for pair in cells for cell in pair for name in re.findall(r"`([^`]+)`", cell)
        }
    assert listed["The format"] == {files.KEY, *files.FIELDS}
    assert listed["Assets"] - {"identified"} == set(files.ASSET_FIELDS)
    assert listed["Meshes"] - {'"auto"'} == {"ground", *files.MESH_FIELDS, *files.GROUND_FIELDS}
    assert listed["Environment"] == set(files.ENVIRONMENT_FIELDS)
    kinds = {"fixed", "orbit", "keyframes", "file"}
    cameras = {*files.FIXED_FIELDS, *files.ORBIT_FIELDS, *files.FILE_FIELDS, "interpolation"}
    assert listed["Camera"] == {*kinds, *cameras}
    for name, kind in LIGHT_TYPES.items():
        row = next(line for line in sections[-4].splitlines() if line.startswith(f"| `{name}`"))
        assert set(re.findall(r"`(\w+)`", row)) == {name, *(field.name for field in fields(kind))}
