"""Files for importers by name: a tripod of three Gaussians stands upright and right-handed where each one shows it.

What an importer does with a position is written here a second time, in float64, from its source or documentation.
"""

import numpy as np
import plyfile
import pytest
from scipy.spatial.transform import Rotation

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.converters.common.importers import IMPORTERS
from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.axes import AXIS_CODES, change_axes
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.harmonics import SH_C0

RIGHT, UP, FORWARD = np.eye(3)
COLORS = {"right": (1.0, 0.0, 0.0), "up": (0.0, 1.0, 0.0), "forward": (0.0, 0.0, 1.0)}

HALF_TURN = {axis: Rotation.from_euler(axis, 180.0, degrees=True).as_matrix() for axis in "xz"}
AS_IT_IS = np.eye(3)

# importer: (what it and the user's click do with a position, the world's up, the world's hand)
SHOWN = {
    "supersplat": (HALF_TURN["z"], UP, "right"),
    "playcanvas": (HALF_TURN["z"], UP, "right"),
    "spark": (HALF_TURN["x"], UP, "right"),
    "mkkellogg": (AS_IT_IS, -UP, "right"),
    "babylon": (np.diag([1.0, -1.0, 1.0]), UP, "left"),
    "aras-p": (AS_IT_IS, UP, "left"),
    "gsplat-unity": (np.diag([1.0, 1.0, -1.0]), UP, "left"),
    "nanogs": (100.0 * np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]]), FORWARD, "left"),
    "houdini": (AS_IT_IS, UP, "right"),
    "blender": (AS_IT_IS, FORWARD, "right"),
    "usd": (AS_IT_IS, UP, "right"),
}
SHOWN |= {"unity": SHOWN["aras-p"], "unreal": SHOWN["nanogs"]}

# What they do with positions of files that they treat otherwise than a PLY.
OTHERWISE = {
    ("playcanvas", ".glb"): AS_IT_IS,
    ("spark", ".spz"): AS_IT_IS,
    ("babylon", ".glb"): np.diag([-1.0, 1.0, 1.0]),
}


@pytest.fixture
def tripod():
    """Red to the right (1 m), green above (2 m), blue in front (3 m), each long along its own arm."""
    arms = {"right": (1, 0, 0), "up": (0, 2, 0), "forward": (0, 0, -3)}
    turns = [Rotation.align_vectors([np.array(arm, float)], [[1.0, 0.0, 0.0]])[0].as_quat() for arm in arms.values()]
    radiance = np.zeros((3, 9, 3))
    radiance[:, 0] = (np.array([COLORS[name] for name in arms]) - 0.5) / SH_C0
    radiance[:, 1:] = np.random.default_rng(3).normal(0, 0.1, (3, 8, 3))
    cloud = GaussianCloud(
        positions=list(arms.values()),
        orientations=turns,
        scales=np.tile([0.5, 0.1, 0.05], (3, 1)),
        opacities=np.full(3, 0.9),
        radiance=radiance,
        radiance_color_space=DISPLAY_SRGB,
        axes="rub",
    )
    return GaussianSequence.from_clouds([cloud])


def stored(path):
    """What a PLY holds, by plyfile: position and long axis of each arm by the colour, in float64."""
    rows = plyfile.PlyData.read(str(path))["vertex"].data
    found = {}
    for row in rows:
        color = 0.5 + SH_C0 * np.array([row[f"f_dc_{k}"] for k in range(3)], float)
        name = min(COLORS, key=lambda key: np.abs(color - COLORS[key]).max())
        turn = Rotation.from_quat([row[f"rot_{k}"] for k in (1, 2, 3, 0)])
        found[name] = np.array([row[axis] for axis in "xyz"], float), turn.as_matrix()[:, 0]
    return found, rows.dtype.names


@pytest.mark.parametrize("importer", [name for name in IMPORTERS if name != "usd"])
def test_the_tripod_stands_where_the_importer_shows_it(tripod, tmp_path, importer):
    converters.write(tripod, tmp_path / "a.ply", WriteOptions(target=importer))
    arms, names = stored(tmp_path / "a.ply")
    to_world, up, hand = SHOWN[importer]
    unit = abs(np.linalg.det(to_world)) ** (1 / 3)
    shown = {name: to_world @ position for name, (position, _) in arms.items()}
    assert np.allclose(shown["up"], 2.0 * unit * up, atol=1e-6 * unit)
    for name, length in (("right", 1.0), ("forward", 3.0)):
        assert np.linalg.norm(shown[name]) == pytest.approx(length * unit)
    # Right × up is backward in right-handed axes, forward in left-handed ones; a mirrored picture has it the other way.
    turn = np.dot(np.cross(shown["right"], shown["up"]), shown["forward"])
    assert np.sign(turn) == (-1.0 if hand == "right" else 1.0)
    for position, axis in arms.values():  # long along its arm
        assert abs(np.dot(axis, position)) == pytest.approx(np.linalg.norm(position), rel=1e-6)
    degree = {9: 1, 24: 2, 45: 3}[sum(name.startswith("f_rest_") for name in names)]
    assert degree == (3 if importer in ("aras-p", "unity") else 2)


