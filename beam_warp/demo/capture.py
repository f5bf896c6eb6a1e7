"""A small capture whose truth is known: the demo figure dances in a studio, path traced for a dome of cameras.

The capture has the layout of `beam_warp.capture.nerfstudio`. Beside it are the exact channels of the test views and the
exact surface of every frame.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats.qmc import Halton

from beam_warp.capture.capture import Capture
from beam_warp.checks import require_count
from beam_warp.demo.figure import Figure, build_figure
from beam_warp.demo.lights import studio
from beam_warp.errors import OutputError
from beam_warp.image.files import write_exr
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.outputs import temporary_path
from beam_warp.trace.mesh_paths import TracedMesh, trace_channels, trace_radiance
from beam_warp.world.camera import MAX_SIDE, OPENGL_TO_OPENCV, Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.mesh import MaterialMesh

FRAMES_PER_SECOND = 24.0

DANCE_SECONDS = 1.0
"""Time of one round of the dance: the surface moves by 6 mm from frame to frame in the median, hands by 30 mm."""

FIGURE_HEIGHT = 1.8
"""[m]; over the image's height it gives the side of the cells that the figure is meshed with."""

FIGURE_SPACINGS = (0.011, 0.018)
"""Smallest and largest such side [m]: finer ones show nothing more, with coarser ones thin parts fall apart."""

ELEVATIONS = (-12.0, 62.0)
"""Lowest and highest camera seen from the middle of the figure [degree]."""

TEST_ELEVATIONS = (4.0, 40.0)
"""Lowest and highest test camera [degree]: inside the span of the training cameras."""

VERTICAL_FOV = 35.0

TEST_SAMPLES = 4
"""Paths of a test view's pixel over those of a training view's: truth has half the noise."""

CHANNEL_SAMPLES = 16
VISIBILITY_SAMPLES = 4


@dataclass(frozen=True)
class DomeCamera:
    """A camera of the dome.

    Attributes:
        name: ``train_00`` …, ``test_00`` ….
        split: ``train`` or ``test``.
        camera: Pinhole and pose.
    """

    name: str
    split: str
    camera: Camera


def write_demo_capture(
    folder: str | os.PathLike[str],
    *,
    frame_count: int = 4,
    camera_count: int = 12,
    test_camera_count: int = 2,
    size: int = 128,
    samples: int = 16,
    relit: Mapping[str, EnvironmentMap] | None = None,
    device: str | None = None,
    seed: int = 0,
    progress: StageProgress = no_progress,
) -> Capture:
    """Path trace the demo figure's dance for a dome of cameras and write it as a capture.

    The images are unbiased and not denoised. At 16 samples a training view is 31 dB from its limit inside the figure's
    box and 29 dB on its solid pixels; a test view, of `TEST_SAMPLES` times as many, 37 and 34 dB, which is what an
    exact render scores.

    Args:
        folder: Where to; made if its parent exists, and must be empty if it exists itself.
        frame_count: Frames, 1/24 s apart.
        camera_count: Training cameras, evenly around the figure; camera i is the same in every frame.
        test_camera_count: Cameras with truth; 0 for none.
        size: Width and height of every image [pixel].
        samples: Paths per pixel of a training view; a power of two is best.
        relit: Other lights by name, under which the test views are traced too; see `write_capture`.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
        seed: Same seed, same device: same files but for the headers of their formats.
        progress: Called with (stage, done, total) after every image.

    Returns:
        The capture, as read back.

    Raises:
        InvalidOptionError: A count is out of range.
        OutputError: The folder is not empty or cannot be written; what is half written is removed.
    """
    require_count("frame_count", frame_count, 1, 10_000)
    require_count("size", size, 1, MAX_SIDE)
    require_count("samples", samples, 1, 2**16)
    require_count("seed", seed, 0, 2**31 - 1)
    require_free(folder)
    figure = demo_figure_for(size)
    period = FRAMES_PER_SECOND * DANCE_SECONDS
    meshes = [figure.at(frame / period) for frame in range(frame_count)]
    dome = dome_cameras([mesh.vertices for mesh in meshes], camera_count, test_camera_count, size, size)
    return write_capture(
        folder, meshes, dome, studio(), samples=samples, relit=relit, device=device, seed=seed, progress=progress
    )


def demo_figure_for(size: int) -> Figure:
    """Mesh the figure as finely as images of a size [pixel] show."""
    return build_figure(float(np.clip(FIGURE_HEIGHT / size, *FIGURE_SPACINGS)))


