"""What rounding to float32 does to a scene: an error that no float32 rasteriser can be below.

A computation is backward stable if what it returns is exact for inputs a few roundings away from those it got. So the
spread of the float64 result over such inputs says how well a scene determines its image and its gradients; a needle
seen from its tip, or a disc seen edge on, does not.
"""

from dataclasses import replace

import numpy as np

ROUNDING = 2.0**-24
"""Half a unit in the last place, relative."""


def rounded(rng, scene):
    """Return a scene whose every number is moved at random by at most one rounding.

    Positions are moved by one of their distance from the camera, which is what is left after it is subtracted, and by
    that of the camera's own position.
    """
    camera = scene.camera.position
    distance = np.linalg.norm(scene.positions - camera, axis=1, keepdims=True)
    sizes = {name: np.abs(array) for name, array in scene.arrays().items()}
    sizes["positions"] = distance + np.abs(camera - camera.astype(np.float32)).max() / ROUNDING
    sizes["orientations"] = np.linalg.norm(scene.orientations, axis=1, keepdims=True)
    moved = {
        name: array + ROUNDING * sizes[name] * rng.uniform(-1.0, 1.0, array.shape)
        for name, array in scene.arrays().items()
    }
    return replace(scene, **moved)
