"""Options of readers and writers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from beam_warp.checks import require_choice, require_count, require_number
from beam_warp.converters.common.importers import IMPORTERS
from beam_warp.world.axes import require_axes

Activation = Literal["log", "linear"]
MaterialActivation = Literal["linear", "r3dg", "gsir", "irgs"]
Profile = Literal["standard", "beam"]


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Properties that a file does not state about itself; a value given here overrides what the file states.

    Attributes:
        source_axes: Axis code of the file (see `beam_warp.world.axes`).
        meters_per_unit: Length of one unit of the file [m].
        activation: ``log`` if scales are natural logs and opacities logits, as 3DGS training leaves them; ``linear``
            if both are linear. None means ``log``, with files that look linear refused.
        material_activation: Producer whose material channels the file holds, which determines how they are stored.
        drop_invalid: Leave out Gaussians with non-finite values or zero quaternions instead of refusing the file.

    Raises:
        InvalidOptionError: A value is outside its contract.
    """

    source_axes: str | None = None
    meters_per_unit: float | None = None
    activation: Activation | None = None
    material_activation: MaterialActivation | None = None
    drop_invalid: bool = False

    def __post_init__(self) -> None:
        """Check each option that is given."""
        if self.source_axes is not None:
            require_axes("source_axes", self.source_axes)
        if self.meters_per_unit is not None:
            require_number("meters_per_unit", self.meters_per_unit, 1e-6, 1e6)
        if self.activation is not None:
            require_choice("activation", self.activation, ("log", "linear"))
        if self.material_activation is not None:
            require_choice("material_activation", self.material_activation, ("linear", "r3dg", "gsir", "irgs"))


@dataclass(frozen=True, kw_only=True)
class WriteOptions:
    """Options of a writer.

    Attributes:
        target: Importer that the file is for, by its name in `beam_warp.converters.common.importers.IMPORTERS`: its
            axes, units and spherical harmonics are written. None writes ``rdf`` in metres, unless the format asks
            for others.
        axes: Axis code to write, whatever the importer; None for the importer's.
        profile: PLY only. ``standard`` is what every importer reads; ``beam`` appends the material channels.
        sh_degree: Degree of the written spherical harmonics, padded with zeros or cut; None keeps it.
        spz_version: SPZ only. 3 is read by nearly everything; 4 is smaller and also holds degree 4.
        full_float: USD only. Single precision throughout instead of half where half suffices.
        keyed: USD only. Time samples only where interpolation between others does not stay within the bounds of
            `beam_warp.converters.common.bounds`.
        error_scale: b4d, and USD with keys. Factor of all bounds on errors, in [0.01, 100].
        lighting_variants: USD only. Adds a variant whose radiance is the base colour, for renderers that light it.

    Raises:
        InvalidOptionError: A value is outside its contract.
    """

    target: str | None = None
    axes: str | None = None
    profile: Profile = "standard"
    sh_degree: int | None = None
    spz_version: int = 3
    full_float: bool = False
    lighting_variants: bool = False
    keyed: bool = False
    error_scale: float = 1.0

    def __post_init__(self) -> None:
        """Check each option."""
        if self.target is not None:
            require_choice("target", self.target, tuple(IMPORTERS))
        if self.axes is not None:
            require_axes("axes", self.axes)
        require_choice("profile", self.profile, ("standard", "beam"))
        if self.sh_degree is not None:
            require_count("sh_degree", self.sh_degree, 0, 3)
        require_number("error_scale", self.error_scale, 0.01, 100.0)
        require_count("spz_version", self.spz_version, 3, 4)
