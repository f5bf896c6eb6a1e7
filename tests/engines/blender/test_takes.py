"""What the Blender add-on reads is what the package reads, in Blender's axes; what it cannot read ends in one line."""

import importlib
import sys
import tomllib
import types
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.moving_cloud import clouds, written

from beam_warp import converters
from beam_warp._version import __version__
from beam_warp.world.axes import AXIS_CODES, change_axes
from beam_warp.world.gaussians import GaussianSequence

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="session")
def takes(addon):
    package = types.ModuleType("beam_relightable")
    package.__path__ = [str(addon)]
    sys.modules["beam_relightable"] = package
    return importlib.import_module("beam_relightable.takes")


def covariances(orientations, scales):
    axes = Rotation.from_quat(orientations).as_matrix() * np.asarray(scales, float)[:, None]
    return axes @ axes.transpose(0, 2, 1)


def require_same(arrays, cloud, error=1e-5):
    """The same places and materials, row by row, and discs that rays along the normals take for the Gaussians."""
    for name in ("positions", "base_color", "normals"):
        assert np.allclose(arrays[name], getattr(cloud, name), atol=error), name
    for name in ("opacities", "roughness", "ambient_occlusion"):
        assert np.allclose(arrays[name][:, 0], getattr(cloud, name), atol=error), name
    normals = np.asarray(cloud.normals, float)
    across = np.eye(3) - normals[:, :, None] * normals[:, None]
    whole = covariances(cloud.orientations, cloud.scales)
    disc = covariances(arrays["orientations"], arrays["scales"] * [1.0, 1.0, 0.0])
    assert np.allclose(across @ whole @ across, across @ disc @ across, atol=error)
    peak = np.linalg.solve(whole, normals[:, :, None])[:, :, 0]
    peak /= np.linalg.norm(peak, axis=1, keepdims=True)
    assert np.allclose(Rotation.from_quat(arrays["orientations"]).as_matrix()[:, :, 2], peak, atol=error)


class TestPly:
    @pytest.mark.parametrize("axes", AXIS_CODES[::5])
    def test_any_axes_stand_upright(self, takes, tmp_path, axes):
        path = written(tmp_path / "a.ply", 1, profile="beam", axes=axes)
        require_same(takes.open_take(path).at(0.0), next(clouds()))

    def test_units_are_those_of_the_file(self, takes, tmp_path):
        path = written(tmp_path / "a.ply", 1, profile="beam")
        path.write_bytes(
            path.read_bytes().replace(b"comment beam_schema", b"comment beam_meters_per_unit 0.01\ncomment x")
        )
        assert np.allclose(takes.open_take(path).at(0.0)["positions"], 0.01 * next(clouds()).positions, atol=1e-6)

    def test_axes_that_are_not_stated_are_given(self, takes, tmp_path):
        path = written(tmp_path / "a.ply", 1, profile="beam", axes="ruf")
        path.write_bytes(path.read_bytes().replace(b"comment beam_axes", b"comment former_axes"))
        require_same(takes.open_take(path, "ruf").at(0.0), next(clouds()))


def test_flat_and_long_gaussians_keep_their_shape(takes):
    """A disc keeps its plane though its normal leans, a rod its length; a ball faces its normal."""
    scales = np.array([[0.2, 0.3, 0.0], [1.0, 0.01, 0.01], [0.1, 0.1, 0.1]]).T
    normals = np.array([[0.0, 0.6, 0.8], [0.8, 0.0, 0.6], [0.0, 0.0, -1.0]]).T
    turns, sizes = takes.seen_along(normals, np.tile([[0.0], [0.0], [0.0], [1.0]], 3), scales)
    axes = Rotation.from_quat(turns.T).as_matrix()
    assert np.allclose(axes[:2, :, 2], [[0.0, 0.0, 1.0]] * 2, atol=2e-3)
    assert np.allclose(axes[2, :, 2], [0.0, 0.0, -1.0])
    assert np.allclose(np.sort(sizes[:2], axis=0).T, [[0.2, 0.3], [0.01, 1.0], [0.1, 0.1]], rtol=1e-2)


class TestContainer:
    def test_whole_frames_are_those_of_the_package(self, takes, tmp_path):
        path = written(tmp_path / "a.b4d")
        take, sequence = takes.open_take(path), converters.read(path)
        assert (take.frames, take.rate, take.blends) == (3, 10.0, True)
        for frame in range(3):
            require_same(take.at(frame / 10.0), change_axes(sequence[frame], "rfu"))

    def test_between_frames_values_are_halfway(self, takes, tmp_path):
        take = takes.open_take(written(tmp_path / "a.b4d"))
        before, between, after = (take.at(seconds) for seconds in (0.1, 0.15, 0.2))
        assert np.allclose(between["positions"], (before["positions"] + after["positions"]) / 2.0, atol=1e-6)
        assert np.allclose(np.linalg.norm(between["orientations"], axis=1), 1.0, atol=1e-6)
        first, second = take.frame(1), take.frame(2)
        half = takes.blended(first, second, 0.5)["orientations"].T
        ways = [Rotation.from_quat(each["orientations"].T).inv() * Rotation.from_quat(half) for each in (first, second)]
        assert np.allclose(ways[0].magnitude(), ways[1].magnitude(), atol=1e-4)

    def test_the_ends_are_held(self, takes, tmp_path):
        take = takes.open_take(written(tmp_path / "a.b4d"))
        assert np.array_equal(take.at(-5.0)["positions"], take.at(0.0)["positions"])
        assert np.array_equal(take.at(99.0)["positions"], take.at(0.2)["positions"])


def test_every_truncation_and_stranger_ends_in_one_line(takes, tmp_path):
    for name, options in (("a.b4d", {}), ("a.ply", {"profile": "beam"})):
        whole = written(tmp_path / name, 1, **options).read_bytes()
        for size in (0, 10, 300, len(whole) // 2):
            (tmp_path / f"cut_{name}").write_bytes(whole[:size])
            with pytest.raises(takes.TakeError, match=r"^cut_a\.[^\n]*must[^\n]*, got [^\n]*\.$"):
                takes.open_take(tmp_path / f"cut_{name}").at(0.0)
    with pytest.raises(takes.TakeError, match=r"^missing\.b4d[^\n]*$"):
        takes.open_take(tmp_path / "missing.b4d")
    converters.write(GaussianSequence.from_clouds(list(clouds(1))), tmp_path / "plain.ply")
    with pytest.raises(takes.TakeError, match=r"got no .*base_color_0.*--profile beam\.$"):
        takes.open_take(tmp_path / "plain.ply")


def test_the_manifest_has_the_version_of_the_package(addon):
    manifest = tomllib.loads((addon / "blender_manifest.toml").read_text(encoding="utf-8"))
    assert manifest["version"] == __version__
    assert (addon / "decoder.py").read_bytes() == (ROOT / "converters/delivery/decoder.py").read_bytes()