def write_capture(
    folder: str | os.PathLike[str],
    meshes: Sequence[MaterialMesh],
    cameras: Sequence[DomeCamera],
    light: EnvironmentMap,
    *,
    surfaces: Sequence[tuple[ArrayLike, ArrayLike]] | None = None,
    samples: int = 16,
    relit: Mapping[str, EnvironmentMap] | None = None,
    device: str | None = None,
    seed: int = 0,
    progress: StageProgress = no_progress,
) -> Capture:
    """Path trace meshes, one a frame, for some cameras and write them as a capture; see `write_demo_capture`.

    ``surfaces`` are vertices and faces to be written as truth, where they are less dense than the meshes. ``relit`` are
    lights by name, fit for a file name: ``truth/NAME.exr``; what test views show under them is in ``truth/relit_NAME``.
    """
    total = len(meshes) * len(cameras)
    with replacing_folder(folder) as root:
        write_exr(root / "environment.exr", _layers(light.radiance, "RGB"))
        (root / "truth").mkdir()
        others = dict(relit or {})
        for name, other in others.items():
            write_exr(root / f"truth/{name}.exr", _layers(other.radiance, "RGB"))
            (root / f"truth/relit_{name}").mkdir()
        for entry in cameras:
            (root / "images" / entry.name).mkdir(parents=True)
        records = []
        for frame, mesh in enumerate(meshes):
            traced = TracedMesh.from_mesh(mesh, device=device)
            vertices, faces = (mesh.vertices, mesh.faces) if surfaces is None else surfaces[frame]
            exact = {"vertices": np.asarray(vertices, np.float32), "faces": np.asarray(faces, np.int32)}
            np.savez_compressed(root / f"truth/mesh_{frame:04d}.npz", **exact)
            for entry in cameras:
                # A seed of its own for every image: noise that frames share would look like texture.
                stream = (seed * 1_000_003 + len(records)) % 2**32
                records.append(_write_view(root, mesh, traced, entry, frame, light, others, samples, stream))
                progress("path trace capture", len(records), total)
        write_transforms(root / "transforms.json", records, FRAMES_PER_SECOND)
    return Capture.read(folder)


def dome_cameras(
    points: Sequence[ArrayLike], camera_count: int, test_camera_count: int, width: int, height: int
) -> list[DomeCamera]:
    """Place cameras around a subject, all at the distance from which each of them sees all of it.

    Azimuths are even; elevations follow the van der Corput sequence, so that neighbours differ and any run of cameras
    spans high and low. Test cameras stand between the others.

    Args:
        points: Points that every camera must see, ``(N, 3)`` for every moment [m].
        camera_count: Training cameras, at least 1.
        test_camera_count: Test cameras.
        width: Width of every image [pixel].
        height: Height of every image [pixel].

    Raises:
        InvalidOptionError: A count or size is out of range.
    """
    require_count("camera_count", camera_count, 1, 10_000)
    require_count("test_camera_count", test_camera_count, 0, 10_000)
    held = np.concatenate([np.asarray(part, np.float64) for part in points])
    center = 0.5 * (held.min(axis=0) + held.max(axis=0))
    names: list[tuple[str, str, float, float]] = []
    for split, count, (low, high), shift in (
        ("train", camera_count, ELEVATIONS, 0.0),
        ("test", test_camera_count, TEST_ELEVATIONS, 180.0 / camera_count),
    ):
        for index, share in enumerate(Halton(1, scramble=False).random(count)[:, 0].tolist()):
            azimuth = 360.0 * index / count + shift
            names.append((split, f"{split}_{index:02d}", azimuth, low + (high - low) * share))
    sizes: dict[str, Any] = {"width": width, "height": height, "vertical_fov": VERTICAL_FOV}
    reach = max(
        float(
            np.linalg.norm(Camera.frame_points(held, azimuth=azimuth, elevation=elevation, **sizes).position - center)
        )
        for _, _, azimuth, elevation in names
    )
    return [
        DomeCamera(name, split, Camera.orbit(center, reach, azimuth, elevation, **sizes))
        for split, name, azimuth, elevation in names
    ]


def write_transforms(path: Path, records: Sequence[Mapping[str, Any]], frames_per_second: float) -> None:
    """Write ``transforms.json`` of a capture of ours; see `transforms_record`."""
    content = {
        "camera_model": "OPENCV",
        "fps": frames_per_second,
        "environment": "environment.exr",
        "environment_mapping": "u = 0.5 - atan2(y, x)/2pi, v = acos(z)/pi from the top row",
        "world": "right-handed, z up, metres",
        "image_space": "scene-linear Rec.709, premultiplied alpha",
        "frames": list(records),
    }
    path.write_text(json.dumps(content, indent=1), encoding="utf-8")


