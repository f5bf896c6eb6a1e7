"""What an open dielectric surface shows under smooth light, in float64: the full integral, no split sum."""

import numpy as np

from beam_warp.light.ggx import DIELECTRIC_F0, schlick_weight, smith_lambda, specular_albedo

AROUND, ACROSS = 16, 16
"""Midpoint grid over visible normals, and over the cosine-weighted hemisphere."""


class SmoothSky:
    """Radiance ambient + sum of color exp(sharpness (d . axis - 1)): known in every direction, not by texels."""

    def __init__(self, ambient, axes, sharpness, colors):
        self.ambient = np.asarray(ambient, float)
        self.axes = np.asarray(axes, float) / np.linalg.norm(axes, axis=1, keepdims=True)
        self.sharpness = np.asarray(sharpness, float)
        self.colors = np.asarray(colors, float)

    def radiance(self, directions):
        """Radiance from unit directions (..., 3)."""
        return self.ambient + np.exp(self.sharpness * (directions @ self.axes.T - 1.0)) @ self.colors

    def turned(self, angle):
        """The same sky, turned about z."""
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return SmoothSky(self.ambient, self.axes @ rotation.T, self.sharpness, self.colors)


def frames_of(normals, towards):
    """Columns x, y, z of frames about normals (N, 3) whose x lies on the side of a direction (N, 3), (N, 3, 3)."""
    x = towards - (towards * normals).sum(1, keepdims=True) * normals
    flat = np.linalg.norm(x, axis=1) < 1e-9
    x[flat] = np.cross(normals[flat], [0.31, 0.52, 0.79])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(normals, x), normals], axis=-1)


def grid():
    azimuth = (np.arange(AROUND) + 0.5) * (2.0 * np.pi / AROUND)
    share = (np.arange(ACROSS) + 0.5) / ACROSS
    return (part.ravel() for part in np.meshgrid(azimuth, share))


def irradiance_over_pi(sky, normals):
    """Mean radiance under the cosine, (N, 3)."""
    azimuth, share = grid()
    ring = np.sqrt(share)
    local = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), np.sqrt(1.0 - share)])
    return sky.radiance(np.einsum("nij,jk->nki", frames_of(normals, np.roll(normals, 1, axis=1)), local)).mean(axis=1)


def specular_radiance(sky, normals, views, roughness):
    """Radiance that the GGX lobe sends to views (N, 3): mean of F G2 / G1 L over visible normals (Heitz 2018)."""
    azimuth, share = grid()
    alpha = np.square(roughness)[:, None]
    cosine = (normals * views).sum(1)[:, None]
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    length = np.hypot(alpha * sine, cosine)
    x, z = alpha * sine / length, cosine / length
    remaining = (1.0 - share) ** 2  # nodes crowd towards the cap's rim, where the tail is
    weight = 2.0 * (1.0 - share)
    height = remaining * (1.0 + z) - z
    ring = np.sqrt(np.maximum(1.0 - height**2, 0.0))
    h = np.stack([alpha * (ring * np.cos(azimuth) + x), alpha * ring * np.sin(azimuth), height + z])
    h /= np.linalg.norm(h, axis=0)
    v_dot_h = sine * h[0] + cosine * h[2]
    light = 2.0 * v_dot_h * h - np.stack([sine, np.zeros_like(sine), cosine])
    above = light[2] > 0.0
    view = 1.0 + smith_lambda(cosine, alpha)
    masking = np.where(above, view / (view + smith_lambda(np.where(above, light[2], 1.0), alpha)), 0.0)
    fresnel = DIELECTRIC_F0 + (1.0 - DIELECTRIC_F0) * schlick_weight(v_dot_h)
    world = np.einsum("nij,jnk->nki", frames_of(normals, views), light)
    return ((weight * masking * fresnel)[..., None] * sky.radiance(world)).sum(axis=1) / weight.sum()


def reflected_radiance(sky, normals, views, base_color, roughness):
    """Radiance towards views, (N, 3); 0 where a view is behind the surface or within 2 degrees of it."""
    cosine = (normals * views).sum(1)
    seen = cosine > 0.035
    result = np.zeros((len(normals), 3))
    n, v, r = normals[seen], views[seen], roughness[seen]
    diffuse = base_color[seen] * irradiance_over_pi(sky, n) * (1.0 - specular_albedo(cosine[seen], r))[:, None]
    result[seen] = diffuse + specular_radiance(sky, n, v, r)
    return result
