"""Environments blurred by the specular lobe of every roughness, and their irradiance: the light of a split sum.

With E(n) the irradiance, L_r(d) the environment blurred by the GGX lobe of roughness r (n = v = d), and the directional
albedo of the specular lobe E_s = F0 A(n·v, r) + B(n·v, r), F0 = 0.04, a pixel of base colour ρ shows

    L = (1 - E_s) ρ E(n) / π · V + Σ w_k L_(r_k)(d_k) E_s · S,

multiplied by its alpha, at a cost that no light changes. Directions d_k, roughnesses r_k and weights w_k are those of
the round lobes that make up the one of (n·v, r), `beam_warp.kernels.light.stretched_lobe`. V is ambient occlusion (1
is open) and S = clamp((n·v + V)^(2^(-16 r - 1)) - 1 + V, 0, 1) the specular occlusion that goes with it.
The weight 1 - E_s keeps energy: a white open surface under uniform light of radiance 1 shows 1 at every angle and
roughness. This module makes E and L_r; ``kernels/light/shading.py`` evaluates the sum.

Sources: Karis 2013 (split sum); Lagarde and de Rousiers 2014 (specular occlusion, listing 26); Kulla and Conty 2017 and
Blender's Principled BSDF (albedo scaling). Left out: self-reflection between surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.kernels.light.prefilter import FluxTree, launch_prefilter_environment
from beam_warp.kernels.light.shading import EnvironmentLight
from beam_warp.light.ggx import specular_albedo_table
from beam_warp.world.environment import EnvironmentMap, texel_directions

FIRST_ROUGHNESS = 0.125
"""Roughness of the sharpest blurred level: its lobe, 0.03 rad wide, is the narrowest that a 256-row level resolves."""

BLURRED_LEVELS = 12
"""Levels from `FIRST_ROUGHNESS` to 1, evenly in log roughness: one step at most doubles the peak of a lobe, (1/r)^4."""

LEVEL_ROUGHNESS = (0.0, *np.geomspace(FIRST_ROUGHNESS, 1.0, BLURRED_LEVELS).tolist())
"""Roughness of every level; level 0 is the map itself, a mirror's view."""

ROOT_ROWS, MAX_TREE_ROWS = 4, 256
"""Coarsest and finest rows of the tree that is blurred: cells of 0.012 rad, less than half of the sharpest lobe."""

OPENING = 0.4
"""Cells larger than this share of their distance from the lobe's axis, or of the lobe's width, are split."""


def blurred_environment(environment: EnvironmentMap, device: Any) -> EnvironmentLight:
    """Integrate irradiance and blur an environment for every roughness; the same device gives the same bits.

    Args:
        environment: The light.
        device: A Warp device.

    Returns:
        The struct that kernels take.
    """
    heights = [environment.height, *(_level_rows(roughness, environment.height) for roughness in LEVEL_ROUGHNESS[1:])]
    offsets = np.concatenate([[0], np.cumsum([2 * height * height for height in heights])])
    texels = wp.empty(int(offsets[-1]), dtype=wp.vec3, device=device)
    wp.copy(texels, wp.array(environment.radiance.reshape(-1, 3), dtype=wp.vec3, device=device))
    tree = _flux_tree(environment, device)
    for roughness, height, offset in zip(LEVEL_ROUGHNESS[1:], heights[1:], offsets[1:], strict=False):
        launch_prefilter_environment(
            tree,
            alpha=roughness * roughness,
            opening=OPENING,
            height=height,
            offset=int(offset),
            out_texels=texels,
            device=device,
        )
    light = EnvironmentLight()
    light.irradiance = wp.array(environment.default_irradiance, dtype=wp.vec3, device=device)
    light.texels = texels
    light.heights = wp.array(heights, dtype=int, device=device)
    light.offsets = wp.array(offsets[:-1], dtype=int, device=device)
    light.level_count = len(heights)
    light.first_roughness = FIRST_ROUGHNESS
    light.log_ratio = float(np.log(LEVEL_ROUGHNESS[2] / LEVEL_ROUGHNESS[1]))
    light.albedo_terms = wp.array(specular_albedo_table(), dtype=wp.vec2, device=device)
    return light


