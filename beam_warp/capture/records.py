"""Records of a capture: its images, its sparse points and what its files state; the loaders make them.

Images are read when they are asked for and never kept, so that memory does not grow with their number.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.capture.cutouts import taken_in
from beam_warp.capture.lenses import Lens
from beam_warp.capture.mattes import MaskOffset, Uncut, keyed, matte
from beam_warp.capture.undistort import COLORS, Intrinsics, Undistortion
from beam_warp.capture.views import CapturedView
from beam_warp.errors import AssetFormatError, BeamError, MissingFileError
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.image.files import SUFFIXES, Image, read_image
from beam_warp.image.film import is_film, read_film_frame
from beam_warp.world.camera import Camera

MAX_CONTAINERS = 2**21
"""Most lists and objects of a JSON file; each takes 30 times its bytes in memory. A record has six."""

MAX_RECORDS = 2**22
"""Most images that one capture may have."""

BRIGHTER_THAN_NOISE = 5.0
"""Least ratio of a backdrop's level to the difference of its neighbouring pixels: that of darkness is about 1."""

ALPHA_ROUNDING = 2.0**-10
"""Largest distance of alpha from [0, 1] that is rounding: a renderer's filter adds two half floats."""

COLOR_SPACES = {"srgb": DISPLAY_SRGB, "linear": LINEAR_REC709}
"""Values of ``color_space`` in a capture's files; without one, the convention of each image format holds."""

DOUBT = "coverage.doubt"
"""Channel of a photograph that says how much is not known of a pixel."""

IMAGE_FOLDER = "images"
MASK_FOLDER = "masks"
"""Folder of masks that are not named: ``masks/a/0.png``, or COLMAP's ``masks/a/0.jpg.png``, for ``images/a/0.jpg``."""

