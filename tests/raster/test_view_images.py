"""Images handed over by DLPack: the same memory, view by view; and what is said where an optional package is absent."""

import importlib
import sys

import numpy as np
import pytest
from support.raster_clouds import cloud

from beam_warp.errors import BeamError, InvalidOptionError, MissingPackageError
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.sources import upload_gaussians
from beam_warp.raster.view_images import view_images
from beam_warp.world.camera import Camera


def drawn(device, rng, value_count=5):
    """A rasteriser that has drawn colours, normals and values for two cameras of different sizes."""
    cameras = [
        Camera.orbit((0, 0, 0), 3.0, 20.0 * i, 10.0, width=width, height=height, vertical_fov=40.0)
        for i, (width, height) in enumerate([(24, 17), (9, 20)])
    ]
    rasterizer = Rasterizer(60, cameras, value_count=value_count, radiance=True, normals=True, device=device)
    values = rng.uniform(0, 1, (60, value_count)).astype(np.float32)
    radiance = rng.normal(size=(60, 4, 3)).astype(np.float32)
    rasterizer.draw(upload_gaussians(cloud(rng, 60), rasterizer.device, values=values, radiance=radiance))
    return rasterizer


def test_views_are_the_memory_of_the_images(device, rng):
    rasterizer = drawn(device, rng)
    images = rasterizer.images
    views = view_images(rasterizer)
    assert [view.alpha.shape for view in views] == [(17, 24), (20, 9)]
    for view, first, end in zip(views, rasterizer.first_pixels[:-1], rasterizer.first_pixels[1:], strict=True):
        for name in ("alpha", "depth", "median_depth"):
            assert getattr(view, name).ptr == getattr(images, name).ptr + 4 * first
            np.testing.assert_array_equal(
                getattr(view, name).numpy().reshape(-1), getattr(images, name).numpy()[first:end]
            )
        np.testing.assert_array_equal(view.gaussian_ids.numpy().reshape(-1), rasterizer.gaussian_ids.numpy()[first:end])
        rows = images.channels[0].numpy()[first:end].reshape(*view.alpha.shape, -1)
        for channels in (rasterizer.color_channels, rasterizer.normal_channels, rasterizer.value_channels):
            selected = view.select(channels)
            assert selected.ptr == view.channels[0].ptr + 4 * channels.start
            np.testing.assert_array_equal(selected.numpy(), rows[..., channels.start : channels.stop])


def test_numpy_shares_them(rng):
    rasterizer = drawn("cpu", rng)
    view = view_images(rasterizer)[1]
    shared = np.from_dlpack(view.select(rasterizer.value_channels))
    assert shared.shape == (20, 9, 5)
    assert shared.strides == (9 * 12 * 4, 12 * 4, 4)
    assert shared.__array_interface__["data"][0] == view.channels[0].ptr + 4 * 6
    assert shared.max() > 0.0
    view.channels[0].zero_()
    assert shared.max() == 0.0


def test_jax_reads_them(device, rng):
    jnp = pytest.importorskip("jax.numpy")
    rasterizer = drawn(device, rng)
    view = view_images(rasterizer)[0]
    colors = jnp.from_dlpack(view.channels[0])[:, :, 0:3]
    np.testing.assert_array_equal(np.asarray(colors), view.select(rasterizer.color_channels).numpy())
    np.testing.assert_array_equal(np.asarray(jnp.from_dlpack(view.alpha)), view.alpha.numpy())


def test_channels_of_two_passes_are_selected_from_each(device, rng):
    rasterizer = drawn(device, rng, value_count=14)
    view = view_images(rasterizer)[0]
    assert [image.shape for image in view.channels] == [(17, 24, 16), (17, 24, 4)]
    second = view.select(range(16, 20))
    assert second.ptr == view.channels[1].ptr
    with pytest.raises(InvalidOptionError, match=r"channels must lie in one pass of the lengths \[16, 4\], got range"):
        view.select(rasterizer.value_channels)


@pytest.mark.parametrize(
    "needs_torch",
    [
        lambda: importlib.import_module("beam_warp.interop").rasterization,
        lambda: importlib.import_module("beam_warp.interop.torch"),
    ],
)
def test_what_needs_torch_says_what_to_install(monkeypatch, needs_torch):
    for name in [n for n in sys.modules if n.partition(".")[0] == "torch" or n.startswith("beam_warp.interop")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)  # as if it were not installed
    with pytest.raises(
        MissingPackageError, match=r"torch must be installed .* pip install 'beam-warp\[interop\]'"
    ) as e:
        needs_torch()
    assert isinstance(e.value, BeamError)
    assert isinstance(e.value, ImportError)
