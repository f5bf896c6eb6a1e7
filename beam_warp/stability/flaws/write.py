"""Writing of a flawed copy of a clean capture, in the layout of `beam_warp.capture.nerfstudio`.

The copy holds what a studio delivers: images of the training cameras, masks, calibration, and the light as measured.
Where coverage is right, images hold the subject alone, keyed out: straight colour and coverage. Where it is not, they
are photographs of the subject before a grey wall, without coverage, and masks lie beside them: a mask that is too large
shows some of the wall, and nothing in the copy tells where the subject ends but the pictures themselves. Cut-outs alone
have straight colour over nothing, and wrong coverage.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.matte_edges import SOLID
from beam_warp.capture.rigs import meeting_point
from beam_warp.checks import require_choice, require_number
from beam_warp.demo.capture import replacing_folder, transforms_record
from beam_warp.errors import InvalidArrayError
from beam_warp.image.files import write_exr, write_png
from beam_warp.stability.flaws.mattes import PLATE_ALBEDO, blotted_coverage, offset_coverage, plate
from beam_warp.stability.flaws.optics import defocused, distorted, motion_blurred
from beam_warp.stability.flaws.rig import CameraFlaws, draw_camera_flaws, stream
from beam_warp.stability.flaws.sensor import eight_bits, noisy, straight, write_eight_bits, write_jpeg, write_linear
from beam_warp.world.environment import EnvironmentMap

LIGHT_DEGREES = 2.0
LIGHT_GAIN = 0.1
BLUR_PIXELS = 1.0
DEFOCUS_PIXELS = 2.0
BLOT_PIXELS, BLOTTED_PART = 8.0, 0.25
CLIPPED_PART = 0.02
JPEG_LOSS = 10
MISSING_CAMERAS = 2
COSINE_POWER = 4.0
HEADROOM = 1e-3
"""Nominal sizes: turn and gain of the light, way of the subject during an exposure, circle of confusion, diameter of
blots and part of the masks that have them, part of the subject's pixels that are clipped, quality that a JPEG lacks to
100, cameras that lack one image, and the power of the cosine by which a thin lens darkens images. `HEADROOM` is the
part of the subject's pixels above white where highlights are meant to be kept."""

FLAWS: Mapping[str, str] = {
    "exposure": "exposure up to 0.2 stop and white balance up to 5 % off, a camera",
    "vignetting": "all images darkened by the fourth power of the cosine of the angle to the optical axis",
    "noise": "photon noise of 2 % at white, read noise of 0.2 %, 8-bit sRGB PNG",
    "plate": "photographs before a grey wall, with exact masks",
    "masks": "masks one pixel too large in half of the cameras, too small in the others, before a grey wall",
    "hard-masks": "masks that are all or nothing, before a grey wall",
    "blots": "a hole and a blob, eight pixels across, in a quarter of the masks, before a grey wall",
    "cutouts": "cut-outs, colour over nothing, one pixel too large in half of the cameras, too small in the others",
    "poses": "poses off by 0.3 pixel of rotation and 1 mm",
    "light": "environment turned by 2° and 10 % too bright",
    "motion-blur": "the subject moves by a pixel while the shutter is open",
    "defocus": "a circle of confusion of two pixels",
    "clipping": "the brightest 2 % of the subject's pixels clipped",
    "jpeg": "JPEG of quality 90 instead of images without loss, before a grey wall, with exact masks",
    "distortion": "radial distortion of half a pixel at the image's edges that nobody states",
    "wrong-camera": "one camera's pose turned by 20° about the subject",
    "missing-image": "two cameras lack the file of one image",
}
"""Flaws by name, with their nominal sizes."""

STUDIO = ("exposure", "noise", "masks", "poses", "light")
"""All that a good studio gets a little wrong, at once."""


@dataclass(frozen=True, eq=False)
class FlawedCapture:
    """A flawed copy and what was done to it.

    Attributes:
        capture: The copy, as read back: training records only.
        white: What all colours and the light of the copy are to be multiplied by to be in the clean capture's units.
        injected: Flaws in numbers: of each camera, of the light, which images are missing; JSON-able.
    """

    capture: Capture
    white: float
    injected: dict[str, Any]


