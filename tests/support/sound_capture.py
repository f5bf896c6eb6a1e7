"""A small capture on disk without faults, into which tests put one."""

import json

import numpy as np
from PIL import Image as PillowImage

from beam_warp.world.camera import Camera

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
CAMERAS, FRAMES = 12, 3
WIDTH, HEIGHT = 40, 30
TARGET = np.array([0.3, -0.2, 0.9])


def rig(count=CAMERAS, **changes):
    options = {"width": WIDTH, "height": HEIGHT, "vertical_fov": 40.0, **changes}
    return [
        Camera.orbit(TARGET, 3.0 + 0.1 * (k % 3), 360.0 * k / count, (10.0, 25.0, -5.0)[k % 3], **options)
        for k in range(count)
    ]


def write_sound(folder, cameras=None, frames=FRAMES):
    """A grey disc in front of every camera, a little brighter from one side, moving a pixel a frame."""
    cameras = rig() if cameras is None else cameras
    records = []
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for k, camera in enumerate(cameras):
        for frame in range(frames):
            path = f"images/c{k:02d}/{frame:04d}.png"
            alpha = (np.hypot(x - 20 - frame, y - 15) < 8) * 255
            grey = np.full_like(alpha, int(140 + 20 * camera.forward[0]))
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            PillowImage.fromarray(np.stack([grey, grey, grey, alpha], -1).astype(np.uint8)).save(folder / path)
            pose = (camera.camera_to_world @ FLIP).tolist()
            records.append({"file_path": path, "camera": f"c{k:02d}", "frame": frame, "transform_matrix": pose})
    camera = cameras[0]
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": camera.focal_x, "fl_y": camera.focal_y, "cx": 20.0, "cy": 15.0}
    content["frames"] = records
    save(folder, content)
    return content


def save(folder, content):
    (folder / "transforms.json").write_text(json.dumps(content))


def rewrite(path, change):
    """Change an image's (H, W, 4) bytes."""
    pixels = np.array(PillowImage.open(path))
    changed = change(pixels)
    PillowImage.fromarray(pixels if changed is None else changed).save(path)
