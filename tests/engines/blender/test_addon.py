"""The add-on inside Blender: ``$BEAM_BPY`` names Pythons with ``bpy``, several by the separator of paths."""

import json
import os
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.drawn_ball import relightable
from support.moving_cloud import clouds, written

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.converters.delivery.decoder import Container
from beam_warp.image.files import read_image
from beam_warp.world.gaussians import GaussianSequence

PYTHONS = [each for each in os.environ.get("BEAM_BPY", "").split(os.pathsep) if each]
SIZE, SIGMA, OPACITY, SAMPLES = 16, 0.5, 0.8, 64
REACH = np.sqrt(2.0 * np.log(255.0))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not PYTHONS, reason="no Blender is named (set BEAM_BPY to a Python with bpy)"),
]


@pytest.fixture(scope="module", params=PYTHONS)
def session(request, addon, tmp_path_factory):
    """What one session in Blender left."""
    folder = tmp_path_factory.mktemp("blender")
    written(folder / "take.b4d")
    (folder / "cut.b4d").write_bytes((folder / "take.b4d").read_bytes()[:500])
    disc = relightable([[0.0, 0.0, 0.0]], scales=[[SIGMA, SIGMA, 0.0]], opacities=[OPACITY], base_color=[[1.0] * 3])
    converters.write(GaussianSequence.from_clouds([disc]), folder / "disc.ply", WriteOptions(profile="beam"))
    job = {"addon": str(addon.parent / "addon.zip"), "take": str(folder / "take.b4d"), "disc": str(folder / "disc.ply")}
    job |= {"broken": [str(folder / "cut.b4d"), str(folder / "none.ply")], "size": SIZE, "samples": SAMPLES}
    (folder / "job.json").write_text(json.dumps(job))
    script = str(Path(__file__).with_name("inside_blender.py"))
    homes = {"HOME": str(folder), "BLENDER_USER_RESOURCES": str(folder / "resources")}
    command = [request.param, script, str(folder / "job.json")]
    done = subprocess.run(command, env=os.environ | homes, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    facts = json.loads((folder / "facts.json").read_text())
    picture = read_image(folder / "disc.exr").linear_rgba()
    bound = Container(folder / "gone").manifest["bounds"]["positions"]
    return SimpleNamespace(
        bound=bound, facts=facts, frames=np.load(folder / "frames.npz"), picture=picture, folder=folder, job=job,
        python=request.param, environment=os.environ | homes,
    )  # fmt: skip


def test_it_is_in_the_menu_and_takes_dropped_files(session):
    assert session.facts["menu"]
    assert session.facts["dropped"] == ".b4d;.ply"
    assert session.facts["bounces"] == 128


def test_discs_are_where_the_gaussians_are_at_every_frame(session):
    """Five frames a second of the scene are every second one of the take."""
    for frame, cloud in zip((1, 2), list(clouds())[::2], strict=True):
        corners = session.frames[f"corners_{frame}"].reshape(-1, 4, 3)
        centers = session.frames[f"centers_{frame}"].reshape(-1, 4, 3)[:, 0]
        rows = [int(np.linalg.norm(cloud.positions - center, axis=1).argmin()) for center in centers]
        assert sorted(rows) == list(range(len(cloud)))
        assert np.allclose(corners.mean(axis=1), cloud.positions[rows], atol=session.bound + 1e-5)
        normals = session.frames[f"normals_{frame}"].reshape(-1, 4, 3)[:, 0]
        offsets = corners - corners.mean(axis=1, keepdims=True)
        # The corners of a square of sides 2 r have the covariance of its axes times r².
        covered = offsets.transpose(0, 2, 1) @ offsets / (4.0 * REACH**2)
        axes = Rotation.from_quat(cloud.orientations[rows]).as_matrix() * cloud.scales[rows][:, None]
        across = np.eye(3) - normals[:, :, None] * normals[:, None]
        seen = across @ axes @ axes.transpose(0, 2, 1) @ across
        assert np.allclose(across @ covered @ across, seen, atol=0.05 * 0.4**2)
        assert (np.einsum("ni,ni->n", normals, cloud.normals[rows]) > np.cos(0.05)).all()


def test_a_saved_file_moves_on_and_a_lost_take_holds_its_last_frame(session):
    assert np.array_equal(session.frames["after_loading"], session.frames["centers_1"])
    assert np.array_equal(session.frames["held"], session.frames["centers_1"])
    assert session.facts["problem"].startswith("take must be a file, got ")


def test_what_cannot_be_read_is_refused_in_one_line(session):
    cut, missing = session.facts["refused"]
    assert "cut.b4d" in cut
    assert "none.ply" in missing
    assert all(text.strip().count("\n") == 0 and "Traceback" not in text for text in (cut, missing))


def test_cycles_sees_a_gaussian_that_white_light_leaves_white(session):
    """A white surface in a white furnace returns its light, to what Principled leaves out of it: at most the 4 % of the
    coat's second bounce."""
    check_disc(session.picture)


def test_eevee_sees_the_same(session):
    """EEVEE draws with OpenGL, which Mesa offers without a screen and without a graphics card."""
    job = session.folder / "eevee.json"
    job.write_text(json.dumps(session.job | {"engine": "BLENDER_EEVEE"}))
    graphics = {"LIBGL_ALWAYS_SOFTWARE": "1", "EGL_PLATFORM": "surfaceless"}
    command = [session.python, str(Path(__file__).with_name("inside_blender.py")), str(job)]
    done = subprocess.run(command, env=session.environment | graphics, capture_output=True, text=True, timeout=900)
    if done.returncode != 0 and "GPU context" in done.stdout + done.stderr:
        pytest.skip("EEVEE finds no OpenGL here (Debian: libegl1, libgl1-mesa-dri)")
    assert done.returncode == 0, done.stdout + done.stderr
    check_disc(read_image(session.folder / "BLENDER_EEVEE.exr").linear_rgba())


def check_disc(picture):
    """Fail unless alpha is the closed form o exp(-r²/2), and what is seen is white."""
    fine = (np.arange(8 * SIZE) + 0.5) / (8 * SIZE) * 4.0 - 2.0
    square = (fine[:, None] ** 2 + fine**2) / SIGMA**2
    alpha = OPACITY * np.exp(-square / 2.0)
    alpha = np.where(alpha < 1.0 / 255.0, 0.0, alpha).reshape(SIZE, 8, SIZE, 8).mean(axis=(1, 3))
    noise = np.sqrt(alpha * (1.0 - alpha) / SAMPLES)
    found = picture[..., 3]
    assert (np.abs(found - alpha) <= 4.5 * noise + 1e-3).all()
    seen = found > 0.3
    assert np.allclose(picture[seen][:, :3] / found[seen][:, None], 1.0, atol=0.04)
