"""Reader of the delivery container b4d, by the decoder beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from beam_warp.converters.common.frames import DecodedFrame, sequence_of
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.delivery.decoder import Container, DeliveryError
from beam_warp.errors import AssetFormatError
from beam_warp.image.color import COLOR_SPACES
from beam_warp.world.axes import AXIS_CODES
from beam_warp.world.gaussians import GaussianSequence

MAX_METADATA = 256
"""Most entries of the metadata."""


def read(path: Path, options: ReadOptions) -> GaussianSequence:
    """Read a take; its segments are unpacked when a frame of them is asked for.

    Raises:
        AssetFormatError: The container was cut short or altered, or is malformed; the message names the file in it.
    """
    try:
        container = Container(path)
    except DeliveryError as error:
        raise AssetFormatError(f"{path.name}: {error}") from error
    said = container.manifest
    names = [f"{path.name}, frame {frame}" for frame in range(said["frames"])]
    sequence = sequence_of(path.name, names, lambda frame: _decoded(container, path, frame), options)
    kept = said.get("metadata")
    metadata = {k: v for k, v in [*kept.items()][:MAX_METADATA] if isinstance(v, str)} if isinstance(kept, dict) else {}
    is_identified = len(names) == 1 or said.get("topology") == "constant"
    return replace(
        sequence,
        constant=frozenset(),
        topology="constant" if is_identified else "perFrame",
        metadata={**sequence.metadata, **metadata},
    )


def _decoded(container: Container, path: Path, frame: int) -> DecodedFrame:
    """Return one frame as the formats with a file a frame have it."""
    try:
        arrays = container.frame(frame)
    except DeliveryError as error:
        raise AssetFormatError(f"{path.name}: {error}") from error
    said = container.manifest
    fields: dict[str, Any] = {name: values.T for name, values in arrays.items() if not name.startswith("radiance")}
    fields |= {name: fields[name][:, 0] for name in fields.keys() & {"opacities", "roughness", "ambient_occlusion"}}
    bands = [arrays[f"radiance_{k}"].T for k in range(25) if f"radiance_{k}" in arrays]
    if bands:
        space = said.get("radianceColorSpace")
        if space not in COLOR_SPACES:
            got = f"{path.name}: radianceColorSpace must be one of {', '.join(COLOR_SPACES)}, got {space!r:.40}"
            raise AssetFormatError(f"{got}. Export it again.")
        fields |= {"radiance": np.stack(bands, axis=1), "radiance_color_space": space}
    axes = said.get("axes")
    if axes not in AXIS_CODES:
        raise AssetFormatError(f"{path.name}: axes must be a code such as rub, got {axes!r:.40}. Export it again.")
    return DecodedFrame(
        fields=fields,
        format="b4d version 1",
        producer=_text(said.get("generator")),
        axes=axes,
        frames_per_second=float(said["rate"]),
        color_space_is_stated=True,
    )


def _text(value: object) -> str:
    """Return a text of the manifest as far as it prints."""
    return "".join(c for c in value[:80] if c.isprintable()) if isinstance(value, str) else "unknown"
