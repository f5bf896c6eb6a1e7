"""Environment maps: one-hot texels both ways, energy, rotation, irradiance against the full float64 sum."""

import numpy as np
import pytest
import warp as wp
from reference.latlong import lookup

from beam_warp.errors import AssetFormatError, InvalidArrayError, InvalidOptionError, MissingFileError
from beam_warp.image.files import write_exr
from beam_warp.kernels.light.latlong import (
    direction_to_latlong,
    latlong_bilinear,
    latlong_nearest,
    latlong_to_direction,
)
from beam_warp.world.environment import EnvironmentMap, texel_directions

FLOAT32 = np.finfo(np.float32).eps


def one_hot(height, row, column, value=1.0):
    radiance = np.zeros((height, 2 * height, 3), np.float32)
    radiance[row, column] = value
    return EnvironmentMap(radiance)


def write_environment(path, radiance):
    write_exr(path, {name: radiance[..., index] for index, name in enumerate("RGB")})


@wp.kernel(enable_backward=False)
def probe_kernel(
    texels: wp.array2d[wp.vec3],
    directions: wp.array[wp.vec3],
    nearest: wp.array[wp.vec3],
    bilinear: wp.array[wp.vec3],
    back: wp.array[wp.vec3],
):
    i = wp.tid()
    nearest[i] = latlong_nearest(texels, directions[i])
    bilinear[i] = latlong_bilinear(texels, directions[i])
    uv = direction_to_latlong(directions[i])
    back[i] = latlong_to_direction(uv[0], uv[1])


def probe(environment, directions, device):
    texels = wp.array(environment.radiance, dtype=wp.vec3, device=device)
    points = wp.array(directions.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)
    out = [wp.empty(len(points), dtype=wp.vec3, device=device) for _ in range(3)]
    wp.launch(probe_kernel, dim=len(points), inputs=[texels, points], outputs=out, device=device)
    return [array.numpy().reshape(directions.shape) for array in out]


class TestMapping:
    def test_axes(self):
        # Columns centred on the axes: with u = 0.5 - φ / 2π the middle of the image is +x, its left quarter +y.
        environment = EnvironmentMap(np.arange(16 * 32 * 3, dtype=np.float32).reshape(16, 32, 3))
        step = 1e-3
        for direction, column in (((1, -step, 0), 16), ((step, 1, 0), 8), ((-step, -1, 0), 24), ((-1, step, 0), 0)):
            unit = np.array(direction) / np.linalg.norm(direction)
            np.testing.assert_array_equal(lookup(environment, unit), environment.radiance[8, column])
        assert lookup(environment, [0.0, 0.0, 1.0])[0] in environment.radiance[0, :, 0]
        assert lookup(environment, [0.0, 0.0, -1.0])[0] in environment.radiance[15, :, 0]

    @pytest.mark.parametrize(("row", "column"), [(0, 0), (7, 15), (3, 8)])
    def test_one_hot_texel_both_ways(self, device, row, column):
        environment = one_hot(8, row, column)
        directions = environment.directions()
        hot = np.zeros((8, 16, 3))
        hot[row, column] = 1.0
        np.testing.assert_array_equal(lookup(environment, directions), hot)
        nearest, bilinear, back = probe(environment, directions, device)
        np.testing.assert_array_equal(nearest, hot)
        # Bilinear weights at a centre are 0 and 1 but for u, v in float32, spread over 16 columns.
        np.testing.assert_allclose(bilinear, hot, atol=32 * FLOAT32)
        np.testing.assert_allclose(back, directions, atol=8 * FLOAT32)

    def test_twins_agree_everywhere(self, device, rng):
        environment = EnvironmentMap(rng.random((16, 32, 3)))
        directions = rng.normal(size=(4000, 3))
        directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
        nearest, _, _ = probe(environment, directions, device)
        wrong = (nearest != lookup(environment, directions)).any(axis=1)
        # A texel's edges hold float32 rounding of a few 1e-7 of its width: no direction in 4,000 is expected there.
        assert wrong.sum() <= 1


