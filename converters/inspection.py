"""Inspection of a file: its contents, what it does not state, and the evidence for what a reader assumes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beam_warp.converters.common.frames import ASSUMED_AXES, DecodedFrame
from beam_warp.converters.common.importers import RDF
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.common.vertical import CONTRADICTION, likely_axes, vertical_of
from beam_warp.converters.formats import format_of
from beam_warp.converters.numbering import files_at
from beam_warp.world.axes import handedness
from beam_warp.world.gaussians import MATERIAL_CHANNELS, GaussianCloud, GaussianSequence

_INVISIBLE = 1.0 / 255.0
"""Opacities below this are invisible in an 8-bit picture."""


@dataclass(frozen=True)
class ValueRange:
    """Least value, median and greatest value."""

    least: float
    median: float
    greatest: float

    def __str__(self) -> str:
        """Return ``least … greatest, median``."""
        return f"{self.least:.4g} … {self.greatest:.4g}, median {self.median:.4g}"


@dataclass(frozen=True)
class Inspection:
    """Facts about one file or folder.

    Attributes:
        name: File or folder name.
        format: Container, encoding and layout.
        producer: Program that wrote it, with the evidence.
        frame_count: Number of frames; the values below are those of the first.
        frames_per_second: Playback rate.
        gaussian_count: Number of Gaussians.
        axes: Axis code that a reader will use.
        axes_evidence: Evidence for or against these axes, a sentence each.
        bounds: Least and greatest corner of the centres [m], or None without Gaussians.
        scales: Standard deviations [m], linear.
        opacities: Peak alphas, linear.
        sh_degree: Degree of the captured radiance, or None without one.
        color_state: Meaning and colour space of the colour.
        materials: Material channels that a reader returns.
        comments: Header comments of a PLY.
        notes: Assumptions and omissions of the reader, and unusual values.
    """

    name: str
    format: str
    producer: str
    frame_count: int
    frames_per_second: float
    gaussian_count: int
    axes: str
    axes_evidence: tuple[str, ...]
    bounds: tuple[tuple[float, ...], tuple[float, ...]] | None
    scales: ValueRange | None
    opacities: ValueRange | None
    sh_degree: int | None
    color_state: str
    materials: tuple[str, ...]
    comments: tuple[str, ...]
    notes: tuple[str, ...]

    def as_text(self) -> str:
        """Return one line for each fact."""
        frames = f"{self.frame_count} at {self.frames_per_second:g} per second" if self.frame_count > 1 else "1"
        rows = [
            ("file", self.name),
            ("format", self.format),
            ("producer", self.producer),
            ("frames", frames),
            ("Gaussians", f"{self.gaussian_count:,}" + (" in the first frame" if self.frame_count > 1 else "")),
        ]
        if self.bounds is not None:
            size = np.subtract(self.bounds[1], self.bounds[0])
            rows += [
                ("bounds [m]", " to ".join(f"({', '.join(f'{v:.3f}' for v in corner)})" for corner in self.bounds)),
                ("size [m]", " × ".join(f"{v:.3f}" for v in size)),
                ("scale [m]", str(self.scales)),
                ("opacity", str(self.opacities)),
            ]
        rows += [
            ("SH degree", "none" if self.sh_degree is None else str(self.sh_degree)),
            ("colour", self.color_state),
            ("materials", ", ".join(self.materials) or "none"),
            ("axes", f"{self.axes}, {handedness(self.axes)}-handed"),
            *(("", line) for line in self.axes_evidence),
            *(("comment", line) for line in self.comments),
            *(("note", line) for line in self.notes),
        ]
        return "\n".join(f"{label:<11} {value}" for label, value in rows)


def inspect(sequence: GaussianSequence, path: Path) -> Inspection:
    """Describe the file or folder that a sequence was read from.

    Args:
        sequence: Result of `beam_warp.converters.read`; only its first frame is read.
        path: Path that it was read from.

    Raises:
        AssetFormatError: The first frame is malformed.
    """
    files = files_at(path)
    form = format_of(files[0])
    decoded = None if form.holds_sequences else form.of_reader("decode")(files[0], ReadOptions())
    cloud = sequence[0]
    said = sequence.metadata.get("notes", "").splitlines()
    notes = [line for line in said if not line.startswith((ASSUMED_AXES, CONTRADICTION))]
    assumed = any(line.startswith(ASSUMED_AXES) for line in said)
    if assumed:
        notes.append("one unit is taken as 1 m; pass --meters-per-unit when converting if it is another")
    kind = f"{form.name} ({files[0].suffix.lower()})" if decoded is None else decoded.format
    return Inspection(
        name=path.name,
        format=f"{kind}, one file per frame" if len(files) > 1 else kind,
        producer=sequence.metadata.get("producer", "unknown"),
        frame_count=len(sequence),
        frames_per_second=sequence.frames_per_second,
        gaussian_count=len(cloud),
        axes=cloud.axes,
        axes_evidence=_axes_evidence(cloud) if assumed else ("stated by the file",),
        bounds=_bounds(cloud),
        scales=_value_range(cloud.scales),
        opacities=_value_range(cloud.opacities),
        sh_degree=cloud.sh_degree,
        color_state=_color_state(cloud, decoded),
        materials=tuple(name for name in MATERIAL_CHANNELS if getattr(cloud, name) is not None),
        comments=() if decoded is None else decoded.comments,
        notes=(*notes, *_oddities(cloud)),
    )


def _value_range(values: np.ndarray) -> ValueRange | None:
    if not values.size:
        return None
    return ValueRange(float(values.min()), float(np.median(values)), float(values.max()))


def _bounds(cloud: GaussianCloud) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    if not len(cloud):
        return None
    return tuple(cloud.positions.min(axis=0).tolist()), tuple(cloud.positions.max(axis=0).tolist())


def _color_state(cloud: GaussianCloud, decoded: DecodedFrame | None) -> str:
    if cloud.radiance is None:
        return "none"
    stated = decoded is None or decoded.color_space_is_stated
    return f"captured radiance, {cloud.radiance_color_space}" + ("" if stated else " (the usual; not stated)")


def _axes_evidence(cloud: GaussianCloud) -> tuple[str, ...]:
    """Return what the shape tells about the vertical: the tallest axis, and which of its ends is at the origin."""
    lines = [f"not stated by the file: {RDF} is what 3DGS training writes; pass --source-axes to say otherwise"]
    vertical = vertical_of(cloud)
    if vertical is None:
        return tuple(lines)
    extents = " × ".join(f"{high - low:.2f}" for low, high in zip(vertical.low, vertical.high, strict=True))
    if vertical.axis is None:
        lines.append(f"the shape has no tall axis (98 % within {extents}): it says nothing of the vertical")
        return tuple(lines)
    name = "xyz"[vertical.axis]
    lines.append(f"tallest along {name} (98 % within {extents}): {name} is the vertical if the subject stands")
    if vertical.points is not None:
        low, high = vertical.low[vertical.axis], vertical.high[vertical.axis]
        way = "up" if vertical.points == "u" else "down"
        lines.append(f"it spans {low:.2f} … {high:.2f}: {name} points {way} if it stands at 0")
        agrees = cloud.axes[vertical.axis] == vertical.points
        remedy = "" if agrees else f": pass --source-axes {likely_axes(vertical)}"
        lines.append(f"which {'agrees with' if agrees else 'contradicts'} {cloud.axes}{remedy}")
    return tuple(lines)


def _oddities(cloud: GaussianCloud) -> list[str]:
    """Return notes on values that are valid but unusual."""
    if not len(cloud):
        return []
    notes = []
    invisible = int(np.count_nonzero(cloud.opacities < _INVISIBLE))
    if invisible:
        notes.append(f"{invisible:,} Gaussians ({invisible / len(cloud):.1%}) are less than 1/255 opaque")
    low, high = np.quantile(cloud.positions, [0.01, 0.99], axis=0)
    reach = float(np.max(high - low))
    middle = (low + high) / 2.0
    far = int(np.count_nonzero(np.abs(cloud.positions - middle).max(axis=1) > 5.0 * reach)) if reach > 0.0 else 0
    if far:
        notes.append(f"{far:,} Gaussians lie more than 5 × the size of the middle 98 % away from it")
    return notes