def transforms_record(
    name: str, split: str, frame: int, camera: Camera, frames_per_second: float, *, has_truth: bool
) -> dict[str, Any]:
    """Return the record of one image, whose pose is in OpenGL axes."""
    record: dict[str, Any] = {
        "file_path": f"images/{name}/{frame:04d}.exr",
        "transform_matrix": (camera.camera_to_world @ OPENGL_TO_OPENCV).tolist(),
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.focal_x,
        "fl_y": camera.focal_y,
        "cx": camera.center_x,
        "cy": camera.center_y,
        "time": frame / frames_per_second,
        "frame": frame,
        "camera": name,
        "split": split,
    }
    return record | ({"truth": f"truth/{name}_{frame:04d}.exr"} if has_truth else {})


def require_free(folder: str | os.PathLike[str]) -> Path:
    """Return a folder's path if nothing is there yet.

    Raises:
        OutputError: The folder holds files already.
    """
    target = Path(folder)
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise OutputError(f"folder must be new or empty, got {target} with content. Choose another or empty it.")
    return target


@contextmanager
def replacing_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary folder beside ``folder`` that takes its place on success and vanishes on failure.

    Raises:
        OutputError: ``folder`` holds files already, or cannot be written.
    """
    target = require_free(folder)
    temporary = temporary_path(target)
    try:
        temporary.mkdir()
        yield temporary
        temporary.replace(target)
    except OSError as error:
        raise OutputError(
            f"folder must be writable, got {target} ({error.strerror}). Choose one whose parent exists and has room."
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_view(
    root: Path,
    mesh: MaterialMesh,
    traced: TracedMesh,
    entry: DomeCamera,
    frame: int,
    light: EnvironmentMap,
    others: Mapping[str, EnvironmentMap],
    samples: int,
    seed: int,
) -> dict[str, Any]:
    """Trace and write one image, with its truth and under other lights if it is for testing; return its record."""
    is_test = entry.split == "test"
    record = transforms_record(entry.name, entry.split, frame, entry.camera, FRAMES_PER_SECOND, has_truth=is_test)
    window = _Window.around(entry.camera, mesh.vertices)
    paths = samples * (TEST_SAMPLES if is_test else 1)
    seen = trace_radiance(traced, window.camera, light, sample_count=paths, seed=seed)
    alpha = window.whole(seen.alpha)
    write_exr(root / record["file_path"], _layers(window.whole(seen.rgb), "RGB") | {"A": alpha}, half=True)
    if is_test:
        channels = trace_channels(
            traced, window.camera, sample_count=CHANNEL_SAMPLES, visibility_count=VISIBILITY_SAMPLES, seed=seed
        )
        layers = {
            "A": alpha,
            "ambient_occlusion": window.whole(channels.ambient_occlusion),
            **_layers(window.whole(channels.base_color), "RGB", "base_color."),
            "roughness": window.whole(channels.roughness),
            **_layers(window.whole(channels.normals), "XYZ", "normal."),
            "depth": window.whole(channels.depth),
        }
        write_exr(root / record["truth"], layers)
        for name, other in others.items():
            shown = trace_radiance(traced, window.camera, other, sample_count=paths, seed=seed)
            path = f"truth/relit_{name}/{entry.name}_{frame:04d}.exr"
            write_exr(root / path, _layers(window.whole(shown.rgb), "RGB") | {"A": window.whole(shown.alpha)})
            record.setdefault("relit", {})[name] = path
    return record


@dataclass(frozen=True)
class _Window:
    """The part of an image that can show a subject: rays beside it would cost more than those that hit.

    Attributes:
        camera: Camera that sees just that part.
        left, top: Upper left corner of the part [pixel].
        size: (height, width) of the whole image.
    """

    camera: Camera
    left: int
    top: int
    size: tuple[int, int]

    @classmethod
    def around(cls, camera: Camera, points: NDArray[np.float32]) -> _Window:
        """Return the part that holds points; the whole image if some are behind the camera or none is in view."""
        size = (camera.height, camera.width)
        pixels = camera.project(points)[:, :2]
        low = np.clip(np.floor(pixels.min(axis=0)), 0, size[::-1])
        high = np.clip(np.ceil(pixels.max(axis=0)), 0, size[::-1])
        if not (high > low).all():  # also: a point behind the camera is NaN
            return cls(camera, 0, 0, size)
        (left, top), (width, height) = low.astype(int).tolist(), (high - low).astype(int).tolist()
        part = replace(
            camera, width=width, height=height, center_x=camera.center_x - left, center_y=camera.center_y - top
        )
        return cls(part, left, top, size)

    def whole(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the whole image, which is 0 beside this part."""
        out = np.zeros((*self.size, *image.shape[2:]), np.float32)
        out[self.top : self.top + self.camera.height, self.left : self.left + self.camera.width] = image
        return out


def _layers(image: NDArray[np.floating[Any]], names: str, prefix: str = "") -> dict[str, NDArray[np.floating[Any]]]:
    return {prefix + name: image[..., index] for index, name in enumerate(names)}