class TestEnergy:
    @pytest.mark.parametrize("height", [4, 7, 256])
    def test_solid_angles_sum_to_the_sphere(self, height):
        environment = EnvironmentMap.constant([1, 2, 3], height=height)
        assert environment.solid_angles().sum() == pytest.approx(4 * np.pi, rel=1e-12)
        np.testing.assert_allclose(environment.mean_radiance(), [1, 2, 3], rtol=1e-6)

    @pytest.mark.parametrize("height", [4, 15, 33])
    def test_resizing_keeps_energy(self, rng, height):
        environment = EnvironmentMap(rng.random((16, 32, 3)))
        resized = environment.resized(height, 2 * height)
        np.testing.assert_allclose(resized.mean_radiance(), environment.mean_radiance(), rtol=1e-6)

    def test_resizing_up_by_a_whole_factor_repeats(self, rng):
        environment = EnvironmentMap(rng.random((8, 16, 3)))
        up = environment.resized(24, 48)
        np.testing.assert_allclose(up.radiance, environment.radiance.repeat(3, 0).repeat(3, 1), rtol=1e-6)
        np.testing.assert_allclose(up.resized(8, 16).radiance, environment.radiance, rtol=1e-6)

    def test_resizing_refuses_other_shapes(self):
        with pytest.raises(InvalidArrayError, match="twice as wide as high"):
            one_hot(4, 0, 0).resized(8, 8)

    def test_gain(self):
        environment = EnvironmentMap.constant([1, 2, 3])
        np.testing.assert_array_equal(environment.exposed(3).radiance, environment.scaled(8).radiance)
        with pytest.raises(InvalidOptionError, match="factor must be a number in"):
            environment.scaled(-1)
        with pytest.raises(InvalidArrayError, match="radiance must be finite and not negative, got"):
            environment.scaled(3e38)


class TestRotation:
    def test_quarter_turn_takes_x_to_y(self):
        environment = one_hot(8, 3, 7)  # just to the left of +x: φ = +11.25°
        turned = environment.rotated(90.0)
        direction = environment.directions()[3, 7]
        x, y, z = direction
        np.testing.assert_array_equal(lookup(turned, [-y, x, z]), [1, 1, 1])
        assert turned.radiance.sum() == 3

    def test_whole_texels_are_exact_and_turns_add(self, rng):
        environment = EnvironmentMap(rng.random((6, 12, 3)))
        np.testing.assert_array_equal(environment.rotated(360).radiance, environment.radiance)
        for steps in range(-13, 14):
            turned = environment.rotated(steps * 30.0)
            np.testing.assert_array_equal(turned.radiance, np.roll(environment.radiance, -steps, axis=1))
            np.testing.assert_array_equal(turned.rotated(-30.0 * steps).radiance, environment.radiance)

    def test_other_angles_keep_each_row_and_move_the_centroid(self):
        environment = one_hot(8, 3, 7)
        turned = environment.rotated(10.0)
        np.testing.assert_allclose(turned.radiance.sum(axis=1), environment.radiance.sum(axis=1), rtol=2 * FLOAT32)
        columns = (turned.radiance[3, :, 0] * np.arange(16)).sum()
        assert columns == pytest.approx(7 - 10.0 / 22.5, abs=16 * float(FLOAT32))

    def test_refuses_nan(self):
        with pytest.raises(InvalidOptionError, match="degrees must be a number"):
            one_hot(4, 0, 0).rotated(float("nan"))


def irradiance_twin(environment, normals):
    """Full-resolution float64 sum with solid angles and texel centres."""
    weights = environment.radiance.astype(np.float64) * environment.solid_angles()[..., None]
    cosines = np.maximum(normals.reshape(-1, 3) @ environment.directions().reshape(-1, 3).T, 0.0)
    return (cosines @ weights.reshape(-1, 3)).reshape(normals.shape)


