"""A painted ball under the demo's lights, and what views show of it, by formulas written anew.

What the points show is computed here in float64 over every texel of the light.
"""

from dataclasses import dataclass

import numpy as np

from beam_warp.demo.lights import demo_environments
from beam_warp.materials.light_fits import LIGHT_ROWS, LightEvidence
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.shapes import sphere_zone

LIGHTS = {name: light.resized(32, 64) for name, light in demo_environments().items()}


def shaded(normals, views, base_color, roughness, light):
    """Radiance of points of a convex body towards views, ``(V, M, 3)``: Lambert and GGX with F0 = 0.04."""
    texels = light.directions().reshape(-1, 3)
    power = light.radiance.reshape(-1, 3) * light.solid_angles().reshape(-1, 1)
    cosine = np.maximum(normals @ texels.T, 0.0)
    seen = np.zeros((len(views), len(normals), 3))
    diffuse = base_color * (cosine @ power) / np.pi
    alpha2 = roughness**4
    for k, view in enumerate(views):
        facing = normals @ view
        half = texels + view
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        n_h = normals @ half.T
        fresnel = 0.04 + 0.96 * (1.0 - half @ view) ** 5
        spread = alpha2 / (np.pi * (n_h**2 * (alpha2 - 1.0) + 1.0) ** 2)
        out = np.maximum(facing, 1e-3)[:, None]
        masking = 0.5 / np.maximum(
            cosine * np.sqrt(out**2 * (1 - alpha2) + alpha2) + out * np.sqrt(cosine**2 * (1 - alpha2) + alpha2), 1e-9
        )
        seen[k] = 0.94 * diffuse + (spread * masking * fresnel * cosine) @ power
    return seen


@dataclass
class Ball:
    """A ball of patches of several colours, seen from around."""

    normals: np.ndarray
    views: np.ndarray
    base_color: np.ndarray
    roughness: float = 0.5

    @classmethod
    def of(cls, count=400, roughness=0.5, seed=3):
        normals = sphere_zone(np.zeros(3), 1.0, -1.0, 1.0, np.sqrt(4.0 * np.pi / count)).normals
        rng = np.random.default_rng(seed)
        centers = rng.normal(size=(24, 3))
        patch = np.argmax(normals @ (centers / np.linalg.norm(centers, axis=1, keepdims=True)).T, axis=1)
        colors = rng.uniform(0.1, 0.8, (24, 3))
        around, above = np.radians(60.0) * np.arange(6), np.radians(20.0) * (-1.0) ** np.arange(6)
        views = np.stack([np.cos(above) * np.cos(around), np.cos(above) * np.sin(around), np.sin(above)], axis=1)
        return cls(normals, views, colors[patch], roughness)

    def evidence(self, light):
        """Evidence of the surface under a light."""
        cells = EnvironmentMap.constant((1, 1, 1), height=LIGHT_ROWS).directions().reshape(-1, 3)
        facing = (self.views @ self.normals.T > 0.1).astype(np.float32)
        return LightEvidence(
            positions=self.normals.astype(np.float32),
            normals=self.normals.astype(np.float32),
            openness=(self.normals @ cells.T > 0.0).astype(np.float32),
            colors=shaded(self.normals, self.views, self.base_color, self.roughness, light).astype(np.float32),
            weights=facing,
            directions=np.broadcast_to(self.views[:, None], (*facing.shape, 3)).astype(np.float32),
        )
