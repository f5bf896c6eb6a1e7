"""What the documentation shows runs, and does what it says: every command is read, every Python example executed.

Pages that walk through the demo's output (`WALKS`) are executed line by line, commands included, on a smaller demo.
"""

import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.drawn_ball import drawn_ball, relightable, save
from support.fake_steps import FakeSteps, write_capture

import beam_warp
from beam_warp import converters, raster
from beam_warp.cli import convert, validate
from beam_warp.cli.common.pages import parse
from beam_warp.cli.main import COMMANDS, main
from beam_warp.demo import job
from beam_warp.demo.from_images import FromImagesOptions
from beam_warp.image.files import write_exr
from beam_warp.mesh import extract
from beam_warp.raster.records import RasterOptions
from beam_warp.schema import register
from beam_warp.stage import files
from beam_warp.stage.meshes import Ground
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import LIGHT_TYPES
from beam_warp.world.shot import Shot

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
SITE = SimpleNamespace(**runpy.run_path(str(DOCS / "gather_pages.py")))
PAGES = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in [*SITE.sources(), SITE.README]}

WALKS = ("docs/start.md", "docs/tutorials/splat.md", "docs/tutorials/capture.md", "docs/tutorials/sequence.md")
"""Pages whose every line is executed; the others go on from the first one."""

COMMAND = r"(?:^ {4}|(?<=```\n))(?:\.venv/bin/)?(beam(?:-convert|-validate)? [^&\n]*)"
PYTHON = r"```python\n(.*?)```"


def commands(page):
    """The command lines of a page, in words."""
    return [shlex.split(line, comments=True) for line in re.findall(COMMAND, PAGES[page], re.MULTILINE)]


def blocks(page):
    """The Python examples of a page."""
    return re.findall(PYTHON, PAGES[page], re.DOTALL)


def read_command(program, *words):
    """Read a command line as the command does, without doing what it says."""
    if program == "beam":
        parse(COMMANDS[words[0]].load(words[0])[0], words[1:], program)
    elif program == "beam-validate":
        parse(validate.Validate, words, program)
    elif words[0] == "inspect":
        parse(convert.InspectCommand, words[1:], program)
    else:
        parse(convert.ConvertCommand, words, program)


def standing_cloud(x):
    """Six relightable Gaussians on a frame that stands off the origin."""
    places = np.array([(i, 3.0 + j, 1.0 + k) for i in (x, x + 1.0) for j, k in ((0, 0), (1, 0.5), (0.5, 2))])
    normals = np.tile([0.0, -1.0, 0.0], (6, 1))
    return relightable(places, scales=np.full((6, 3), 0.1), normals=normals, ids=np.arange(6), axes="rfu")


