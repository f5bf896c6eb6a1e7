"""What delivery as b4d costs and how far its relit images are from the asset's: a study of ``beam chart``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from beam_warp import converters
from beam_warp._version import __version__
from beam_warp.converters import WriteOptions
from beam_warp.device.arrays import resolve_device
from beam_warp.image.color import linear_to_srgb
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import UNSHADOWED
from beam_warp.study.table import Axis, Interval, Metric, Row, Settings, Study, StudySubject
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.shot import Shot

Images = list[NDArray[np.float32]]

RELIT, FLIP = "relit_error", "flip"

TURNS = (0.0, 180.0)
"""Rotations of the light [degree]; the camera goes around as well."""

MOST_SHOWN = 3
"""Frames whose relit images are compared."""

Difference = Callable[[NDArray[np.float32], NDArray[np.float32]], float]
"""A perceptual difference of display-referred images, 0 for equal ones."""


def delivery_study(
    sequence: GaussianSequence,
    environment: EnvironmentMap,
    *,
    name: str,
    scales: Sequence[float],
    side: int = 256,
    flip: Difference | None = None,
    device: str | None = None,
) -> Study:
    """Prepare the delivery study: sizes of containers of several bounds, and errors of their relit images.

    Args:
        sequence: A relightable asset.
        environment: Light of the images, also turned by half.
        name: What to call the asset.
        scales: Factors of all bounds; see `WriteOptions`.
        side: Width and height of images [pixel].
        flip: FLIP, where it is installed.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Raises:
        BeamError: The asset is not relightable.
    """
    target = str(resolve_device(device))
    raster = RasterOptions.from_metadata(sequence.metadata)
    shown = sorted({0, len(sequence) // 2, len(sequence) - 1})[:MOST_SHOWN]
    positions = change_axes(sequence[0], "rfu").positions
    renderer = DeferredRenderer(UNSHADOWED, raster=raster, device=target)

    def images(some: GaussianSequence) -> Images:
        found: Images = []
        for place, frame in enumerate(shown):
            cloud = change_axes(some[frame], "rfu")
            camera = Camera.frame_points(positions, azimuth=40.0 * place, elevation=10.0, width=side, height=side)
            for turn in TURNS:
                shot = Shot(cloud=cloud, camera=camera, environment=environment, environment_rotation=turn)
                found.append(linear_to_srgb(np.clip(renderer.draw(shot).rgb, 0.0, 1.0)).astype(np.float32))
        return found

    originals = images(sequence)
    truth = f"the asset's own images under the light and the light turned by 180°, frames: {len(shown)}"
    metrics = [
        Metric(
            RELIT, "RMS error of relit images", sentence=f"Against {truth}; display values; PSNR is -20 log10 of it."
        )
    ]
    if flip is not None:
        metrics.append(Metric(FLIP, "FLIP of relit images", sentence=f"Against {truth}; mean over images."))
    subject = StudySubject(
        name="delivery",
        title=f"Error against size of delivery: {name}, {len(positions):,} Gaussians, frames: {len(sequence)}",
        axes=(Axis("scale", "Error scale", tuple(sorted(scales)), sentence="beam-convert --error-scale."),),
        metrics=tuple(metrics),
        cost="Size of a frame",
        cost_unit="KB",
        ladder="scale",
        notes={
            "Truth": truth,
            "Renderer": "deferred, without shadow maps",
            "Error bars": "95 %, bootstrap over images; of FLIP, lowest to highest",
            "Versions": f"beam-warp {__version__}",
        },
    )

    def measure(settings: Settings) -> Row:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "take.b4d"
            converters.write(sequence, path, WriteOptions(error_scale=float(settings["scale"])))
            size = path.stat().st_size / 1e3 / len(sequence)
            back = converters.read(path)
            found = images(replace(back, metadata={**back.metadata, **raster.as_metadata()}))
        seen = [original.max(axis=2) > 0.0 for original in originals]
        squares = [np.square(a - b)[mask].sum() for a, b, mask in zip(found, originals, seen, strict=True)]
        errors = {RELIT: Interval.of_root_mean_square(squares, [3.0 * mask.sum() for mask in seen])}
        if flip is not None:
            differences = [flip(image, original) for image, original in zip(found, originals, strict=True)]
            errors[FLIP] = Interval(float(np.mean(differences)), min(differences), max(differences))
        return Row(settings, Interval.of_median([size]), errors)

    return Study(subject, [{"scale": scale} for scale in scales], measure, lambda settings: 1)
