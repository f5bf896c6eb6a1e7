"""Clouds between frames: closed forms of turning, a rotating body against the exact one, ends, what cannot blend."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.drawn_ball import relightable

from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.stage.time_sampling import TimeSampler, blend_clouds
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.quaternions import matrix_of, product, quaternion_of, slerp

EPSILON = 2.0**-24
"""Largest relative rounding of a float32."""


def sphere(turn=0.0, count=300, **changes):
    """Discs on a unit sphere, turned about z by an angle [rad]."""
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + 5.0**0.5) * k
    normals = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
    frames = Rotation.from_euler("zyx", np.stack([azimuth, polar, 0.0 * k], axis=1))
    whole = Rotation.from_rotvec([0.0, 0.0, turn])
    arrays = {
        "orientations": (whole * frames).as_quat(),
        "scales": np.tile([0.1, 0.2, 0.0], (count, 1)),
        "opacities": np.full(count, 0.9),
        "normals": whole.apply(normals),
        "ids": np.arange(count),
    }
    return relightable(whole.apply(normals), **(arrays | changes))


def one(**changes):
    """A single Gaussian."""
    arrays = {
        "positions": [[0.0, 0.0, 0.0]],
        "orientations": [[0.0, 0.0, 0.0, 1.0]],
        "scales": [[1.0, 1.0, 1.0]],
        "opacities": [0.5],
        "ids": [7],
    }
    return GaussianCloud(**(arrays | changes))


def sequence(*clouds, **options):
    return GaussianSequence.from_clouds(clouds, **options)


def difference(first, second):
    """The angle between rotations [rad], ``(N,)``."""
    return (Rotation.from_quat(first).inv() * Rotation.from_quat(second)).magnitude()


class TestSlerp:
    def test_half_of_a_quarter_turn_is_an_eighth(self):
        quarter = Rotation.from_euler("z", 90, degrees=True).as_quat()
        half = slerp([[0.0, 0.0, 0.0, 1.0]], quarter[None], 0.5)
        np.testing.assert_allclose(half[0], Rotation.from_euler("z", 45, degrees=True).as_quat(), atol=1e-15)

    def test_speed_is_constant_and_the_way_is_the_shorter_one(self, rng):
        first, second = Rotation.random(50, rng=rng), Rotation.random(50, rng=rng)
        whole = difference(first.as_quat(), second.as_quat())
        for sign in (1.0, -1.0):
            for share in (0.0, 0.1, 0.5, 0.75, 1.0):
                between = slerp(first.as_quat(), sign * second.as_quat(), share)
                np.testing.assert_allclose(difference(first.as_quat(), between), share * whole, atol=1e-7)
                np.testing.assert_allclose(difference(between, second.as_quat()), (1.0 - share) * whole, atol=1e-7)

    @pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-4])
    def test_small_turns_keep_their_digits(self, angle):
        end = [[np.sin(0.5 * angle), 0.0, 0.0, np.cos(0.5 * angle)]]
        got = slerp([[0.0, 0.0, 0.0, 1.0]], end, 0.25)[0]
        np.testing.assert_allclose(got, [np.sin(0.125 * angle), 0.0, 0.0, np.cos(0.125 * angle)], rtol=1e-12, atol=0.0)

    def test_half_a_turn_has_a_way(self):
        got = slerp([[0.0, 0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0, 0.0]], 0.5)[0]
        np.testing.assert_allclose(got, [0.5**0.5, 0.0, 0.0, 0.5**0.5], atol=1e-15)

    def test_none_are_none(self):
        assert slerp(np.zeros((0, 4)), np.zeros((0, 4)), 0.5).shape == (0, 4)

    def test_matrices_and_products(self, rng):
        rotations = Rotation.random(30, rng=rng)
        for rotation in rotations:
            np.testing.assert_allclose(matrix_of(quaternion_of(rotation.as_matrix())), rotation.as_matrix(), atol=1e-14)
        both = product(rotations[0].as_quat(), rotations.as_quat())
        assert difference(both, (rotations[0] * rotations).as_quat()).max() < 1e-7


class TestBetweenFrames:
    def test_a_rotating_sphere_is_the_exact_one_but_for_its_chords(self):
        turn = 0.2
        sampler = TimeSampler(sequence(sphere(), sphere(turn)))
        for share in (0.25, 0.5):
            got, exact = sampler.at(share), sphere(share * turn)
            # positions go along chords: the largest is sin(turn / 2) from the middle, 1 - cos(turn / 2) inside the arc
            assert np.abs(got.positions - exact.positions).max() <= 1.0 - np.cos(0.5 * turn) + 4 * EPSILON
            assert difference(got.orientations, exact.orientations).max() < 8 * EPSILON
            assert np.abs(np.linalg.norm(got.normals, axis=1) - 1.0).max() < 4 * EPSILON
            # what is off by c before it is brought to unit length is off by an angle of at most asin(c)
            chord = 2.0 * np.sin(0.5 * np.arcsin(1.0 - np.cos(0.5 * turn)))
            assert np.linalg.norm(got.normals - exact.normals, axis=1).max() <= chord + 4 * EPSILON

    def test_closed_forms_of_every_array(self):
        ends = {
            "positions": ([[0.0, 0.0, 0.0]], [[4.0, -8.0, 1.0]], [[1.0, -2.0, 0.25]]),
            "scales": ([[1.0, 4.0, 0.0]], [[16.0, 4.0, 1.0]], [[2.0, 4.0, 0.25]]),
            "opacities": ([0.0], [1.0], [0.25]),
            "base_color": ([[0.0, 0.5, 1.0]], [[1.0, 0.5, 0.0]], [[0.25, 0.5, 0.75]]),
            "roughness": ([0.2], [0.6], [0.3]),
            "ambient_occlusion": ([1.0], [0.0], [0.75]),
            "normals": ([[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]], [np.array([0.75, 0.25, 0.0]) / np.hypot(0.75, 0.25)]),
            "radiance": (np.zeros((1, 1, 3)), np.ones((1, 1, 3)), np.full((1, 1, 3), 0.25)),
            "observability": ([1], [2], [1]),
            "roughness_error": ([0.0], [2.0], [0.5]),
        }
        given = [{name: values[end] for name, values in ends.items()} for end in (0, 1)]
        first, second = (one(**arrays, radiance_color_space=LINEAR_REC709) for arrays in given)
        got = blend_clouds(first, second, 0.25)
        for name, values in ends.items():
            np.testing.assert_allclose(getattr(got, name), values[2], rtol=4 * EPSILON, atol=EPSILON, err_msg=name)
        assert blend_clouds(first, second, 0.75).observability[0] == 2

    def test_a_negative_quaternion_is_the_same_rotation(self):
        first = one(orientations=[[0.0, 0.0, 0.6, 0.8]])
        second = one(orientations=[[0.0, 0.0, -0.6, -0.8]])
        assert difference(blend_clouds(first, second, 0.5).orientations, first.orientations)[0] < 4 * EPSILON

    def test_opposite_normals_take_the_nearer(self):
        first, second = one(normals=[[0.0, 0.0, 1.0]]), one(normals=[[0.0, 0.0, -1.0]])
        assert blend_clouds(first, second, 0.5).normals[0, 2] == -1.0
        assert blend_clouds(first, second, np.nextafter(0.5, 0.0)).normals[0, 2] == 1.0

    def test_values_stay_in_range_under_rounding(self, rng):
        low = one(opacities=[np.float32(0.3)])
        high = one(opacities=[1.0])
        for share in np.append(rng.random(200), np.nextafter(np.float32(1.0), np.float32(0.0))):
            assert 0.0 <= blend_clouds(low, high, float(share)).opacities[0] <= 1.0

    def test_what_is_shared_is_passed_on_and_frames_are_as_they_are(self):
        colors = np.full((300, 3), 0.25, np.float32)
        first, second = sphere(base_color=colors), sphere(0.1, base_color=colors)
        sampler = TimeSampler(sequence(first, second))
        got = sampler.at(0.3)
        assert np.shares_memory(got.base_color, first.base_color)
        assert not np.shares_memory(got.positions, first.positions)
        assert sampler.at(0) is first
        assert sampler.at(1) is second
        assert sampler.at(1 / 30.0 * 30.0) is second
        assert sampler.at(1.0 - 1e-9) is second

    def test_equal_values_stay_bit_for_bit(self):
        got = blend_clouds(sphere(), sphere(0.1), 0.3)
        assert np.array_equal(got.scales, sphere().scales)
        assert np.array_equal(got.base_color, sphere().base_color)
        assert np.array_equal(got.ids, sphere().ids)


class TestReading:
    def counting(self, **options):
        """A sampler of four frames, and the frames that it has read."""
        clouds, read = [sphere(0.1 * i) for i in range(4)], []
        source = GaussianSequence(len(clouds), lambda frame: (read.append(frame), clouds[frame])[1])
        return TimeSampler(source, **options), read

    def test_each_frame_is_read_once_as_time_goes_on(self):
        sampler, read = self.counting()
        assert read == []
        for place in np.arange(0.0, 3.01, 0.25):
            sampler.at(place)
        assert read == [0, 1, 2, 3]

    def test_two_frames_are_kept(self):
        sampler, read = self.counting()
        for place in (0.5, 1.5, 0.5, 0.25, 1.0):
            sampler.at(place)
        assert read == [0, 1, 2, 0]

    def test_the_nearest_only(self):
        sampler, read = self.counting(blend="nearest")
        for place, turn in ((1.4, 0.1), (1.5, 0.2)):
            assert np.array_equal(sampler.at(place).positions, sphere(turn).positions)
        assert read == [1, 2]
        assert sampler.notes == ()


class TestEnds:
    def test_hold(self):
        clouds = [one(positions=[[x, 0.0, 0.0]]) for x in (0.0, 1.0, 5.0)]
        sampler = TimeSampler(sequence(*clouds))
        places = (-10.0, -0.5, 0.5, 1.5, 2.0, 2.5, 1e9)
        assert [sampler.at(place).positions[0, 0] for place in places] == [0.0, 0.0, 0.5, 3.0, 5.0, 5.0, 5.0]

    def test_loop_leads_from_the_last_to_the_first(self):
        clouds = [one(positions=[[x, 0.0, 0.0]]) for x in (0.0, 1.0, 5.0)]
        sampler = TimeSampler(sequence(*clouds), ends="loop")
        places = (2.5, 3.0, 3.5, -1.0, -0.5, 300.0)
        assert [sampler.at(place).positions[0, 0] for place in places] == [2.5, 0.0, 0.5, 5.0, 2.5, 0.0]

    @pytest.mark.parametrize("ends", ["hold", "loop"])
    def test_a_single_frame(self, ends):
        cloud = one()
        sampler = TimeSampler(sequence(cloud), ends=ends)
        assert all(sampler.at(place) is cloud for place in (-1.5, 0.0, 0.3, 7.7))

    @pytest.mark.parametrize("frame", [np.nan, np.inf])
    def test_no_time(self, frame):
        with pytest.raises(InvalidOptionError, match="frame must be a number in"):
            TimeSampler(sequence(one(), one())).at(frame)

    def test_words(self):
        with pytest.raises(InvalidOptionError, match="ends must be one of hold, loop, got 'bounce'"):
            TimeSampler(sequence(one()), ends="bounce")
        with pytest.raises(InvalidOptionError, match="blend must be one of identified, rows, nearest, got 'yes'"):
            TimeSampler(sequence(one()), blend="yes")


class TestFramesThatDoNotBlend:
    @pytest.mark.parametrize(
        ("first", "second", "why"),
        [
            (sphere(count=10), sphere(count=11), "different numbers of Gaussians"),
            (sphere(count=10), sphere(count=10, ids=np.arange(10)[::-1]), "Gaussians of different ids"),
            (sphere(count=10, ids=None), sphere(0.1, count=10, ids=None), "not known to correspond"),
            (sphere(count=10), sphere(count=10, roughness=None), "different arrays"),
            (sphere(count=10), sphere(count=10, axes="rub"), "different axes"),
            (sphere(count=10), sphere(count=0), "different numbers of Gaussians"),
        ],
    )
    def test_the_nearer_is_shown_and_one_note_says_so(self, first, second, why):
        sampler = TimeSampler(sequence(first, second))
        assert sampler.at(0.0) is first
        assert sampler.notes == ()
        assert sampler.at(0.49) is first
        assert sampler.at(0.5) is second
        assert len(sampler.notes) == 1
        assert why in sampler.notes[0]
        assert sampler.notes[0].endswith("the nearer frame is shown between frames")

    def test_rows_are_taken_at_their_word(self):
        first, second = sphere(count=10, ids=None), sphere(0.1, count=10, ids=None)
        assert len(TimeSampler(sequence(first, second), blend="rows").at(0.5)) == 10
        stated = GaussianSequence(2, (first, second).__getitem__, topology="constant")
        assert TimeSampler(stated).at(0.5) not in (first, second)

    def test_empty_frames(self):
        first, second = sphere(count=0), sphere(count=0)
        sampler = TimeSampler(sequence(first, second))
        assert len(sampler.at(0.5)) == 0
        assert sampler.notes == ()


def test_half_a_fraction_out_of_range():
    with pytest.raises(InvalidOptionError, match=r"fraction must be a number in \[0, 1\], got 1.5"):
        blend_clouds(one(), one(), 1.5)