def test_the_fit_of_the_rasterizer_page(capsys):
    """Every loss falls, and the numbers printed are about those of the page, which are a CPU's."""
    page = PAGES["docs/rasterizing.md"]
    example = next(block for block in blocks("docs/rasterizing.md") if "def step()" in block)
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
    exec(compile(blocks("docs/tracking.md")[0], "docs/tracking.md", "exec"), scope)
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
    (example,) = re.findall(r"```json\n(.*?)```", PAGES["docs/stages.md"], re.DOTALL)
    (tmp_path / "stage.json").write_text(example.replace("studio.hdr", "studio.exr"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    scope = {}
    exec(compile(blocks("docs/stages.md")[0], "docs/stages.md", "exec"), scope)
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
    sections = re.split(r"^##+ ", PAGES["docs/stages.md"], flags=re.MULTILINE)
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


def a_world():
    """What short examples take for granted: a small relightable ball, cameras, a lamp, light and a ground."""
    ball = drawn_ball(count=400).with_arrays(scales=np.tile([0.05, 0.05, 1e-3], (400, 1)))
    cameras = [Camera.orbit((0, 0, 0), 2.5, azimuth, 15, width=24, height=16, vertical_fov=40) for azimuth in (0, 120)]
    return {"cloud": ball, "camera": cameras[0], "cameras": cameras, "light": EnvironmentMap(np.ones((8, 16, 3)))}


def of_charts(folder, monkeypatch):
    return {"time_blur": lambda taps, kernel: ([0.1 * taps, 0.2 * taps], np.full(9, 1.0 / taps))}


def of_interop(folder, monkeypatch):
    pytest.importorskip("torch")
    camera = Camera.orbit((0, 0, 0), 2.5, 0, 0, width=24, height=16, vertical_fov=40)
    return {"rasterizer": raster.Rasterizer(10, [camera], value_count=3), "numpy": np, "jax": SimpleNamespace(numpy=np)}


def of_meshing(folder, monkeypatch):
    monkeypatch.setattr(extract, "surrounding_cameras", partial(extract.surrounding_cameras, side=32))
    ball = a_world()["cloud"]
    small = ball.with_arrays(positions=0.1 * ball.positions, scales=0.1 * ball.scales)
    views = [
        Camera.orbit((0, 0, 0), 0.25, azimuth, 0, width=24, height=16, vertical_fov=40) for azimuth in (0, 120, 240)
    ]
    drawn = [(view, beam_warp.rasterize(small, view)) for view in views]
    return {"cloud": small, "measured": [(view, image.depth, image.alpha) for view, image in drawn]}


def of_reconstruction(folder, monkeypatch):
    write_capture(folder / "captures" / "walker", range(13))
    monkeypatch.setattr("beam_warp.reconstruction.steps.FitAndTrack", FakeSteps)
    return {}


def of_rendering(folder, monkeypatch):
    world = a_world()
    camera = Camera.orbit((0, 0, 0), 2.5, 0, 15, width=6, height=4, vertical_fov=40)
    shot = Shot(cloud=world["cloud"], camera=camera, environment=world["light"])
    ground = Ground().mesh(world["cloud"].positions)
    names = {"raster": RasterOptions(), "ground": ground, "moved": world["cloud"].positions + 0.1, "shot": shot}
    return world | names | {"Path": Path}


def of_tracing(folder, monkeypatch):
    cloud = a_world()["cloud"]
    return {
        "cloud": cloud,
        "ground": Ground().mesh(cloud.positions).surface,
        "origins": np.tile([0.0, -2.0, 0.0], (5, 1)),
        "directions": np.tile([0.0, 1.0, 0.0], (5, 1)),
        "distance_to_the_lamp": 4.0,
        "adjoints": np.ones(5),
        **{name: getattr(cloud, name) for name in ("positions", "orientations", "scales")},
    }


def of_validation(folder, monkeypatch):
    register()
    (folder / "person").mkdir()
    save([a_world()["cloud"]], folder / "person" / "asset.usda")
    return {}


def of_viewer(folder, monkeypatch):
    (folder / "person").mkdir()
    save([a_world()["cloud"]] * 4, folder / "person" / "asset.usda")
    return {}


def of_readme(folder, monkeypatch):
    cloud = a_world()["cloud"].with_arrays(radiance=np.full((400, 1, 3), 0.5))
    converters.write(GaussianSequence.from_clouds([cloud]), folder / "person.ply")
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n"
    (folder / "studio.hdr").write_bytes(head + bytes([128, 128, 128, 129]) * 32)  # grey of radiance 1
    return {}


PREPARED = {
    "README.md": of_readme,
    "docs/charts.md": of_charts,
    "docs/engines/unreal.md": lambda *_: {},
    "docs/interop.md": of_interop,
    "docs/meshing.md": of_meshing,
    "docs/rasterizing.md": lambda *_: a_world() | {"derivatives": np.ones((16, 24))},
    "docs/reconstruction.md": of_reconstruction,
    "docs/rendering.md": of_rendering,
    "docs/tracing.md": of_tracing,
    "docs/validation.md": of_validation,
    "docs/viewer.md": of_viewer,
}
"""What the examples of a page take for granted: a function of a folder for files, which gives names."""


LONG = ("README.md", "docs/charts.md", "docs/viewer.md")
"""Pages whose examples take seconds."""


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=pytest.mark.slow if page in LONG else ()) for page in PREPARED]
)
def test_examples_run(page, tmp_path, monkeypatch, trusted_files):
    """Examples of a page run one after the other; that longer ones give what the page says is tested below."""
    monkeypatch.chdir(tmp_path)
    scope = PREPARED[page](tmp_path, monkeypatch)
    examples = [block for block in blocks(page) if "def step()" not in block]
    assert examples
    for example in examples:
        exec(compile(example, page, "exec"), scope)


def test_no_example_is_left_out():
    judged = {"docs/tracking.md", "docs/stages.md"}
    assert {page for page in PAGES if blocks(page)} == {*PREPARED, *WALKS, *judged}


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)])
def test_commands_are_as_they_are_read(page):
    for words in commands(page):
        read_command(*words)


@pytest.fixture(scope="module")
def after_the_start(tmp_path_factory):
    """The folder in which somebody worked through the start, with a smaller demo."""
    folder = tmp_path_factory.mktemp("walks")
    sizes = {"size": 64, "frame_count": 2, "camera_count": 8, "test_camera_count": 1, "samples": 4}
    steps = {"color_iterations": 30, "normal_iterations": 30, "joint_iterations": 20, "track_iterations": 10}
    images = FromImagesOptions(gaussian_count=1500, **sizes, **steps)
    run_demo = job.run_demo

    def smaller(out, options, progress):
        return run_demo(out, replace(options, gaussian_count=4000, image_height=96, images=images), progress)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(job, "run_demo", smaller)
        patch.chdir(folder)
        walk("docs/start.md")
    return folder


