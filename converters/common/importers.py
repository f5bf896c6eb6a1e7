"""Importers of splats in other programs: the files that each takes, and what it does with their axes and units.

Each row is what the importer's own source does, or its documentation where there is no source; `Importer.evidence` says
which. Files are prepared by this table, and `docs/engines.md` prints it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from beam_warp.errors import InvalidOptionError

RDF = "rdf"
"""Axes that 3DGS training writes, and that nearly every importer assumes: those of a file without a stated importer."""


@dataclass(frozen=True, kw_only=True)
class Importer:
    """One importer, or an engine by the importer that is meant.

    Attributes:
        name: Name in words.
        axes: Axes to write, with which the picture stands upright and is not mirrored.
        other_axes: The same for files with some endings, where they differ.
        units_per_meter: Units of the file in a metre.
        sh_degrees: Least and greatest degree of spherical harmonics that it reads rightly.
        suffixes: Ends of the names of files that it reads and `convert` may write.
        to_do: What the user must click or set.
        evidence: Where this was read.
        was_run: What was run by us, beyond reading; empty if nothing.
    """

    name: str
    axes: str = RDF
    other_axes: Mapping[str, str] = field(default_factory=dict, hash=False)
    units_per_meter: float = 1.0
    sh_degrees: tuple[int, int] = (0, 3)
    suffixes: tuple[str, ...]
    to_do: str
    evidence: str
    was_run: str = ""

    def axes_of(self, suffix: str) -> str:
        """Return the axes to write to a file whose name ends so."""
        return self.other_axes.get(suffix, self.axes)

    def sh_degree(self, stored: int, asked: int | None) -> int:
        """Return the degree to write: the one asked for, else the nearest to the stored one that is read rightly.

        Raises:
            InvalidOptionError: The degree that is asked for would be read wrongly.
        """
        least, greatest = self.sh_degrees
        if asked is not None and not least <= asked <= greatest:
            wanted = f"{least}" if least == greatest else f"{least} to {greatest}"
            raise InvalidOptionError(
                f"sh_degree must be {wanted} for {self.name}, got {asked}. Leave it out: the file is padded."
            )
        return min(max(stored, least), greatest) if asked is None else asked

    def require_reads(self, path: Path, suffix: str) -> None:
        """Refuse an output that this importer does not read.

        Raises:
            InvalidOptionError: It does not.
        """
        if suffix not in self.suffixes:
            raise InvalidOptionError(
                f"output's name must end in {' or '.join(self.suffixes)} for {self.name}, got {path.name}. "
                "Choose one of these."
            )


_IN_CHROMIUM = "run in headless Chromium, by `tests/web`"

_ARAS_P = Importer(
    name="aras-p UnityGaussianSplatting",
    axes="ruf",
    sh_degrees=(3, 3),
    suffixes=(".ply",),
    to_do="Tools › Gaussian Splats › Create GaussianSplatAsset. Leave the object's transform at its default.",
    evidence="source, 2c6fed3: values are taken as they are; 45 `f_rest` are assumed, so other degrees are padded",
)

_NANOGS = Importer(
    name="NanoGS (Unreal 5.6, 5.7)",
    suffixes=(".ply",),
    to_do="Import the PLY. Drag the asset into the level with scale 1.",
    evidence="source, 314b719: RDF metres are assumed, turned to Unreal's axes and multiplied by 100",
)

IMPORTERS: dict[str, Importer] = {
    "supersplat": Importer(
        name="SuperSplat",
        suffixes=(".ply", ".compressed.ply", ".splat", ".sog", ".spz"),
        to_do="Nothing.",
        evidence="source, cc6e86a, and pull request 885: a file is turned by 180° about z when it is loaded, SPZ too",
    ),
    "playcanvas": Importer(
        name="PlayCanvas 2.23",
        other_axes={".glb": "luf"},
        suffixes=(".ply", ".compressed.ply", ".sog", ".glb"),
        to_do="`entity.setLocalEulerAngles(0, 0, 180)`, but not for GLB, which is written as that leaves a PLY.",
        evidence="source, npm 2.23.0: values are taken as they are, in a world with y up",
        was_run=_IN_CHROMIUM,
    ),
    "spark": Importer(
        name="Spark 2.2 (three.js)",
        other_axes={".spz": "rub"},
        suffixes=(".ply", ".compressed.ply", ".splat", ".sog", ".spz"),
        to_do="`splats.quaternion.set(1, 0, 0, 0)`, but not for SPZ, which has y up.",
        evidence="documentation, npm 2.2.0: its examples turn the mesh by 180° about x",
        was_run=_IN_CHROMIUM,
    ),
    "mkkellogg": Importer(
        name="GaussianSplats3D 0.4.7 (three.js)",
        suffixes=(".ply", ".splat"),
        to_do="`new Viewer({cameraUp: [0, -1, 0]})`",
        evidence="source, eb2fc45: values are taken as they are; up is +y unless it is set",
        was_run=_IN_CHROMIUM,
    ),
    "babylon": Importer(
        name="Babylon.js 9",
        other_axes={".glb": "luf"},
        suffixes=(".ply", ".compressed.ply", ".splat", ".sog", ".spz", ".glb"),
        to_do="Nothing.",
        evidence="source, npm 8.56.2: y is negated, of SPZ too, in a left-handed world with y up; of GLB, x is",
        was_run=_IN_CHROMIUM,
    ),
    "aras-p": _ARAS_P,
    "gsplat-unity": Importer(
        name="gsplat-unity 1.3",
        axes="rub",
        suffixes=(".ply", ".spz"),
        to_do="Nothing: Source Coordinates is RUB by default. Set the project's colour space to Gamma.",
        evidence="source, 6627b74: signs of positions, rotations and harmonics follow Source Coordinates",
    ),
    "nanogs": _NANOGS,
    "houdini": Importer(
        name="GSOPs (Houdini)",
        axes="rub",
        suffixes=(".ply",),
        to_do="Leave Flip Axes of gsop::import off.",
        evidence="source, db8be8d: Flip Axes is off by default; what it does beyond its help text is unknown",
    ),
    "blender": Importer(
        name="KIRI 3DGS Render (Blender)",
        axes="rfu",
        suffixes=(".ply",),
        to_do="Import PLY. Do not press Rotate Active To Blender Axes, which is for RDF.",
        evidence="source, a753a5d: Blender's own PLY import with its default axes, in a world with z up",
    ),
    "usd": Importer(
        name="OpenUSD (usdview, Omniverse, Houdini, Nuke)",
        axes="rub",
        sh_degrees=(0, 4),
        suffixes=(".usd", ".usda", ".usdc", ".usdz"),
        to_do="Nothing: the file states its axes and units.",
        evidence="specification",
    ),
    "unity": _ARAS_P,
    "unreal": _NANOGS,
}
"""Importers by the name that `--for` takes; `unity` and `unreal` are words for the importers with public sources."""
