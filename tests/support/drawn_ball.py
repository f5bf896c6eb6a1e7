"""A ball of Gaussians with known materials, and captures without images around it, for commands that draw."""

import json

import numpy as np

from beam_warp import converters
from beam_warp.world.camera import Camera
from beam_warp.world.directions import even_directions
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.quaternions import turns_from_z


def relightable(positions, **changes):
    """Round, opaque Gaussians at places, with all arrays that light needs."""
    count = len(positions)
    arrays = {
        "positions": positions,
        "orientations": np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        "scales": np.ones((count, 3)),
        "opacities": np.ones(count),
        "base_color": np.full((count, 3), 0.5),
        "roughness": np.full(count, 0.5),
        "ambient_occlusion": np.ones(count),
        "normals": np.tile([0.0, 0.0, 1.0], (count, 1)),
    }
    return GaussianCloud(**(arrays | changes))


def drawn_ball(center=(0.0, 0.0, 0.0), color=(0.8, 0.4, 0.2), count=10_000):
    """Opaque flat discs on a ball of radius 0.5 m."""
    normals = even_directions(count)
    return relightable(
        0.5 * normals + center,
        orientations=turns_from_z(normals),
        scales=np.tile([0.015, 0.015, 1e-4], (count, 1)),
        opacities=np.full(count, 0.99),
        radiance=np.zeros((count, 1, 3)),
        radiance_color_space="lin_rec709_scene",
        base_color=np.tile(color, (count, 1)),
        normals=normals,
    )


def judged_ball(error=0.02):
    """The ball, with errors and flags; not relightable, since it has no normals."""
    ball = drawn_ball()
    return ball.with_arrays(
        normals=None,
        ambient_occlusion_error=np.full(10_000, 0.01),
        base_color_error=np.full((10_000, 3), 0.03),
        roughness_error=np.full(10_000, error),
        observability=np.where(ball.positions[:, 0] > 0.0, 32, 0),  # at the right of the image
    )


def save(clouds, path):
    converters.write(GaussianSequence.from_clouds(clouds), path, converters.WriteOptions(profile="beam"))


def write_capture(folder, cameras, **changes):
    """A capture of one camera per (name, frame, split), without images: none are needed to draw over them."""
    folder.mkdir()
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    camera = Camera.orbit((0, 0, 0), 3.0, 30.0, 20.0, width=40, height=32, vertical_fov=30.0)
    content = {
        "w": 40, "h": 32, "fl_x": camera.focal_x, "fl_y": camera.focal_y, "cx": 20, "cy": 16,
        "frames": [
            {"file_path": f"images/{name}/{frame:04d}.exr", "camera": name, "frame": frame, "split": split,
             "transform_matrix": (camera.camera_to_world @ flip).tolist(), **changes}
            for name, frame, split in cameras
        ],
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(content))
    return camera