def walk(page):
    """Do what a page says in the working folder, line by line."""
    programs = {"beam": main, "beam-convert": convert.main, "beam-validate": validate.main}
    scope = {}
    for line, python, stage in re.findall(rf"{COMMAND}|{PYTHON}|```json\n(.*?)```", PAGES[page], re.M | re.S):
        if python:
            exec(compile(python, page, "exec"), scope)
        elif stage:
            Path("stage.json").write_text(stage, encoding="utf-8")
        elif not line.startswith("beam view"):  # which serves until it is stopped
            program, *words = shlex.split(line, comments=True)
            assert programs[program](words) == 0, line


@pytest.mark.slow
@pytest.mark.parametrize("page", WALKS[1:])
def test_tutorials_can_be_followed(page, after_the_start, monkeypatch):
    monkeypatch.chdir(after_the_start)
    walk(page)


def test_links_lead_to_files():
    dead = [f"{page}: {match[0]}" for page in PAGES for match, target in SITE.links(ROOT / page) if not target.exists()]
    assert dead == []


@pytest.fixture(scope="module")
def reference():
    """The pages that are generated, by their paths."""
    return {str(path): text for path, text in SITE.reference().items()}


def test_the_site_has_every_page(reference):
    listed = set(re.findall(r"[\w./-]+\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    assert {str(SITE.place(page)) for page in SITE.sources()} | set(reference) == listed


def test_links_between_pages_are_those_of_the_site():
    assert "[The asset's specification](spec.md)" in SITE.on_site(DOCS / "index.md")
    assert "[the start](../start.md)" in SITE.on_site(DOCS / "tutorials" / "splat.md")
    assert "](captures.md)" in SITE.on_site(ROOT / "CHANGELOG.md")
    assert str(SITE.place(ROOT / "benchmarks" / "timing.py")) == "files/benchmarks/timing.py"
    text = """[a](x.md#b "c") ![d](../e.png) <a href="f.json">[g](https://h) [i](#j)"""
    assert SITE.LINK.findall(text) == ["x.md", "../e.png", "f.json"]


def test_the_reference_is_that_of_commands_and_public_names(reference):
    said = reference["reference/commands.md"]
    for command in ("beam run", "beam chart tracing", "beam-convert inspect", "beam-validate"):
        assert re.search(rf"^## {command}\n\n```text\nusage: {command} ", said, re.MULTILINE)
    assert "--target-error E" in said
    assert "::: beam_warp.rasterize\n" in reference["reference/beam_warp.md"]
    assert "::: beam_warp.trace.closest_surface\n" in reference["reference/beam_warp.trace.md"]


@pytest.mark.slow
def test_the_site_is_built_and_loads_nothing_from_elsewhere(reference):
    """What `make docs` does; strict: a link or anchor that leads nowhere fails."""
    pytest.importorskip("zensical")
    for command in (["docs/gather_pages.py"], ["-m", "zensical", "build", "--clean", "--strict"]):
        done = subprocess.run([sys.executable, "-P", *command], cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    pages = list((ROOT / "site").rglob("*.html"))
    assert len(pages) > len(PAGES)
    for path, text in reference.items():
        page = (ROOT / "site" / path).with_suffix(".html").read_text(encoding="utf-8")
        assert [name for name in re.findall(r"^::: (\S+)", text, re.MULTILINE) if f'id="{name}"' not in page] == []
    loaded = r"<(?:script|img|iframe|source)[^>]+src=\"?(?:https?:)?//|<link[^>]+stylesheet[^>]+href=\"?(?:https?:)?//"
    assert [page.name for page in pages if re.search(loaded, page.read_text(encoding="utf-8"))] == []


def test_the_readme_is_short():
    assert len(PAGES["README.md"].splitlines()) <= 150


def test_files_and_targets_that_pages_name_are_there():
    """All but the changelog name what is there now."""
    now = "\n".join(text for page, text in PAGES.items() if page != "CHANGELOG.md")
    named = set(re.findall(r"`((?:beam_warp|kernels|schema|converters|tests|docs|benchmarks)/[\w./]*)`", now))
    assert len(named) > 100
    assert [name for name in named if not (ROOT / name).exists()] == []
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert set(re.findall(r"(?:`|^ {4})make ([\w-]+)", now, re.MULTILINE)) <= set(targets)


def test_every_extra_is_described():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert set(re.findall(r"^\| `(\w+)` \|", PAGES["docs/commands.md"], re.MULTILINE)) == set(extras)
    named = {
        name
        for text in PAGES.values()
        for group in re.findall(r"beam-warp\[([\w,]+)\]", text)
        for name in group.split(",")
    }
    assert named <= set(extras)