class TestIrradiance:
    @pytest.mark.parametrize(("height", "size"), [(4, (16, 32)), (45, (64, 128)), (64, (16, 32))])
    def test_uniform_light_gives_pi(self, height, size):
        irradiance = EnvironmentMap.constant([1, 2, 0], height=height).irradiance_map(*size)
        expected = np.broadcast_to([np.pi, 2 * np.pi, 0], (*size, 3))
        # The stated bound is δ²/12 for rows of δ = π/512, and float32 storage.
        np.testing.assert_allclose(irradiance, expected, rtol=3.2e-6 + FLOAT32, atol=1e-12)

    def test_hot_sun(self, rng):
        radiance = rng.random((128, 256, 3)).astype(np.float32)
        radiance[30, 50] = 2e5
        radiance[31, 50] = 1e5
        environment = EnvironmentMap(radiance)
        # The oracle takes a texel for a point; on 512 rows it is a quarter of ours, and its error a few 1e-5.
        fine = environment.resized(512, 1024)
        for size in ((4, 8), (5, 7)):
            expected = irradiance_twin(fine, texel_directions(*size))
            np.testing.assert_allclose(environment.irradiance_map(*size), expected, rtol=1e-4)

    def test_one_texel_is_a_cosine(self):
        environment = one_hot(512, 160, 240)
        irradiance = environment.irradiance_map()[..., 0]
        cosine = texel_directions(64, 128) @ environment.directions()[160, 240]
        # Normals off the horizon by more than the texel: its centroid is within δ²/12 of its centre, δ = π/512.
        lit = cosine > np.pi / 512
        expected = cosine[lit] * environment.solid_angles()[160, 240]
        np.testing.assert_allclose(irradiance[lit], expected, atol=expected.max() * (np.pi / 512) ** 2 / 12)
        assert irradiance[cosine < -np.pi / 512].max() < 1e-6 * expected.max()


class TestReading:
    def test_exr_round_trip(self, tmp_path, rng):
        radiance = rng.random((4, 8, 3)).astype(np.float32)
        write_environment(tmp_path / "a.exr", radiance)
        np.testing.assert_array_equal(EnvironmentMap.read(tmp_path / "a.exr").radiance, radiance)

    def test_the_captures_light_has_its_documented_mean(self, data_dir):
        environment = EnvironmentMap.read(data_dir / "captures/walker/environment.exr")
        luminance = environment.mean_radiance() @ [0.2126, 0.7152, 0.0722]
        assert luminance == pytest.approx(0.8, rel=1e-6)

    @pytest.mark.parametrize("value", [np.nan, -1.0])
    def test_bad_texel_is_named(self, tmp_path, value):
        radiance = np.ones((4, 8, 3), np.float32)
        radiance[2, 5, 1] = value
        write_environment(tmp_path / "a.exr", radiance)
        place = r"got \[1\.0, .*, 1\.0\] at row 2, column 5 \(1 texels in all\) in .*a\.exr\. Mend those texels\."
        with pytest.raises(AssetFormatError, match=f"environment must be finite and not negative, {place}"):
            EnvironmentMap.read(tmp_path / "a.exr")
        with pytest.raises(InvalidArrayError, match="at row 2, column 5"):
            EnvironmentMap(radiance)

    @pytest.mark.parametrize("shape", [(4, 4), (3, 6), (8, 4)])
    def test_other_shapes(self, tmp_path, shape):
        write_environment(tmp_path / "a.exr", np.ones((*shape, 3), np.float32))
        with pytest.raises(AssetFormatError, match=rf"got {shape[1]} x {shape[0]} in .*a\.exr"):
            EnvironmentMap.read(tmp_path / "a.exr")

    def test_refuses_other_channels_and_files(self, tmp_path):
        write_exr(tmp_path / "a.exr", {"depth": np.ones((4, 8))})
        with pytest.raises(AssetFormatError, match="must have the channels R, G, B, got depth"):
            EnvironmentMap.read(tmp_path / "a.exr")
        with pytest.raises(AssetFormatError, match=r"an \.exr or \.hdr file, got .*a\.png"):
            EnvironmentMap.read(tmp_path / "a.png")
        with pytest.raises(MissingFileError, match="no such file"):
            EnvironmentMap.read(tmp_path / "b.exr")
        with pytest.raises(InvalidArrayError, match=r"radiance must have shape \(N, N, 3\), got \(4, 8\)"):
            EnvironmentMap(np.ones((4, 8)))

    def test_the_record_does_not_change_with_its_source(self):
        source = np.ones((4, 8, 3), np.float32)
        environment = EnvironmentMap(source)
        source[:] = 5
        assert environment.radiance.max() == 1
        assert not environment.radiance.flags.writeable


def test_default_irradiance_is_carried_along(rng):
    environment = EnvironmentMap(rng.random((64, 128, 3)).astype(np.float32))
    _ = environment.default_irradiance
    turned = environment.scaled(3.0).rotated(90.0)
    fresh = EnvironmentMap(turned.radiance)
    # the same sums in another order of columns: float32 of the result
    np.testing.assert_allclose(turned.default_irradiance, fresh.default_irradiance, rtol=2e-6)
