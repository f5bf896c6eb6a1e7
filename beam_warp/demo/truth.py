"""The truth of the demo: views of the figure by path tracing, and how near a decomposition comes to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.image.files import display_image
from beam_warp.image.metrics import SOLID_ALPHA, Score, compare, least_squares_scale, mean_scores
from beam_warp.image.panels import Panel, display_color, gray, lay_out, over_background
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.pixel_means import PixelMeans
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import samples_of_images
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import UNSHADOWED
from beam_warp.render.sheet import display_exposure
from beam_warp.trace.mesh_paths import TracedChannels, TracedMesh, trace_channels, trace_radiance
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.shot import Shot

CHANNEL_SAMPLES = 16


@dataclass(frozen=True, eq=False)
class DemoTruth:
    """The truth of a view: channels, coverage, and radiance by name of the light."""

    camera: Camera
    alpha: NDArray[np.float32]
    channels: TracedChannels
    radiance: Mapping[str, NDArray[np.float32]]

    @classmethod
    def of(cls, traced: TracedMesh, camera: Camera, lights: Mapping[str, EnvironmentMap], paths: int) -> DemoTruth:
        """Path trace a view under every light, at least one, with so many paths a pixel."""
        images = {name: trace_radiance(traced, camera, light, sample_count=paths) for name, light in lights.items()}
        channels = trace_channels(traced, camera, sample_count=CHANNEL_SAMPLES, visibility_count=CHANNEL_SAMPLES)
        alpha = next(iter(images.values())).alpha
        return cls(camera, alpha, channels, {name: image.rgb for name, image in images.items()})


@dataclass(frozen=True, eq=False)
class Relit:
    """What the Gaussians show in a view: channels and coverage, and radiance by light."""

    seen: PixelMeans
    radiance: Mapping[str, NDArray[np.float32]]


def relit_views(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    lights: Mapping[str, EnvironmentMap],
    *,
    raster: RasterOptions,
    device: str | None = None,
    prepared: Sequence[PreparedEnvironment] = (),
) -> list[Relit]:
    """Draw a relightable cloud for some cameras: its channels, and what deferred shading shows under each light.

    Lights of ``prepared`` are not prepared again.
    """
    side = samples_of_images(cloud, cameras, raster)
    options = replace(UNSHADOWED, samples=side)
    renderer = DeferredRenderer(options, raster=raster, device=device, prepared=prepared)
    views = []
    for camera in cameras:
        samples = rasterize(cloud, camera.supersampled(side), options=raster, device=device)
        shots = {name: Shot(cloud=cloud, camera=camera, environment=light) for name, light in lights.items()}
        radiance = {name: renderer.draw(shot).rgb for name, shot in shots.items()}
        views.append(Relit(PixelMeans.of(samples, side), radiance))
    return views


def score_views(truths: Sequence[DemoTruth], views: Sequence[Relit]) -> dict[str, Any]:
    """Return mean scores over views, unscaled, with the scale of base colour that would fit best beside them."""
    scores: dict[str, list[Score]] = {}
    scales, normals = [], []
    for truth, view in zip(truths, views, strict=True):
        found = view.seen.channels
        both: dict[str, Any] = {"alpha": view.seen.alpha, "truth_alpha": truth.alpha}
        for name, is_color in (("ambient_occlusion", False), ("base_color", True)):
            scores.setdefault(name, []).append(
                compare(found[name], getattr(truth.channels, name), is_color=is_color, premultiplied=False, **both)
            )
        for name, image in truth.radiance.items():
            scores.setdefault(f"relit_{name}", []).append(
                compare(view.radiance[name], image, is_color=True, premultiplied=True, **both)
            )
        solid = truth.alpha > SOLID_ALPHA
        scales.append(least_squares_scale(found["base_color"], truth.channels.base_color, solid))
        cosine = (found["normals"] * truth.channels.normals).sum(axis=-1)[solid]
        normals.append(float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))))
    return {
        **mean_scores(scores),
        "base_color_scale": np.mean(scales, axis=0).tolist(),
        "normals_median_error_degrees": float(np.mean(normals)),
    }


def comparison(truth: DemoTruth, view: Relit, lights: Mapping[str, EnvironmentMap]) -> NDArray[np.uint8]:
    """Draw ours above, truth below, for ambient occlusion, base colour and every light; 8-bit sRGB."""
    found, known = view.seen.channels, truth.channels
    pairs = [
        ("ambient occlusion", gray(found["ambient_occlusion"]), gray(known.ambient_occlusion)),
        ("base colour", display_image(found["base_color"]) / 255.0, display_image(known.base_color) / 255.0),
    ]
    for name, light in lights.items():
        stops = display_exposure(light)
        ours = display_color(view.radiance[name], view.seen.alpha, stops)
        pairs.append((name, ours, display_color(truth.radiance[name], truth.alpha, stops)))
    alphas = view.seen.alpha[..., None], truth.alpha[..., None]
    above: list[Panel] = [(f"{title}, ours", over_background(a, alphas[0])) for title, a, _ in pairs]
    below: list[Panel] = [(f"{title}, truth", over_background(b, alphas[1])) for title, _, b in pairs]
    return lay_out([*above, *below], len(pairs))