@pytest.mark.parametrize(
    ("importer", "suffix"),
    [(name, end) for name, importer in IMPORTERS.items() for end in (".spz", ".glb") if end in importer.suffixes],
)
def test_other_formats_stand_where_a_ply_does(tripod, tmp_path, importer, suffix):
    """The importer's axes outrank those of the format's text, and our own reader is told."""
    for end in (".ply", suffix):
        converters.write(tripod, tmp_path / f"a{end}", WriteOptions(target=importer))
    to_world = SHOWN[importer][0]
    stored_as = converters.read(tmp_path / f"a{suffix}")[0]  # rows keep their order in PLY, SPZ and GLB
    shown = stored_as.positions @ OTHERWISE.get((importer, suffix), to_world).T
    assert np.allclose(shown, converters.read(tmp_path / "a.ply")[0].positions @ to_world.T, atol=1 / 4096)
    assert np.allclose(change_axes(stored_as, "rub").positions, tripod[0].positions, atol=1 / 4096)


@pytest.mark.parametrize(("name", "axes"), [("a.spz", "rdf"), ("a.glb", "luf"), ("a.gltf", "bul")])
def test_axes_against_the_text_of_the_format_are_stated(tripod, tmp_path, name, axes):
    converters.write(tripod, tmp_path / name, WriteOptions(axes=axes))
    back = converters.read(tmp_path / name)[0]
    assert back.axes == axes
    assert np.allclose(change_axes(back, "rub").positions, tripod[0].positions, atol=1 / 4096)


def test_every_importer_has_an_emulation():
    assert set(SHOWN) == set(IMPORTERS)


def test_a_ply_is_upright_where_nobody_is_named_and_in_any_axes_on_request(tripod, tmp_path):
    converters.write(tripod, tmp_path / "a.ply")
    assert np.array_equal(stored(tmp_path / "a.ply")[0]["up"][0], [0, -2, 0])
    for code in AXIS_CODES[::5]:
        converters.write(tripod, tmp_path / "a.ply", WriteOptions(axes=code, target="aras-p"))
        back = converters.read(tmp_path / "a.ply")[0]
        assert (back.axes, back.sh_degree) == (code, 3)


def test_an_asset_comes_back_from_a_ply_as_it_was(tripod, tmp_path, trusted_files):
    converters.write(tripod, tmp_path / "a.usda", WriteOptions(full_float=True))
    asset = converters.read(tmp_path / "a.usda")
    converters.write(asset, tmp_path / "a.ply")
    converters.write(converters.read(tmp_path / "a.ply"), tmp_path / "b.usda", WriteOptions(full_float=True))
    before, after = asset[0], converters.read(tmp_path / "b.usda")[0]
    assert before.axes == after.axes == "rub"
    for name, array in before.arrays().items():
        # exp(log(s)) and sigmoid(logit(o)) are off by a few roundings; the rest is only negated.
        limit = 12 * np.finfo(np.float32).eps if name in ("scales", "opacities") else 0.0
        again = getattr(after, name)
        if name == "orientations":
            again = again * np.sign(np.sum(again * array, axis=1, keepdims=True))
        assert np.allclose(again, array, rtol=limit, atol=0), name


def test_degrees_that_an_importer_scrambles_are_refused(tripod, tmp_path, make_cloud):
    with pytest.raises(
        InvalidOptionError, match=r"sh_degree must be 3 for aras-p UnityGaussianSplatting, got 1\. Leave"
    ):
        converters.write(tripod, tmp_path / "a.ply", WriteOptions(target="unity", sh_degree=1))
    four = GaussianSequence.from_clouds([make_cloud(2, degree=4)])
    converters.write(four, tmp_path / "a.ply", WriteOptions(target="nanogs"))
    assert converters.read(tmp_path / "a.ply")[0].sh_degree == 3


def test_formats_that_an_importer_does_not_read_are_refused(tripod, tmp_path):
    with pytest.raises(InvalidOptionError, match=r"must end in \.ply for NanoGS .*, got a\.splat"):
        converters.write(tripod, tmp_path / "a.splat", WriteOptions(target="nanogs"))
    with pytest.raises(InvalidOptionError, match=r"must end in \.usd or .* for OpenUSD .*, got a\.ply"):
        converters.write(tripod, tmp_path / "a.ply", WriteOptions(target="usd"))
    with pytest.raises(InvalidOptionError, match=r"axes must be rub for USD, which fixes them, got rdf"):
        converters.write(tripod, tmp_path / "a.usdc", WriteOptions(axes="rdf"))
    with pytest.raises(InvalidOptionError, match=r"axes must be rub or luf or bul or fur for glTF, .*, got ruf"):
        converters.write(tripod, tmp_path / "a.glb", WriteOptions(axes="ruf"))
    assert not list(tmp_path.iterdir())
