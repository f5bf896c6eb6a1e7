"""Layout of an asset: the attribute name and USD types of each array, and when half precision is safe for it.

Writer, reader and rules share this table. Names and types follow OpenUSD's ParticleField schema
(26.03 and later) and schema.usda.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Vt

ASSET_PATH = "/Asset"
SPLATS_PATH = "/Asset/Splats"
MATERIAL_PATH = "/Asset/Material"
SPLAT_TYPE = "ParticleField3DGaussianSplat"

SH_DEGREE = "radiance:sphericalHarmonicsDegree"

UP_AXES = {"rub": "Y", "rfu": "Z"}
"""Axes that a stage can have, with the up axis that states them: both are right-handed with x to the right."""

HALF_MAX = 65504.0
"""Largest finite half."""

HALF_MIN_NORMAL = 2.0**-14
"""Smallest half that still has all 11 significant bits; below it the relative error grows without bound."""

HALF_EPSILON = 2.0**-11
"""Largest relative error of rounding a number in [HALF_MIN_NORMAL, HALF_MAX] to half."""


@dataclass(frozen=True)
class Channel:
    """One array of a cloud and its place in a file.

    Attributes:
        name: Field of `beam_warp.world.gaussians.GaussianCloud`, or ``metallic``, which a cloud does not hold.
        usd_name: Attribute of the float variant; that of the half variant has the suffix ``h``.
        type_name: USD type of the float variant, or of the only one.
        half_type_name: USD type of the half variant; None if there is none.
        columns: Components of one element.
        relative: True if small values must keep their relative precision. Half is then safe only if no value other
            than 0 is below `HALF_MIN_NORMAL`.
        position_like: True if the array is always written in float, since half would move centres by a millimetre.
        primvar: Primvar that shows the array to shading networks under a common name; empty if there is none. It has
            the same type and values: a binary layer stores equal arrays once, so it takes no space.
    """

    name: str
    usd_name: str
    type_name: str
    half_type_name: str | None
    columns: int = 1
    relative: bool = False
    position_like: bool = False
    primvar: str = ""

    @property
    def usd_names(self) -> tuple[str, ...]:
        """Names of all variants, the preferred one first."""
        return (self.usd_name,) if self.half_type_name is None else (self.usd_name, self.usd_name + "h")

    def half_is_safe(self, largest: float, smallest: float) -> bool:
        """Return True if half precision is safe for values whose non-zero magnitudes are in [smallest, largest].

        The error is then at most `HALF_EPSILON` relative or 2^-25 absolute, whichever is larger, and for
        a ``relative`` channel at most `HALF_EPSILON` relative for every element.
        """
        if self.half_type_name is None or self.position_like:
            return False
        return largest <= HALF_MAX and (not self.relative or smallest >= HALF_MIN_NORMAL)


CHANNELS: Mapping[str, Channel] = {
    channel.name: channel
    for channel in (
        Channel("positions", "positions", "point3f[]", "point3h[]", 3, position_like=True),
        Channel("orientations", "orientations", "quatf[]", "quath[]", 4),
        # A covariance divides by scales, so a thin axis needs its relative precision.
        Channel("scales", "scales", "float3[]", "half3[]", 3, relative=True),
        Channel("opacities", "opacities", "float[]", "half[]"),
        Channel("radiance", "radiance:sphericalHarmonicsCoefficients", "float3[]", "half3[]", 3),
        Channel("base_color", "beam:baseColor", "color3f[]", "color3h[]", 3, primvar="primvars:baseColor"),
        Channel("roughness", "beam:roughness", "float[]", "half[]", primvar="primvars:roughness"),
        Channel("metallic", "beam:metallic", "float[]", "half[]"),
        Channel("ambient_occlusion", "beam:ambientOcclusion", "float[]", "half[]", primvar="primvars:ambientOcclusion"),
        Channel("normals", "beam:normals", "normal3f[]", "normal3h[]", 3, primvar="primvars:normals"),
        Channel("normal_confidence", "beam:normalConfidence", "float[]", "half[]"),
        Channel("ambient_occlusion_error", "beam:ambientOcclusionError", "float[]", "half[]"),
        Channel("base_color_error", "beam:baseColorError", "float3[]", "half3[]", 3),
        Channel("roughness_error", "beam:roughnessError", "float[]", "half[]"),
        Channel("observability", "beam:observability", "uchar[]", None),
        Channel("ids", "beam:ids", "int64[]", None),
    )
}
"""Every array that a file can hold for each Gaussian, in file order."""

_VT_TYPES = {
    "point3f[]": Vt.Vec3fArray,
    "quatf[]": Vt.QuatfArray,
    "quath[]": Vt.QuathArray,
    "float3[]": Vt.Vec3fArray,
    "half3[]": Vt.Vec3hArray,
    "color3f[]": Vt.Vec3fArray,
    "color3h[]": Vt.Vec3hArray,
    "normal3f[]": Vt.Vec3fArray,
    "normal3h[]": Vt.Vec3hArray,
    "float[]": Vt.FloatArray,
    "half[]": Vt.HalfArray,
    "uchar[]": Vt.UCharArray,
    "int64[]": Vt.Int64Array,
}


def to_vt(type_name: str, array: NDArray[Any]) -> Any:
    """Convert rows to a USD array of a type; a quaternion row is i, j, k, real, as in our xyzw."""
    return _VT_TYPES[type_name].FromNumpy(np.ascontiguousarray(array))


def from_vt(channel: Channel, value: Any) -> NDArray[Any]:
    """Convert a USD array to rows ``(M,)`` or ``(M, columns)`` of its own precision.

    Raises:
        ValueError: It is a single value, or its elements have another number of components.
    """
    array = np.asarray(value)
    element = () if channel.columns == 1 else (channel.columns,)
    if not array.ndim or (array.size and array.shape[1:] != element):
        raise ValueError(f"shape {array.shape}")
    return array.reshape(-1, *element)