def _level_rows(roughness: float, height: int) -> int:
    """Rows of a blurred level: texels of 0.8 alpha, at least 32 rows, at most those of the tree, or twice the map's.

    A lobe falls to half at 1.3 alpha from its axis: bilinear lookup takes a few per cent off the peak of a point light.
    What is between the texels of a coarse map is interpolation, which finer levels only repeat.
    """
    finest = min(MAX_TREE_ROWS, max(32, 2 * height))
    return int(np.clip(np.ceil(np.pi / (0.8 * roughness * roughness)), 32, finest))


def _flux_tree(environment: EnvironmentMap, device: Any) -> Any:
    """Sum the environment into the quadtree that is blurred."""
    rows = int(np.clip(2 ** np.floor(np.log2(environment.height)), ROOT_ROWS, MAX_TREE_ROWS))
    source = environment if environment.height == rows else environment.resized(rows, 2 * rows)
    cells = _tree_cells(rows)
    flux = source.radiance * source.solid_angles()[..., None]
    moment = flux.sum(axis=-1, keepdims=True) * source.directions()
    sums = np.empty((len(cells.direction), 6))
    level = np.concatenate([flux, moment], axis=-1)
    for place in cells.places:
        sums[place] = level
        level = _block_sums(level) if len(level) > ROOT_ROWS else level
    length = np.linalg.norm(sums[:, 3:], axis=1, keepdims=True)
    aim = np.divide(sums[:, 3:], length, out=cells.direction.copy(), where=length > 0.0)
    tree = FluxTree()
    for name, array in (("direction", cells.direction), ("flux_direction", aim), ("flux", sums[:, :3])):
        setattr(tree, name, wp.array(array, dtype=wp.vec3, device=device))
    tree.size_squared = wp.array(cells.size_squared, dtype=float, device=device)
    tree.solid_angle = wp.array(cells.solid_angle, dtype=float, device=device)
    tree.next_cell = wp.array(cells.next_cell, dtype=int, device=device)
    return tree


@dataclass(frozen=True, eq=False)
class _TreeCells:
    """What the cells of a tree have in common for every environment; rows are in depth-first order."""

    places: tuple[NDArray[np.int64], ...]  # rows of the cells of each level, ``(h, 2 h)``, finest first
    direction: NDArray[np.float64]
    solid_angle: NDArray[np.float64]
    size_squared: NDArray[np.float64]
    next_cell: NDArray[np.int64]


@cache
def _tree_cells(rows: int) -> _TreeCells:
    """Lay out the quadtree whose finest level has ``rows`` rows, a power of two."""
    # A cell comes right before its quarters, and each subtree is one run: place by place from the roots down.
    depth = int(np.log2(rows // ROOT_ROWS))
    subtree = [(4 ** (depth - level + 1) - 1) // 3 for level in range(depth + 1)]
    places = [np.arange(2 * ROOT_ROWS * ROOT_ROWS).reshape(ROOT_ROWS, -1) * subtree[0]]
    for level in range(depth):
        quarters = np.array([[0, 1], [2, 3]]) * subtree[level + 1] + 1
        parents = places[-1].repeat(2, axis=0).repeat(2, axis=1)
        places.append(parents + np.tile(quarters, places[-1].shape))
    count = 2 * ROOT_ROWS * ROOT_ROWS * subtree[0]
    moments, size_squared, next_cell = np.empty((count, 3)), np.empty(count), np.empty(count, np.int64)
    angles = np.empty(count)
    angle = EnvironmentMap.constant([0, 0, 0], height=rows).solid_angles()[..., None]
    moment = texel_directions(rows, 2 * rows) * angle
    for level in range(depth, -1, -1):
        place = places[level]
        theta = np.linspace(0.0, np.pi, len(place) + 1)
        widest = np.maximum(np.sin(theta[1:]), np.sin(theta[:-1])) * (np.pi / len(place))
        size_squared[place] = 0.0 if level == depth else (widest**2 + (np.pi / len(place)) ** 2)[:, None]
        moments[place], angles[place], next_cell[place] = moment, angle[..., 0], place + subtree[level]
        if level:
            moment, angle = _block_sums(moment), _block_sums(angle)
    direction = moments / np.linalg.norm(moments, axis=1, keepdims=True)
    return _TreeCells(tuple(reversed(places)), direction, angles, size_squared, next_cell)


def _block_sums(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum the blocks of 2 × 2 cells."""
    return array[0::2, 0::2] + array[0::2, 1::2] + array[1::2, 0::2] + array[1::2, 1::2]
