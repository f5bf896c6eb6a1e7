"""`beam mesh`: what it writes, that it goes on where it stopped, and what it refuses."""

import json

import numpy as np
import pytest
from support.drawn_ball import drawn_ball

from beam_warp import converters
from beam_warp.cli.main import main
from beam_warp.mesh.files import read_mesh
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianSequence

FAST = ("--size", "48", "--voxel", "0.05", "--device", "cpu")


def ball(center, count=3000):
    return drawn_ball(center, (0.5, 0.5, 0.5), count).with_arrays(scales=np.tile([0.025, 0.025, 1e-4], (count, 1)))


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    path = tmp_path_factory.mktemp("sequence") / "balls.ply"
    clouds = [ball((0.0, 0.0, 0.3 * frame)) for frame in range(2)]
    converters.write(GaussianSequence.from_clouds(clouds), path, converters.WriteOptions(profile="beam"))
    return path.parent


def run(*words):
    return main(["mesh", *map(str, words)])


def write_capture(folder, frames, distance=3.0):
    """Cameras around the ball, without images: none are needed."""
    folder.mkdir()
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    seen = {"width": 64, "height": 64, "vertical_fov": 30.0}
    cameras = [Camera.orbit((0, 0, 0), distance, 45.0 * i, 40.0 * (-1) ** i, **seen) for i in range(9)]
    records = [
        {"file_path": f"images/{i}/{frame:04d}.exr", "camera": f"cam{i}", "frame": frame,
         "split": "train" if i < 8 else "test", "transform_matrix": (camera.camera_to_world @ flip).tolist()}
        for i, camera in enumerate(cameras) for frame in frames
    ]  # fmt: skip
    focal = {"fl_x": cameras[0].focal_x, "fl_y": cameras[0].focal_y}
    content = {"w": 64, "h": 64, **focal, "cx": 32, "cy": 32, "frames": records}
    (folder / "transforms.json").write_text(json.dumps(content))


def test_a_mesh_a_frame(sequence, tmp_path, capsys):
    assert run(sequence, "--out", tmp_path / "out", *FAST, "--preview") == 0
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 3
    assert "closed" in said[0]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        f"mesh00000{frame}.{suffix}" for frame in range(2) for suffix in ("ply", "json", "png")
    }
    for frame in range(2):
        mesh = read_mesh(tmp_path / "out" / f"mesh00000{frame}.ply")
        assert np.abs(np.linalg.norm(mesh.vertices - [0, 0, 0.3 * frame], axis=1) - 0.5).max() < 0.05
        assert mesh.visual.kind == "vertex"


def test_finished_frames_are_kept(sequence, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(sequence, "--out", out, *FAST, "--quiet", "--frames", "1") == 0
    assert capsys.readouterr().out == ""
    before = (out / "mesh000001.ply").stat().st_mtime_ns
    content = (out / "mesh000001.ply").read_bytes()

    assert run(sequence, "--out", out, *FAST, "--json") == 0
    frames = json.loads(capsys.readouterr().out)["frames"]
    assert [frame["kept"] for frame in frames] == [False, True]
    assert (out / "mesh000001.ply").stat().st_mtime_ns == before

    # Interrupted before the report was written, damaged, or made with other options: made again, to the same bytes.
    (out / "mesh000001.json").write_text("{")
    assert run(sequence, "--out", out, *FAST, "--json", "--frames", "1") == 0
    assert not json.loads(capsys.readouterr().out)["frames"][0]["kept"]
    assert (out / "mesh000001.ply").read_bytes() == content
    assert run(sequence, "--out", out, *FAST, "--json", "--frames", "1", "--color", "none") == 0
    assert not json.loads(capsys.readouterr().out)["frames"][0]["kept"]
    assert (out / "mesh000001.ply").read_bytes() != content


def test_it_is_drawn_as_the_asset_says_unless_told_otherwise(tmp_path, capsys):
    """What a mesh is made of is in its key, how its depth was drawn included."""
    stated = RasterOptions(antialiased=True, low_pass=0.1).as_metadata()
    for name, metadata in (("said", stated), ("silent", {})):
        balls = GaussianSequence.from_clouds([ball((0.0, 0.0, 0.0))], metadata=metadata)
        converters.write(balls, tmp_path / f"{name}.ply", converters.WriteOptions(profile="beam"))

    def kept(name, *more):
        assert run(tmp_path / f"{name}.ply", "--out", tmp_path / "out", *FAST, "--json", *more) == 0
        return json.loads(capsys.readouterr().out)["frames"][0]["kept"]

    assert not kept("said")
    assert kept("silent", "--antialiased", "yes", "--low-pass", 0.1)
    assert kept("said", "--low-pass", 0.1)
    assert not kept("silent")
    assert kept("said", "--antialiased", "no", "--low-pass", 0.3)


def test_cameras_of_a_capture(sequence, tmp_path, capsys):
    write_capture(tmp_path / "capture", [0])
    words = ("--capture", tmp_path / "capture", "--voxel", "0.05", "--device", "cpu", "--format", "glb")
    assert run(sequence, "--out", tmp_path / "out", *words, "--frames", "0", "--json") == 0
    (frame,) = json.loads(capsys.readouterr().out)["frames"]
    assert frame["cameras"] == 8
    assert frame["mesh"]["nonmanifold_edges"] == 0
    mesh = read_mesh(tmp_path / "out" / "mesh000000.glb")
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.5).max() < 0.05
    write_capture(tmp_path / "nearer", [0], distance=2.9)
    elsewhere = ("--capture", tmp_path / "nearer", *words[2:])
    assert run(sequence, "--out", tmp_path / "out", *elsewhere, "--frames", "0", "--json") == 0
    assert not json.loads(capsys.readouterr().out)["frames"][0]["kept"]
    assert run(sequence, "--out", tmp_path / "out", *words) == 2
    assert "split must name records of frame 1 of the capture, got 'train'" in capsys.readouterr().err