PLATE_FOLDER = "plates"
"""Folder of images without the subject that are not named: ``plates/<camera>.png``, of any suffix that is read."""


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Points on the scene's surfaces, as structure from motion finds them.

    Attributes:
        positions: World positions [m], ``(P, 3)`` float64.
        colors: Scene-linear Rec.709, ``(P, 3)`` float32; None where the file has none.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureRecord:
    """One image of a capture.

    Attributes:
        camera_name: Name of the camera that took the image; fit for a file name.
        frame: Number of the frame of the performance, from 0.
        time: When the image was taken [s].
        split: Purpose of the image: ``train``, ``test``, ….
        camera: Pinhole camera of `image`.
        image_path: The image file, as photographed; or a video.
        mask_path: An image file, as photographed, that is white on the subject, or a video; None if there is none.
        plate_path: An image file of the same camera, as photographed, without the subject; None if there is none.
        color_space: Colour space of the files, `LINEAR_REC709` or `DISPLAY_SRGB`; None for the format's convention.
        truth_path: An EXR of exact channels, if the capture is synthetic.
        relit_paths: Exact images under other lights, by the name of the light.
        undistortion: Undistortion of all files as they are read; None if a pinhole took them.
        mask_excess: How far coverage reaches beyond the subject [pixel of `view`], which is taken in as it is read.
        moment: When videos show the image, on the clock of their files [s].
        gains: Factors of red, green and blue that the camera is known to be off by; `view` undoes them.
        falloff: Power of the cosine of the angle to the optical axis that darkens the image; `view` undoes it.
    """

    camera_name: str
    frame: int = 0
    time: float = 0.0
    split: str = "train"
    camera: Camera
    image_path: Path
    mask_path: Path | None = None
    plate_path: Path | None = None
    color_space: str | None = None
    truth_path: Path | None = None
    relit_paths: Mapping[str, Path] = field(default_factory=dict)
    undistortion: Undistortion | None = None
    mask_excess: float = 0.0
    moment: float = 0.0
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    falloff: float = 0.0

    @property
    def name(self) -> str:
        """Unique name of the record, ``CAMERA_FRAME``, for files."""
        return f"{self.camera_name}_{self.frame:04d}"

    @property
    def is_distorted(self) -> bool:
        """True if the files are distorted; `image` and `view` undistort them."""
        return self.undistortion is not None

    def mask(self) -> NDArray[np.bool_]:
        """Return which pixels of `image` were photographed, ``(H, W)``: all unless `Capture.read` keeps more."""
        if self.undistortion is None:
            return np.ones((self.camera.height, self.camera.width), dtype=bool)
        return self.undistortion.mask()

    def image(self) -> Image:
        """Read the image, undistorted.

        Raises:
            MissingFileError: It is not there.
            AssetFormatError: It is damaged, or its size is not the camera's.
        """
        return self._undistorted(self.photograph())

    def view(self) -> CapturedView:
        """Read the image for reconstruction: scene-linear colour, undistorted, and coverage of the subject.

        Coverage is the image's alpha times the mask, or the one of them that exists; without either it is what differs
        from the plate, and without that it is unknown, and alpha is None. Where the image shows what is beyond the
        mask, the mask is moved to where the subject ends, and the backdrop is taken out of the colour: see
        `beam_warp.capture.mattes`. This is done in the photograph before that is undistorted, so that edges of colour
        and coverage are filtered alike. Nothing is kept: each call reads the files again.

        Raises:
            MissingFileError: The image, or the mask or plate that the capture names, does not exist.
            AssetFormatError: A file is damaged, not of the camera's size, or holds values that no image has.
        """
        image, offset, uncut = self.photograph(), None, None
        mask = None if self.mask_path is None else _coverage(self._sized(self._read(self.mask_path), "mask"))
        if (scene := _scene(image)) is not None:
            if image.alpha is not None and not _is_opaque(image.alpha):
                mask = image.alpha if mask is None else image.alpha * mask
            image, offset, uncut = self._cut_out(image, scene, mask)
        elif mask is not None:
            image = _masked(image, mask)
        image = self._undistorted(image)
        color, alpha = image.linear_rgb(), image.alpha
        if alpha is not None:
            if not _is_coverage(alpha):
                raise AssetFormatError(
                    f"alpha must lie in [0, 1], got {np.nanmin(alpha):g} to {np.nanmax(alpha):g}"
                    f"{' and NaN' if np.isnan(alpha).any() else ''} at {self.image_path}. Export the image again."
                )
            alpha = np.clip(alpha, 0.0, 1.0)
        if not np.isfinite(color).all():
            raise AssetFormatError(
                f"image must be finite, got NaN or infinity in {int((~np.isfinite(color)).any(axis=-1).sum())} pixels "
                f"at {self.image_path}. Export it again, or repair those pixels."
            )
        doubt = image.channels.get(DOUBT)
        found = CapturedView(
            name=self.name,
            camera=self.camera,
            color=color,
            alpha=alpha,
            doubt=doubt if doubt is not None and doubt.any() else None,
            mask_offset=offset,
            uncut=uncut,
        )
        if self.gains != (1.0, 1.0, 1.0):
            found = found.brightened(1.0 / np.array(self.gains))
        if self.falloff:
            found = found.brightened(self.camera.axis_cosines()[..., None] ** -self.falloff)
        return taken_in(found, self.mask_excess)

    def truth(self) -> Image:
        """Read the exact channels, undistorted like the image.

        Raises:
            MissingFileError: The record has none, or the file is not there.
            AssetFormatError: It is damaged, or its size is not the camera's.
        """
        if self.truth_path is None:
            raise MissingFileError(f"truth must be given for {self.name}, got none. Choose a record that has it.")
        return self._undistorted(self._sized(read_image(self.truth_path), "image"))

    def relit(self, light: str) -> Image:
        """Read the exact image under another light, undistorted like the image.

        Raises:
            MissingFileError: The record has none of that name, or the file is not there.
            AssetFormatError: It is damaged, or its size is not the camera's.
        """
        if light not in self.relit_paths:
            raise MissingFileError(
                f"light must be one that {self.name} is known under ({', '.join(self.relit_paths) or 'none'}), got "
                f"{light!r}. Choose one of them."
            )
        return self._undistorted(self._sized(read_image(self.relit_paths[light]), "image"))

    def photograph(self) -> Image:
        """Read the image as photographed, distorted as it is; errors are those of `image`."""
        return self._sized(self._read(self.image_path, self.color_space), "image")

    def _read(self, path: Path, color_space: str | None = None) -> Image:
        """Read an image file, or the frame of a video, which is sRGB unless the capture says otherwise."""
        if not is_film(path):
            return read_image(path, color_space=color_space)
        image = read_film_frame(path, self.moment)
        return image if color_space is None else replace(image, color_space=color_space)

    def _plate(self) -> NDArray[np.float32] | None:
        """Read the plate, scene-linear."""
        if self.plate_path is None:
            return None
        plate = self._sized(read_image(self.plate_path, color_space=self.color_space), "plate").linear_rgba()[..., :3]
        if not np.isfinite(plate).all():
            raise AssetFormatError(f"plate must be finite, got NaN or infinity at {self.plate_path}. Export it again.")
        return plate

    def _cut_out(
        self, image: Image, scene: NDArray[np.float32], mask: NDArray[np.float32] | None
    ) -> tuple[Image, MaskOffset | None, Uncut | None]:
        """Return a photograph with the subject's coverage and colour alone, how far off its mask was, and all of it."""
        plate = self._plate()
        if mask is None and plate is None:
            return image, None, None
        if not np.isfinite(scene).all() or (mask is not None and not _is_coverage(mask)):
            return (image if mask is None else _masked(_opaque(image), mask)), None, None  # as it is, and then refused
        start = keyed(scene, cast("NDArray[np.float32]", plate)) if mask is None else np.clip(mask, 0.0, 1.0)
        found = matte(scene, start, plate)
        planes = dict(zip([*"RGBA", DOUBT], [*np.moveaxis(found.color, -1, 0), found.alpha, found.doubt], strict=True))
        cut = Image(image.path, planes, LINEAR_REC709, premultiplied=True)

        def undistorted(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
            planes = dict(zip("RGB", np.moveaxis(rgb, -1, 0), strict=True))
            return self._undistorted(Image(image.path, planes, LINEAR_REC709, premultiplied=False)).linear_rgb()

        uncut = None if found.uncut is None else found.uncut.mapped(undistorted)
        return cut, None if mask is None else found.offset, uncut

    def _sized(self, image: Image, what: str) -> Image:
        if (image.width, image.height) != (self.camera.width, self.camera.height):
            raise AssetFormatError(
                f"{what} must be {self.camera.width} x {self.camera.height} as the capture says, "
                f"got {image.width} x {image.height} at {image.path}. Correct the size there, or the {what}."
            )
        return image

    def _undistorted(self, image: Image) -> Image:
        return image if self.undistortion is None else self.undistortion.image(image)


def _coverage(mask: Image) -> NDArray[np.float32]:
    """Return a mask's brightness; coverage has no sRGB curve to decode."""
    rgb = mask.rgb()
    return rgb[..., 0] if (rgb == rgb[..., :1]).all() else rgb.mean(axis=-1, dtype=np.float32)


def _is_coverage(alpha: NDArray[np.float32]) -> bool:
    """Tell whether values lie in [0, 1], but for rounding; NaN does not."""
    return bool(((alpha >= -ALPHA_ROUNDING) & (alpha <= 1.0 + ALPHA_ROUNDING)).all())


def _scene(image: Image) -> NDArray[np.float32] | None:
    """Return subject and backdrop, scene-linear, ``(H, W, 3)``; None if the image shows the subject alone.

    Straight colour under an alpha of 0 is the backdrop's if it varies and is brighter than its noise: where a subject
    was cut out, it is constant, or the noise of a sensor without light.
    """
    alpha = image.alpha
    if alpha is not None and not _is_opaque(alpha):
        if image.premultiplied or not (beyond := image.rgb()[alpha == 0.0]).size:
            return None
        if not (beyond != np.median(beyond, axis=0)).any(axis=-1).mean() > 0.5:
            return None
        levels = np.where(alpha == 0.0, image.rgb().mean(axis=-1), np.nan)
        steps = np.abs(np.diff(levels, axis=1))  # within rows of the backdrop alone
        noise = np.median(steps[np.isfinite(steps)]) if np.isfinite(steps).any() else np.inf
        if not np.nanmedian(levels) > BRIGHTER_THAN_NOISE * noise:
            return None
    return _opaque(image).linear_rgba()[..., :3]


def _is_opaque(alpha: NDArray[np.float32]) -> bool:
    return bool((alpha == 1.0).all())


def _opaque(image: Image) -> Image:
    """Return an image without its alpha."""
    return replace(image, channels={name: plane for name, plane in image.channels.items() if name != "A"})


def _masked(image: Image, coverage: NDArray[np.float32]) -> Image:
    """Return an image whose alpha is multiplied by coverage."""
    channels = dict(image.channels)
    if image.premultiplied:
        if image.color_space == DISPLAY_SRGB:
            raise AssetFormatError(
                f"image must be scene-linear or have straight alpha to be masked, got sRGB premultiplied at "
                f"{image.path}. State its colour space, or convert it."
            )
        channels.update((name, channels[name] * coverage) for name in COLORS if name in channels)
    channels["A"] = coverage if image.alpha is None else image.alpha * coverage
    return replace(image, channels=channels)


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureContents:
    """Images of a scene from many places and times, as a loader found them, with what the files state.

    Attributes:
        folder: Folder of the capture.
        records: One for each image, in file order.
        frames_per_second: Rate of the performance [1/s]; None if it is not stated.
        environment_path: Lat-long image of the light during the capture; None if there is none.
        read_points: Function that reads the sparse points; None if there are none.
        notes: Assumptions and omissions, a sentence each.
    """

    folder: Path
    records: tuple[CaptureRecord, ...]
    frames_per_second: float | None = None
    environment_path: Path | None = None
    read_points: Callable[[], SparsePoints] | None = None
    notes: tuple[str, ...] = ()

    @property
    def frames(self) -> tuple[int, ...]:
        """Numbers of all frames, ascending."""
        return tuple(sorted({record.frame for record in self.records}))

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of all splits, ascending."""
        return tuple(sorted({record.split for record in self.records}))

    def select(self, *, split: str | None = None, frames: Collection[int] | None = None) -> tuple[CaptureRecord, ...]:
        """Return the records of a split, of some frames, or of both, in file order."""
        return tuple(
            record
            for record in self.records
            if (split is None or record.split == split) and (frames is None or record.frame in frames)
        )

    def points(self) -> SparsePoints | None:
        """Read the sparse points of the scene; None if the capture has none.

        Raises:
            MissingFileError: The file that it names does not exist.
            AssetFormatError: The file is damaged.
        """
        return None if self.read_points is None else self.read_points()


@dataclass(frozen=True)
class Photograph:
    """Intrinsics and lens of a camera's photographs.

    Attributes:
        intrinsics: Intrinsics that go with the lens.
        lens: Distortion of the photographs.
        model: Name of the lens model in the capture's file, for messages.
        where: Place in the capture's file that states them, for messages.
    """

    intrinsics: Intrinsics
    lens: Lens
    model: str
    where: str

    @classmethod
    def of(cls, intrinsics: Intrinsics, coefficients: tuple[float, ...], model: str, where: str) -> Photograph:
        """Make a photograph's record with the coefficients of a lens, of the model that the file names.

        Raises:
            AssetFormatError: The lens model has no such coefficients; the message names the place.
        """
        try:
            lens = Lens(coefficients, "OPENCV_FISHEYE" if model.endswith("FISHEYE") else "OPENCV")
        except BeamError as error:
            raise AssetFormatError(f"{model} has no pinhole at {where}: {error}") from error
        return cls(intrinsics, lens, model, where)

    def undistort(self, pose: ArrayLike, pose_name: str, keep: float) -> tuple[Camera, Undistortion | None]:
        """Return the pinhole camera of the undistorted image, and the undistortion, None if the lens has none.

        Args:
            pose: Camera to world in `Camera`'s axes, ``(4, 4)``.
            pose_name: Name of the pose in the file, for messages.
            keep: See `Capture.read`.

        Raises:
            AssetFormatError: The lens cannot be inverted, or the pose is not rigid; the message names the place.
        """
        try:
            undistortion = Undistortion.fit(self.lens, self.intrinsics, keep)
        except BeamError as error:
            raise AssetFormatError(f"{self.model} has no pinhole at {self.where}: {error}") from error
        try:
            camera = undistortion.camera(pose)
        except BeamError as error:
            raise AssetFormatError(f"{pose_name} is no camera pose at {self.where}: {error}") from error
        return camera, None if self.lens.is_straight else undistortion


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """Return the content of a file that describes a capture, of at most ``most`` bytes.

    Raises:
        MissingFileError: The file cannot be read.
        AssetFormatError: It is larger.
    """
    try:
        if path.exists() and not path.is_file():
            raise AssetFormatError(f"file must be regular, got a folder, pipe or device at {path}. Copy it again.")
        if most is not None and path.stat().st_size > most:
            raise AssetFormatError(f"file must be at most {most} bytes, got more at {path}. Check it, or split it.")
        return path.read_bytes()
    except OSError as error:
        raise MissingFileError(f"capture must be readable, got {path} ({error.strerror}). Check the rights.") from error


def read_text(path: Path, most: int | None = None) -> str:
    """Return the text of a file that describes a capture; see `read_bytes`."""
    try:
        return read_bytes(path, most).decode("utf-8")
    except UnicodeDecodeError as error:
        raise AssetFormatError(f"file must be text in UTF-8, got other bytes at {path}. Copy it again.") from error


def read_json(path: Path, what: str, most: int) -> Any:
    """Return the content of a JSON file, which errors call ``what``; see `read_bytes`."""
    text = read_text(path, most)
    if (count := text.count("[") + text.count("{")) > MAX_CONTAINERS:
        raise AssetFormatError(
            f"{what} must hold at most {MAX_CONTAINERS} lists and objects, got {count} at {path}. Split it."
        )
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise AssetFormatError(f"{what} must be JSON, got {reason} at {path}. Correct the file.") from error


def camera_name_of(file_path: str) -> str:
    """Return the name of a camera that the capture does not name: the folders and stem of its image, joined."""
    image = PurePosixPath(file_path.replace("\\", "/"))
    return "_".join([*(part for part in image.parts[:-1] if part not in ("/", "..")), image.stem])


def mask_beside(root: Path, file_path: str) -> Path | None:
    """Return the mask that has the image's place, but below `MASK_FOLDER`; None if there is no such file."""
    image = PurePosixPath(file_path.replace("\\", "/"))
    parts = image.parts[1:] if image.parts[:1] == (IMAGE_FOLDER,) else image.parts
    inner = PurePosixPath(*parts)
    if not inner.name:  # the image is named as a folder
        return None
    for name in (inner.with_suffix(".png"), inner.with_name(inner.name + ".png")):
        path = root / MASK_FOLDER / name
        if path.is_file():
            return path
    return None


def plate_beside(root: Path, camera_name: str) -> Path | None:
    """Return the image in `PLATE_FOLDER` that is named after a camera; None if there is none."""
    folder = root / PLATE_FOLDER
    if not folder.is_dir():
        return None
    return next((path for suffix in SUFFIXES if (path := folder / f"{camera_name}{suffix}").is_file()), None)
