"""Records: what they hold, what they refuse and in which words."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.gaussians import ATTRIBUTES, GaussianCloud, GaussianSequence, sh_degree_of


def arrays(count=4, **changes):
    return {
        "positions": np.zeros((count, 3)),
        "orientations": np.tile([0, 0, 0, 1.0], (count, 1)),
        "scales": np.full((count, 3), 0.1),
        "opacities": np.full(count, 0.5),
    } | changes


def test_arrays_become_canonical_and_are_protected():
    cloud = GaussianCloud(**arrays(positions=[[0, 1, 2]] * 4))
    assert cloud.positions.dtype == np.float32
    assert cloud.positions.flags.c_contiguous
    assert not cloud.positions.flags.writeable
    assert len(cloud) == 4


def test_the_table_of_attributes_is_the_record():
    fields = set(GaussianCloud.__dataclass_fields__) - {"axes", "radiance_color_space"}
    assert fields == set(ATTRIBUTES)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": np.zeros((4, 2))}, r"positions must have shape \(N, 3\), got \(4, 2\)\. Reshape"),
        ({"opacities": np.zeros(3)}, r"opacities must have as many rows as positions \(4\), got 3"),
        ({"opacities": [0.1, 0.2, 1.5, 0.3]}, r"opacities must lie in \[0, 1\], got 1\.5 at row 2"),
        ({"scales": -np.ones((4, 3))}, r"scales must lie in \[0, inf\], got -1 at row 0 \(4 rows in all\)"),
        ({"orientations": np.zeros((4, 4))}, r"orientations must have unit length, got \|v\| = 0 at row 0"),
        ({"positions": [[0, 0, np.nan]] * 4}, "positions must be finite, got NaN or infinity at row 0"),
        ({"positions": "text"}, "positions must be an array of float32, got str"),
        ({"opacities": None}, "opacities must be given, got None"),
        ({"normals": np.ones((4, 3))}, r"normals must have unit length, got \|v\| = 1\.732"),
        ({"base_color": np.full((4, 3), 2.0)}, r"base_color must lie in \[0, 1\], got 2"),
    ],
)
def test_broken_contracts_are_named(changes, message):
    with pytest.raises(InvalidArrayError, match=message):
        GaussianCloud(**arrays(**changes))


def test_radiance_states_its_colour_space():
    radiance = np.zeros((4, 9, 3))
    with pytest.raises(InvalidOptionError, match="radiance_color_space must be given if and only if radiance is"):
        GaussianCloud(**arrays(), radiance=radiance)
    with pytest.raises(InvalidOptionError, match="radiance_color_space must be one of"):
        GaussianCloud(**arrays(), radiance=radiance, radiance_color_space="sRGB")
    cloud = GaussianCloud(**arrays(), radiance=radiance, radiance_color_space=DISPLAY_SRGB)
    assert cloud.sh_degree == 2
    assert not cloud.is_relightable


@given(st.integers(0, 60))
def test_incomplete_bands_are_refused_never_rounded(count):
    if count in (1, 4, 9, 16, 25):
        assert (sh_degree_of(count) + 1) ** 2 == count
    else:
        with pytest.raises(InvalidArrayError, match=r"radiance must have \(degree \+ 1\)\^2 coefficients"):
            sh_degree_of(count)


def test_selection_keeps_every_array(rng):
    cloud = GaussianCloud(**arrays(positions=rng.normal(size=(4, 3))), ids=[10, 11, 12, 13])
    picked = cloud.select([3, 1])
    assert picked.ids.tolist() == [13, 11]
    assert np.array_equal(picked.positions, cloud.positions[[3, 1]])


class TestSequence:
    def test_what_is_constant_is_found(self):
        first = GaussianCloud(**arrays(), ids=range(4))
        second = first.with_arrays(positions=np.ones((4, 3)))
        sequence = GaussianSequence.from_clouds([first, second], frames_per_second=25.0)
        assert sequence.constant == {"orientations", "scales", "opacities", "ids"}
        assert sequence.topology == "constant"
        assert [len(cloud) for cloud in sequence] == [4, 4]

    def test_equal_counts_alone_are_no_identity(self):
        cloud = GaussianCloud(**arrays())
        assert GaussianSequence.from_clouds([cloud, cloud]).topology == "perFrame"
        assert GaussianSequence.from_clouds([cloud]).topology == "constant"

    def test_changing_counts(self):
        sequence = GaussianSequence.from_clouds([GaussianCloud(**arrays(4)), GaussianCloud(**arrays(5))])
        assert sequence.topology == "perFrame"
        assert not sequence.constant

    @pytest.mark.parametrize("frame", [-1, 1])
    def test_frames_outside_are_refused(self, frame):
        with pytest.raises(IndexError, match=r"frame must be in \[0, 0\]"):
            GaussianSequence.from_clouds([GaussianCloud(**arrays())])[frame]

    def test_options_are_checked(self):
        cloud = GaussianCloud(**arrays())
        with pytest.raises(InvalidOptionError, match="frames_per_second must be a number"):
            GaussianSequence.from_clouds([cloud], frames_per_second=0.0)
        with pytest.raises(InvalidOptionError, match="constant must name attributes"):
            GaussianSequence(1, lambda _: cloud, constant=frozenset({"colour"}))
        with pytest.raises(InvalidOptionError, match=r"len\(clouds\) must be an integer"):
            GaussianSequence.from_clouds([])


class TestBrokenRows:
    def broken(self):
        fields = arrays(8)
        fields = {name: np.array(value, np.float64) for name, value in fields.items()}
        fields["positions"][0, 1] = np.nan
        fields["scales"][1, 2] = -0.1
        fields["orientations"][2] = 0.0
        fields["opacities"][3] = np.inf
        fields["scales"][4, 0] = 1e300  # infinite in float32
        return fields

    def test_they_are_left_out_and_counted(self):
        cloud, left_out = GaussianCloud.leaving_out_invalid(**self.broken(), ids=range(8))
        assert cloud.ids.tolist() == [5, 6, 7]
        assert left_out.rows.tolist() == [0, 1, 2, 3, 4]
        assert (left_out.not_finite, left_out.negative_scales, left_out.zero_quaternions) == (3, 1, 1)
        assert len(left_out) == 5
        assert str(left_out) == "3 not finite, 1 with a negative scale, 1 with a zero quaternion"

    def test_any_array_can_break_a_row_and_each_row_counts_once(self):
        normals = np.tile([0.0, 0.0, 1.0], (8, 1))
        normals[[0, 6]] = np.nan
        fields = self.broken()
        fields["scales"][0] = -1.0
        cloud, left_out = GaussianCloud.leaving_out_invalid(**fields, normals=normals)
        assert left_out.rows.tolist() == [0, 1, 2, 3, 4, 6]
        assert (left_out.not_finite, left_out.negative_scales, left_out.zero_quaternions) == (4, 1, 1)
        assert len(cloud) == 2

    @pytest.mark.parametrize(
        ("fields", "kept", "broken"),
        [(arrays(4), 4, 0), (arrays(0), 0, 0), (arrays(positions=np.full((4, 3), np.nan)), 0, 4)],
    )
    def test_all_or_none_may_be_broken(self, fields, kept, broken):
        cloud, left_out = GaussianCloud.leaving_out_invalid(**fields, axes="rdf")
        assert (len(cloud), len(left_out), cloud.axes) == (kept, broken, "rdf")
        assert bool(str(left_out)) == bool(broken)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"opacities": [-3.0, 2.0, 5.0, 1.0]}, r"opacities must lie in \[0, 1\], got -3"),
            ({"orientations": np.full((4, 4), 2.0)}, r"orientations must have unit length, got \|v\| = 4 at row 0"),
            ({"scales": np.ones((3, 3))}, r"scales must have as many rows as positions \(4\), got 3"),
            ({"positions": None}, "positions must be given, got None"),
        ],
    )
    def test_what_is_wrong_with_a_whole_array_is_refused(self, changes, message):
        with pytest.raises(InvalidArrayError, match=message):
            GaussianCloud.leaving_out_invalid(**arrays(**changes))