def test_cameras_are_of_the_frame_that_the_asset_says_it_shows(tmp_path, capsys):
    """Without a word, frame 0 of an asset is frame 0 of a capture, which this one has not."""
    write_capture(tmp_path / "capture", [5])
    words = ("--capture", tmp_path / "capture", "--voxel", "0.05", "--device", "cpu", "--json")
    for name, metadata, code in (("said", {"capture_frames": "5"}, 0), ("silent", {}, 2)):
        cloud = ball((0.0, 0.0, 0.0))
        converters.write(GaussianSequence.from_clouds([cloud], metadata=metadata), tmp_path / f"{name}.usdc")
        assert run(tmp_path / f"{name}.usdc", "--out", tmp_path / name, *words) == code
    captured = capsys.readouterr()
    assert json.loads(captured.out)["frames"][0]["cameras"] == 8
    assert "split must name records of frame 0 of the capture, got 'train'" in captured.err


def test_unwrap(sequence, tmp_path, capsys):
    pytest.importorskip("xatlas")
    assert run(sequence, "--out", tmp_path / "out", *FAST, "--frames", "0", "--unwrap", "--json") == 0
    canonical = json.loads(capsys.readouterr().out)["frames"][0]["canonical"]
    flat = [read_mesh(tmp_path / "out" / f"canonical.{suffix}") for suffix in ("glb", "obj")]
    for mesh in flat:
        assert (len(mesh.faces), len(mesh.vertices)) == (canonical["faces"], canonical["vertices"])
        assert mesh.visual.uv.shape == (len(mesh.vertices), 2)
    assert np.abs(flat[0].vertices - flat[1].vertices).max() < 1e-7


def test_large_canonical_mesh_is_fused_again(sequence, tmp_path, capsys, monkeypatch):
    pytest.importorskip("xatlas")
    monkeypatch.setattr("beam_warp.cli.mesh.UNWRAP_FACES", 1500)
    assert run(sequence, "--out", tmp_path / "out", *FAST, "--frames", "0", "--unwrap", "--json") == 0
    (frame,) = json.loads(capsys.readouterr().out)["frames"]
    assert frame["mesh"]["faces"] > 1500 >= frame["canonical"]["faces"] > 700
    assert frame["canonical"]["voxel"] > frame["voxel"]


def test_mistakes(sequence, tmp_path, refused):
    for words, says in (
        (("--frames", "7"), "frames must be an integer in [0, 1], got 7"),
        (("--voxel", "-1"), "voxel must be a number in"),
        (("--out", f"{__file__}/meshes"), "out must be a folder"),
        (("--confirmations", "99"), "depth must be seen"),
    ):
        refused("mesh", sequence, "--out", tmp_path, *FAST, "--frames", "0", *words, says=says)