def write_flawed(
    clean: Capture,
    folder: Path,
    flaws: Collection[str],
    *,
    size: float = 1.0,
    seed: int = 0,
    frames: Collection[int] | None = None,
) -> FlawedCapture:
    """Write a copy of a clean capture's training images with flaws.

    Args:
        clean: A capture with coverage and the light that it was taken in.
        folder: Where to; made if its parent exists, and must be empty if it exists itself.
        flaws: Names of `FLAWS`; none writes the capture as it is.
        size: Factor of the nominal sizes, above 0. ``plate`` and ``hard-masks`` have none.
        seed: Same seed, same flaws; each flaw's draws are the same alone and together with others.
        frames: Frames to write; None for all.

    Raises:
        InvalidOptionError: A flaw is unknown, or the size out of range.
        InvalidArrayError: The capture has no coverage, no light, or fewer than two training cameras.
        BeamError: A file of the capture cannot be read, or the folder cannot be written.
    """
    for flaw in flaws:
        require_choice("flaw", flaw, tuple(FLAWS))
    require_number("size", size, 1e-3, 8.0)
    records = clean.select(split="train", frames=frames)
    light = _light_of(clean, records)
    shot = _Shot.drawn(records, light, frozenset(flaws), size, seed)
    missing = _missing(records, shot)
    stated, said = _stated_light(light, shot)
    rate = clean.frames_per_second or 24.0
    with replacing_folder(folder) as root:
        for record in records:
            if record.name not in missing:
                shot.write(root, record)
        write_exr(root / "environment.exr", {c: stated.radiance[..., i] for i, c in enumerate("RGB")})
        content = {
            "camera_model": "OPENCV",
            "fps": rate,
            "environment": "environment.exr",
            "frames": [shot.entry(record, rate) for record in records],
        }
        (root / "transforms.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    cameras = {name: found for name, flaw in shot.cameras.items() if (found := flaw.as_dict())}
    injected = {"cameras": cameras, "light": said, "missing": sorted(missing), "white": shot.white}
    injected["falloff"] = shot.falloff
    return FlawedCapture(Capture.read(folder), shot.white if shot.is_encoded else 1.0, injected)


def _light_of(clean: Capture, records: Sequence[CaptureRecord]) -> EnvironmentMap:
    """Return the light of a capture that can be flawed."""
    count = len({record.camera_name for record in records})
    if count < 2 or clean.environment_path is None:
        raise InvalidArrayError(
            f"capture must have 2 training cameras and an environment, got {count} and {clean.environment_path} in "
            f"{clean.folder}. Choose one that has."
        )
    if records[0].view().alpha is None:
        raise InvalidArrayError(f"capture must have coverage, got none in {clean.folder}. Choose one that has.")
    return EnvironmentMap.read(clean.environment_path)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Shot:
    """How images are taken: the flaws, those of each camera, white, the wall's radiance, and the subject's middle."""

    flaws: frozenset[str]
    size: float
    seed: int
    cameras: Mapping[str, CameraFlaws]
    white: float
    wall: NDArray[np.float64]
    center: NDArray[np.float64]

    @classmethod
    def drawn(
        cls, records: Sequence[CaptureRecord], light: EnvironmentMap, flaws: frozenset[str], size: float, seed: int
    ) -> _Shot:
        """Draw what is wrong with the cameras of a capture."""
        rig = {record.camera_name: record.camera for record in records}
        cameras = draw_camera_flaws(rig, flaws, size, seed)
        poses = np.stack([camera.camera_to_world for camera in rig.values()])
        center = meeting_point(poses)
        return cls(
            flaws=flaws,
            size=size,
            seed=seed,
            cameras=cameras,
            white=_white(records, flaws, size, max(flaw.gains.max() for flaw in cameras.values())),
            wall=PLATE_ALBEDO * light.mean_radiance(),
            center=poses[:, :3, 3].mean(axis=0) if center is None else center,
        )

    @property
    def is_encoded(self) -> bool:
        """Whether images are 8-bit files, in which white is 1."""
        return not self.flaws.isdisjoint(("noise", "jpeg"))

    @property
    def is_photograph(self) -> bool:
        """Whether images show the wall, and masks lie beside them."""
        return not self.flaws.isdisjoint(("plate", "masks", "hard-masks", "blots", "jpeg"))

    @property
    def falloff(self) -> float:
        """Power of the cosine of the angle to the optical axis that darkens images."""
        return COSINE_POWER * self.size if "vignetting" in self.flaws else 0.0

    def files(self, record: CaptureRecord) -> dict[str, str]:
        """Return the names of a record's files, as ``transforms.json`` has them."""
        suffix = "jpg" if "jpeg" in self.flaws else "png" if self.is_encoded else "exr"
        place = f"{record.camera_name}/{record.frame:04d}"
        mask = {"mask_path": f"masks/{place}.png"} if self.is_photograph else {}
        return {"file_path": f"images/{place}.{suffix}", **mask}

    def entry(self, record: CaptureRecord, rate: float) -> dict[str, Any]:
        """Return what ``transforms.json`` says of a record."""
        pose = self.cameras[record.camera_name].stated(record.camera, self.center)
        stated = replace(record.camera, camera_to_world=pose)
        entry = transforms_record(record.camera_name, "train", record.frame, stated, rate, has_truth=False)
        return entry | self.files(record)

    def write(self, root: Path, record: CaptureRecord) -> None:
        """Write a record's image, and its mask if it has one."""
        paths = {key: root / name for key, name in self.files(record).items()}
        for path in paths.values():
            path.parent.mkdir(parents=True, exist_ok=True)
        flaws = self.cameras[record.camera_name]
        layers = self._seen(record, flaws)
        alpha = layers[..., 3]
        if "cutouts" in self.flaws and not self.is_photograph:
            coverage = offset_coverage(alpha, flaws.mask_pixels)
            layers = np.dstack([straight(layers) * coverage[..., None], coverage])
            alpha = coverage
        color = layers[..., :3] if not self.is_encoded else straight(layers)
        if self.is_photograph:
            wall = plate(alpha.shape, self.wall, stream(self.seed, "plate", record.camera_name))
            color = layers[..., :3] + (1.0 - alpha[..., None]) * wall
            coverage = self._blotted(offset_coverage(alpha, flaws.mask_pixels), record)
            if "hard-masks" in self.flaws:
                coverage = np.where(coverage > SOLID, 1.0, 0.0)
            write_png(paths["mask_path"], eight_bits(coverage))
        light = self._counted(color * flaws.gains * record.camera.axis_cosines()[..., None] ** self.falloff, record)
        if "jpeg" in self.flaws:
            write_jpeg(paths["file_path"], light / self.white, round(100 - JPEG_LOSS * self.size))
        elif self.is_encoded:
            write_eight_bits(paths["file_path"], light / self.white, None if self.is_photograph else alpha)
        else:
            write_linear(paths["file_path"], light if self.is_photograph else np.dstack([light, alpha]))

    def _seen(self, record: CaptureRecord, flaws: CameraFlaws) -> NDArray[np.float64]:
        """Return what arrives at the sensor of the subject, premultiplied, and its coverage, ``(H, W, 4)``."""
        layers = _layers(record)
        if "motion-blur" in self.flaws:
            angle = stream(self.seed, "motion-blur", str(record.frame)).uniform(0.0, 2.0 * np.pi)
            way = record.camera.camera_to_world[:3, :3].T @ [np.cos(angle), np.sin(angle), 0.0]
            layers = motion_blurred(layers, BLUR_PIXELS * self.size * way[:2])
        if flaws.k1:
            layers = distorted(layers, record.camera, flaws.k1)
        if "defocus" in self.flaws:
            layers = defocused(layers, DEFOCUS_PIXELS * self.size)
        layers[..., 3] = np.clip(layers[..., 3], 0.0, 1.0)  # filters and splines overshoot beside edges
        return np.maximum(layers, 0.0)

    def _blotted(self, coverage: NDArray[np.float64], record: CaptureRecord) -> NDArray[np.float64]:
        """Return a mask with pixels in the wrong, if it is one that has some."""
        generator = stream(self.seed, "blots", record.name)
        if "blots" not in self.flaws or generator.uniform() > BLOTTED_PART:
            return coverage
        return blotted_coverage(coverage, BLOT_PIXELS * self.size, generator)

    def _counted(self, light: NDArray[np.float64], record: CaptureRecord) -> NDArray[np.float64]:
        """Return what the sensor counts of light, in the clean capture's units."""
        if "noise" in self.flaws:
            generator = stream(self.seed, "noise", record.name)
            light = self.white * noisy(light / self.white, self.size, generator)
        return np.minimum(light, self.white) if "clipping" in self.flaws else light


def _layers(record: CaptureRecord) -> NDArray[np.float64]:
    """Return a record's premultiplied colour and coverage, ``(H, W, 4)``."""
    view = record.view()
    alpha = np.ones(view.color.shape[:2]) if view.alpha is None else view.alpha
    return np.dstack([view.color, alpha]).astype(np.float64)


def _white(records: Collection[CaptureRecord], flaws: Collection[str], size: float, gain: float) -> float:
    """Return the light above which pixels are white: more of the subject's are above it if they are to be clipped.

    ``gain`` is that of the most sensitive camera, which shows the highlights too where nothing is to be clipped.
    """
    if set(flaws).isdisjoint(("noise", "jpeg", "clipping")):
        return 1.0
    part, gain = (CLIPPED_PART * size, 1.0) if "clipping" in flaws else (HEADROOM, gain)
    bright = [layers[layers[..., 3] > 0.999, :3].max(axis=-1) for layers in map(_layers, records)]
    return gain * float(np.quantile(np.concatenate(bright), 1.0 - part))


def _stated_light(light: EnvironmentMap, shot: _Shot) -> tuple[EnvironmentMap, dict[str, float]]:
    """Return the light as the copy states it, in the units of its images, and what is wrong with it."""
    turn, gain = 0.0, 1.0
    if "light" in shot.flaws:
        turn = LIGHT_DEGREES * shot.size * float(stream(shot.seed, "light").choice([-1.0, 1.0]))
        gain = 1.0 + LIGHT_GAIN * shot.size
    white = shot.white if shot.is_encoded else 1.0
    said = {"turn_degrees": turn, "gain": gain} if "light" in shot.flaws else {}
    return light.rotated(turn).scaled(gain / white), said


def _missing(records: Collection[CaptureRecord], shot: _Shot) -> set[str]:
    """Return the names of records whose image is missing: of some cameras, in one frame each, drawn."""
    if "missing-image" not in shot.flaws:
        return set()
    generator, names = stream(shot.seed, "missing-image"), list(shot.cameras)
    frames = sorted({record.frame for record in records})
    chosen = generator.permutation(names)[: max(1, round(MISSING_CAMERAS * shot.size))]
    pairs = {(str(name), frames[generator.integers(len(frames))]) for name in chosen}
    return {record.name for record in records if (record.camera_name, record.frame) in pairs}
