"""Write what the Unity package reads of beam_warp: environments, blurred for every roughness, and its table of albedo.

    python engines/unity/prefilter.py hall.hdr hall.bytes

A lat-long image becomes the rows of 14 maps as 32-bit integers, then their texels, RGB, as 32-bit floats. Numbers are
little-endian. Maps are 13 levels of blurred radiance, the mirror's first, and irradiance; columns are twice the rows.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from beam_warp.image.files import replacing
from beam_warp.light.ggx import specular_albedo_table
from beam_warp.light.prefiltered import blurred_environment
from beam_warp.world.environment import EnvironmentMap

ALBEDO = Path(__file__).parent / "com.beam.relightable" / "Runtime" / "Resources" / "Beam" / "Albedo.bytes"


def prefiltered_bytes(environment: EnvironmentMap, device: str = "cpu") -> bytes:
    """Return the file of an environment."""
    light = blurred_environment(environment, device)
    irradiance = light.irradiance.numpy()
    rows = np.append(light.heights.numpy(), len(irradiance)).astype("<i4")
    texels = np.concatenate([light.texels.numpy(), irradiance.reshape(-1, 3)]).astype("<f4")
    return rows.tobytes() + texels.tobytes()


def albedo_bytes() -> bytes:
    """Return the table of specular albedo: (A, B, 0, 0) of 64 x 64, rows over roughness."""
    table = specular_albedo_table().reshape(-1, 2)
    return np.column_stack([table, np.zeros_like(table)]).astype("<f4").tobytes()


def main() -> None:
    """Write one environment, or the table."""
    parser = argparse.ArgumentParser(description="Write an environment for the Unity package.")
    parser.add_argument("image", nargs="?", type=Path, help="lat-long image; none: write the package's table of albedo")
    parser.add_argument("out", nargs="?", type=Path, help="file to write, .bytes")
    parser.add_argument("--device", default="cpu", help="Warp device")
    given = parser.parse_args()
    if given.image is None:
        ALBEDO.write_bytes(albedo_bytes())
        return
    out = given.out or given.image.with_suffix(".bytes")
    content = prefiltered_bytes(EnvironmentMap.read(given.image), given.device)
    with replacing(out) as temporary:
        temporary.write_bytes(content)


if __name__ == "__main__":
    main()
