"""A small capture on disk, and steps that model it cheaply and repeatably: tests of all that surrounds optimisation."""

import json
import time
from dataclasses import dataclass

import numpy as np
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp.capture.mask_corrections import MaskCorrections
from beam_warp.image.color import LINEAR_REC709
from beam_warp.image.files import write_exr
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

WIDTH, HEIGHT = 20, 16
LOST_LEVEL = 0.9
"""Images brighter than this are of something that the fake cannot track."""


def write_capture(folder, frames, *, levels=None, cameras=3, environment=True):
    """Write discs seen by cameras around them; ``levels`` are their brightnesses by frame."""
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    alpha = np.clip(6.0 - np.hypot(x - WIDTH / 2, y - HEIGHT / 2), 0.0, 1.0).astype(np.float32)
    for camera in range(cameras):
        seen_from = {"azimuth": 360.0 * camera / cameras, "elevation": 10.0, "vertical_fov": 40.0}
        view = Camera.orbit((0.0, 0.0, 0.0), 4.0, **seen_from, width=WIDTH, height=HEIGHT)
        pose = view.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
        for frame in frames:
            level = (levels or {}).get(frame, 0.2 + 0.01 * frame + 0.02 * camera)
            path = folder / "images" / f"c{camera}" / f"{frame:04d}.exr"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_exr(path, {name: alpha * np.float32(level) for name in "RGB"} | {"A": alpha})
            records.append(
                {
                    "file_path": str(path.relative_to(folder)),
                    "transform_matrix": pose.tolist(),
                    "frame": frame,
                    "camera": f"c{camera}",
                    "split": "train",
                }
            )
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": 24.0, "fl_y": 24.0, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    content |= {"fps": 12, "frames": records}
    if environment:
        write_exr(folder / "environment.exr", {name: np.ones((16, 32), np.float32) for name in "RGB"})
        content["environment"] = "environment.exr"
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@dataclass(frozen=True)
class FakeTrack:
    """The cloud, and a velocity that rounding to float32 would change: what is not stored exactly is found out."""

    cloud: GaussianCloud
    velocity: np.ndarray
    age: np.ndarray

    def arrays(self):
        return {**self.cloud.arrays(), "velocity": self.velocity, "age": self.age}


class FakeSteps:
    """A ball whose colour is that of the images; it moves by what the images and the frames before say."""

    device = "cpu"
    raster = RasterOptions(antialiased=True)
    rig = None
    masks = MaskCorrections()
    exposures = None

    def __init__(self, count=60, seed=0, seconds=0.0):
        self.count, self.seed, self.seconds = count, seed, seconds
        self.calls, self.refined, self.mended, self.cameras = [], [], [], []

    def options(self):
        return {"count": self.count, "seed": self.seed}

    def mend_masks(self, names, views, progress):
        """What the test says, in ``masks``."""
        self.mended.append(tuple(names))
        return self.masks

    def refine_rig(self, names, views, progress):
        """What the test says, in ``rig``."""
        self.refined.append(tuple(names))
        return self.rig

    def find_exposures(self, names, views, progress):
        """What the test says, in ``exposures``."""
        return self.exposures

    def begin(self, views, progress):
        level = self.level(views)
        self.calls.append("begin")
        self.cameras = [view.camera for view in views]
        count = self.count + (5 if level > LOST_LEVEL else 0)  # what is fitted anew has as many as it needs
        noise = np.random.default_rng([self.seed, int(level * 1e6)]).normal(size=(count, 3))
        points, spacing = sphere_points(count)
        cloud = cloud_of(
            tiles(points + 0.01 * noise, points, spacing),
            radiance=np.full((count, 1, 3), (level - 0.5) / 0.28209479),
            radiance_color_space=LINEAR_REC709,
            ids=np.arange(count),
        )
        progress(1, 1, {"psnr": 30.0, "gaussians": count})
        return FakeTrack(cloud, noise * 1e-3, np.array(0)), {
            "psnr": 30.0,
            "iterations": np.int64(7),
            "loss": np.array([1.0, np.inf]),
            "seconds": 0.5,
        }

    def advance(self, track, views, progress):
        level = self.level(views)
        self.calls.append("advance")
        time.sleep(self.seconds)
        age = track.age + 1
        velocity = 0.9 * track.velocity + 1e-4 * level / age
        cloud = track.cloud.with_arrays(positions=track.cloud.positions + velocity)
        progress(1, 1, {"psnr": 30.0 - float(age)})
        lost = "too bright" if level > LOST_LEVEL else ""
        return FakeTrack(cloud, velocity, age), {"psnr": 30.0 - 1.2 * float(age), "lost": lost}

    def restore(self, arrays):
        velocity, age = arrays.pop("velocity"), arrays.pop("age")
        assert velocity.dtype == np.float64
        assert age.shape == ()
        return FakeTrack(GaussianCloud(**arrays, radiance_color_space=LINEAR_REC709), velocity, age)

    @staticmethod
    def level(views):
        return float(np.mean([view.color.max() for view in views]))


class StuckSteps(FakeSteps):
    """Steps that say so when they begin to track, and never end."""

    def advance(self, track, views, progress):
        print("working", flush=True)
        time.sleep(600)
