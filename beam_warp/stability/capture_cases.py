"""Captures on which reconstructions fail: changes of a capture that has truth, and what must be detected of each.

Where a case only takes images away or changes their values, nothing is written: its records read the given capture's
files and change them in memory. Cases that show something else are path traced once, when they are asked for.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_choice
from beam_warp.demo.capture import (
    DANCE_SECONDS,
    FRAMES_PER_SECOND,
    DomeCamera,
    demo_figure_for,
    dome_cameras,
    write_capture,
)
from beam_warp.demo.figure import Figure
from beam_warp.demo.lights import studio
from beam_warp.errors import InvalidArrayError
from beam_warp.image.files import Image
from beam_warp.world.mesh import MaterialMesh

BLACK_IMAGE = "black-image"
EMPTY_MASK = "empty-mask"
MISSING_IMAGE = "missing-image"
FRAME_LACKS_CAMERAS = "frame-lacks-cameras"
CAMERA_EXPOSURE = "camera-exposure"
FEW_CAMERAS = "few-cameras"
TRACKING_LOST = "tracking-lost"
NEW_SURFACE = "new-surface"
FAST_MOTION = "fast-motion"
"""Codes of what must be detected: of the inspection of a capture, and of tracking."""

WRONG_EXPOSURE = 2.0
SLIGHTLY_WRONG_EXPOSURE = 2.0**-0.5
BRIEF_FRAMES = 2
"""Frames of a case that a camera is at fault in: a key frame and a tracked one."""

GREY = 0.35
"""Base colour and roughness of the figure without texture: 0.35 and 0.6."""
GREY_ROUGHNESS = 0.6

CONTACT_TURN = 22.5
"""Turn of upper arms and forearms at which the hands touch the dress [degree]."""

APART = 0.7
"""Part of that turn from which the hands set out, some 9 cm away."""

SPHERE_RADIUS = 0.14
SPHERE_CENTER = (0.42, -0.30, 0.14)
"""A ball beside the feet, within what every camera sees [m]."""

SPHERE_COLOR = (0.65, 0.12, 0.08)


@dataclass(frozen=True)
class Detection:
    """Something that a reconstruction noticed about its input or about itself.

    Attributes:
        code: Names the kind.
        camera: Which camera, where it is about one.
        frame: Which frame, where it is about one.
    """

    code: str
    camera: str | None = None
    frame: int | None = None

    def covers(self, other: Detection) -> bool:
        """Whether this says what the other asks for: its kind, and its camera and frame where it names them."""
        return (
            self.code == other.code
            and (other.camera is None or self.camera == other.camera)
            and (other.frame is None or self.frame == other.frame)
        )

    def __str__(self) -> str:
        """Return it in words: ``camera-exposure of train_03 in frame 2``."""
        of = "" if self.camera is None else f" of {self.camera}"
        return f"{self.code}{of}" + ("" if self.frame is None else f" in frame {self.frame}")


class SaidOfCapture(Protocol):
    """What the inspection of a capture says: a kind, and where in words."""

    @property
    def code(self) -> str:
        """Names the kind."""
        ...

    @property
    def what(self) -> str:
        """What is wrong."""
        ...

    @property
    def where(self) -> str:
        """Cameras, records or frames."""
        ...


def detections_of(said: Iterable[SaidOfCapture], cameras: Sequence[str]) -> tuple[Detection, ...]:
    """Return what an inspection says as detections: one for each camera that it names, or one without."""
    found = []
    for finding in said:
        text = f"{finding.where} {finding.what}"
        named = [name for name in cameras if re.search(rf"(?<!\w){re.escape(name)}(?![A-Za-z0-9])", text)]
        found += [Detection(finding.code, name) for name in named] or [Detection(finding.code)]
    return tuple(found)


def in_words(detections: Sequence[Detection]) -> tuple[str, ...]:
    """Return detections in words, those of the same kind and camera as one: ``new-surface in frame 2, 3``."""
    frames: dict[tuple[str, str | None], list[int | None]] = {}
    for found in detections:
        frames.setdefault((found.code, found.camera), []).append(found.frame)
    words = []
    for (code, camera), numbers in frames.items():
        known = sorted({number for number in numbers if number is not None})
        words.append(str(Detection(code, camera)) + (f" in frame {', '.join(map(str, known))}" if known else ""))
    return tuple(words)


@dataclass(frozen=True, kw_only=True)
class CaptureStress:
    """A capture with something wrong, and what must be found out about it.

    Attributes:
        capture: What is reconstructed; its test records are as they should be, for scores.
        required: What must be detected.
        may_refuse: Whether refusing it, by a clear error before anything is optimised, counts as detected too.
        is_sound: Whether nothing is wrong with it: then nothing must be detected.
    """

    capture: Capture
    required: tuple[Detection, ...] = ()
    may_refuse: bool = False
    is_sound: bool = False


@dataclass(eq=False)
class StressStudio:
    """Where cases take their captures from: a given one, or the demo figure, path traced when first asked for.

    Attributes:
        folder: Where captures are written to, each in a folder of its own; it must exist.
        given: The capture that is changed; the demo's without.
        frame_count: Frames of what is path traced.
        camera_count: Its training cameras.
        size: Side of its images [pixel].
        samples: Paths per pixel.
        device: Warp device.
    """

    folder: Path
    given: Capture | None = None
    frame_count: int = 4
    camera_count: int = 12
    size: int = 128
    samples: int = 16
    device: str | None = None
    _written: dict[str, Capture] = field(default_factory=dict, init=False)
    _figure: Figure | None = field(default=None, init=False)

    @property
    def figure(self) -> Figure:
        """The demo figure, meshed once."""
        if self._figure is None:
            self._figure = demo_figure_for(self.size)
        return self._figure

    def dancing(self) -> list[MaterialMesh]:
        """Return the figure in every frame of its dance."""
        period = FRAMES_PER_SECOND * DANCE_SECONDS
        return [self.figure.at(frame / period) for frame in range(self.frame_count)]

    def base(self) -> Capture:
        """Return the capture that cases change."""
        return self.given or self.traced("as it is", self.dancing)

    def brief(self) -> Capture:
        """Return its first frames, for cases that a camera is at fault in."""
        base = self.base()
        return replace(base, records=base.select(frames=base.frames[:BRIEF_FRAMES]))

    def traced(self, name: str, make: Callable[[], Sequence[MaterialMesh]]) -> Capture:
        """Return a capture of meshes, one a frame, path traced when first asked for."""
        if name not in self._written:
            meshes = make()
            cameras: list[DomeCamera] = dome_cameras(
                [mesh.vertices for mesh in meshes], self.camera_count, 2, self.size, self.size
            )
            self._written[name] = write_capture(
                self.folder / name.replace(" ", "_"),
                meshes,
                cameras,
                studio(),
                samples=self.samples,
                device=self.device,
            )
        return self._written[name]


@dataclass(frozen=True)
class CaptureCase:
    """One entry of the registry.

    Attributes:
        name: Short and unique.
        fails: How a reconstruction without precautions fails here.
        must: What must come of it.
        build: Makes the capture; the same each time.
        traced: Whether it shows something else than the given capture, and needs the demo figure.
    """

    name: str
    fails: str
    must: str
    build: Callable[[StressStudio], CaptureStress]
    traced: bool


CAPTURE_CASES: list[CaptureCase] = []
"""Every case, in the order of the table; the first is the capture as it is."""


def capture_case(
    name: str, fails: str, must: str, *, traced: bool = False
) -> Callable[[Callable[[StressStudio], CaptureStress]], Callable[[StressStudio], CaptureStress]]:
    """Register the function below it as a case."""

    def register(build: Callable[[StressStudio], CaptureStress]) -> Callable[[StressStudio], CaptureStress]:
        CAPTURE_CASES.append(CaptureCase(name, fails, must, build, traced))
        return build

    return register


def capture_case_of(name: str) -> CaptureCase:
    """Return a case by its name.

    Raises:
        InvalidOptionError: There is none.
    """
    require_choice("case", name, tuple(case.name for case in CAPTURE_CASES))
    return next(case for case in CAPTURE_CASES if case.name == name)


@dataclass(frozen=True, eq=False, kw_only=True)
class AlteredRecord(CaptureRecord):
    """A record whose image is changed as it is read; its truth is not.

    Attributes:
        gain: Of the colour.
        coverage: Of alpha.
    """

    gain: float = 1.0
    coverage: float = 1.0

    @classmethod
    def of(cls, record: CaptureRecord, gain: float, coverage: float) -> AlteredRecord:
        """Return a record that changes its image."""
        known = {entry.name: getattr(record, entry.name) for entry in fields(CaptureRecord)}
        return cls(**known, gain=gain, coverage=coverage)

    def image(self) -> Image:
        """Read the image and change it."""
        image = super().image()
        factors = {**dict.fromkeys("RGBY", self.gain), "A": self.coverage}
        return replace(
            image,
            channels={name: values * np.float32(factors.get(name, 1.0)) for name, values in image.channels.items()},
        )

    def view(self) -> CapturedView:
        """Read the view and change it."""
        view = super().view()
        alpha = None if view.alpha is None else view.alpha * np.float32(self.coverage)
        return replace(view, color=view.color * np.float32(self.gain), alpha=alpha)


def training_cameras(capture: Capture) -> tuple[str, ...]:
    """Return the names of the cameras that train, in file order."""
    return tuple(dict.fromkeys(record.camera_name for record in capture.select(split="train")))


def with_cameras(capture: Capture, kept: Sequence[str]) -> Capture:
    """Return a capture with some of its training cameras; test cameras stay."""
    return replace(capture, records=tuple(r for r in capture.records if r.split != "train" or r.camera_name in kept))


def with_every(capture: Capture, step: int) -> Capture:
    """Return a capture with its first frame and every ``step``-th after it, under their own numbers and times.

    Raises:
        InvalidArrayError: Only one frame would be left.
    """
    frames = capture.frames[::step]
    if len(frames) < 2:
        raise InvalidArrayError(
            f"capture must have more than {step} frames to leave out all but every {step}th, "
            f"got {len(capture.frames)}. Choose a longer one."
        )
    return replace(capture, records=capture.select(frames=frames))


def with_altered(capture: Capture, camera: str, *, gain: float = 1.0, coverage: float = 1.0) -> Capture:
    """Return a capture in which one camera's images are changed as they are read."""
    return replace(
        capture,
        records=tuple(AlteredRecord.of(r, gain, coverage) if r.camera_name == camera else r for r in capture.records),
    )


def evenly(names: Sequence[str], count: int) -> tuple[str, ...]:
    """Return some of the names, evenly spread over all of them.

    Raises:
        InvalidArrayError: There are not as many.
    """
    if count > len(names):
        raise InvalidArrayError(f"capture must have {count} training cameras, got {len(names)}. Choose a larger one.")
    return tuple(names[index * len(names) // count] for index in range(count))


def _victim(capture: Capture) -> str:
    """Return the camera that something happens to: one of the middle."""
    names = training_cameras(capture)
    return names[len(names) // 2]


@capture_case("as it is", "nothing fails here", "nothing detected: what is found elsewhere is no habit")
def _as_it_is(at: StressStudio) -> CaptureStress:
    return CaptureStress(capture=at.base(), is_sound=True)


@capture_case(
    "every second frame",
    "motion of several pixels a frame drives Gaussians into the nearest colour that fits",
    "followed, or the loss detected and a key frame started",
)
def _every_second(at: StressStudio) -> CaptureStress:
    return CaptureStress(capture=with_every(at.base(), 2))


@capture_case(
    "every third frame",
    "the same, faster",
    "followed, or the loss detected and a key frame started",
)
def _every_third(at: StressStudio) -> CaptureStress:
    return CaptureStress(capture=with_every(at.base(), 3))


@capture_case(
    "no texture",
    "colour says nothing about where a point went: Gaussians slide over the surface",
    "outlines and shading hold the surface; drift is reported",
    traced=True,
)
def _no_texture(at: StressStudio) -> CaptureStress:
    def plain() -> list[MaterialMesh]:
        return [
            replace(
                mesh,
                base_color=np.full_like(mesh.base_color, GREY),
                roughness=np.full_like(mesh.roughness, GREY_ROUGHNESS),
            )
            for mesh in at.dancing()
        ]

    return CaptureStress(capture=at.traced("no texture", plain))


@capture_case(
    "self-contact",
    "what is near in space but not on the surface is smoothed together: hands tear off a piece of the dress",
    "hands and dress keep apart in the motion; drift is reported",
    traced=True,
)
def _self_contact(at: StressStudio) -> CaptureStress:
    return CaptureStress(capture=at.traced("self-contact", lambda: touching(at.figure, at.frame_count)))


@capture_case(
    "black camera",
    "black is trained into every Gaussian that the camera sees",
    "the camera detected and left out",
)
def _black_camera(at: StressStudio) -> CaptureStress:
    base = at.brief()
    name = _victim(base)
    return CaptureStress(capture=with_altered(base, name, gain=0.0), required=(Detection(BLACK_IMAGE, name),))


@capture_case(
    "empty camera",
    "one mask of nothing carves all of the subject out of the visual hull",
    "the camera detected and left out",
)
def _empty_camera(at: StressStudio) -> CaptureStress:
    base = at.brief()
    name = _victim(base)
    return CaptureStress(
        capture=with_altered(base, name, gain=0.0, coverage=0.0), required=(Detection(EMPTY_MASK, name),)
    )


@capture_case(
    "camera without files",
    "the run ends with a stack trace after minutes, when the file is first opened",
    "refused before anything is optimised, or the camera detected and left out",
)
def _camera_without_files(at: StressStudio) -> CaptureStress:
    base = at.brief()
    name = _victim(base)
    gone = tuple(
        replace(r, image_path=r.image_path.with_name(f"absent_{r.image_path.name}")) if r.camera_name == name else r
        for r in base.records
    )
    return CaptureStress(
        capture=replace(base, records=gone), required=(Detection(MISSING_IMAGE, name),), may_refuse=True
    )


@capture_case(
    "camera that stops",
    "loops over cameras that were counted in the first frame read another camera's image",
    "the camera's absence detected from the second frame on",
)
def _camera_that_stops(at: StressStudio) -> CaptureStress:
    base = at.brief()
    name, first = _victim(base), base.frames[0]
    kept = tuple(r for r in base.records if r.camera_name != name or r.frame == first)
    return CaptureStress(capture=replace(base, records=kept), required=(Detection(FRAME_LACKS_CAMERAS, name),))


@capture_case(
    "wrong exposure",
    "one camera is twice as bright: colour that depends on direction takes it up, floaters stand before the camera",
    "the camera's exposure detected, and corrected or left out",
)
def _wrong_exposure(at: StressStudio) -> CaptureStress:
    base = at.brief()
    name = _victim(base)
    return CaptureStress(
        capture=with_altered(base, name, gain=WRONG_EXPOSURE),
        required=(Detection(CAMERA_EXPOSURE, name),),
    )


@capture_case(
    "exposure half a stop off",
    "the same, where no histogram shows it: light from one side makes views differ by more",
    "the camera's exposure detected, and corrected",
)
def _slightly_wrong_exposure(at: StressStudio) -> CaptureStress:
    base = at.brief()
    name = _victim(base)
    return CaptureStress(
        capture=with_altered(base, name, gain=SLIGHTLY_WRONG_EXPOSURE),
        required=(Detection(CAMERA_EXPOSURE, name),),
    )


@capture_case(
    "4 cameras",
    "training views are matched by Gaussians that no other view confirms",
    "few views detected; geometry held by the hull and by smoothness",
)
def _four_cameras(at: StressStudio) -> CaptureStress:
    base = at.base()
    return CaptureStress(
        capture=with_cameras(base, evenly(training_cameras(base), 4)), required=(Detection(FEW_CAMERAS),)
    )


@capture_case(
    "8 cameras",
    "concave parts that two cameras at most see bulge to the hull",
    "reconstructed; what is lost against all cameras is told",
)
def _eight_cameras(at: StressStudio) -> CaptureStress:
    base = at.base()
    return CaptureStress(capture=with_cameras(base, evenly(training_cameras(base), 8)))


@capture_case(
    "an object appears",
    "nothing is there to move: Gaussians of the feet are stretched over the ball",
    "new surface detected in the frame where it appears, and a key frame started",
    traced=True,
)
def _object_appears(at: StressStudio) -> CaptureStress:
    first = max(1, at.frame_count // 2)

    def appearing() -> list[MaterialMesh]:
        return [mesh if frame < first else beside(mesh, ball()) for frame, mesh in enumerate(at.dancing())]

    return CaptureStress(
        capture=at.traced("an object appears", appearing), required=(Detection(NEW_SURFACE, frame=first),)
    )


def touching(figure: Figure, frame_count: int) -> list[MaterialMesh]:
    """Return the figure lowering its hands until they touch its dress in the last frame."""
    meshes = []
    for frame in range(frame_count):
        share = APART + (1.0 - APART) * (frame / max(frame_count - 1, 1))
        turn = CONTACT_TURN * share
        turns = {
            f"{side} {bone}": (0.0, sign * turn, 0.0)
            for side, sign in (("left", 1.0), ("right", -1.0))
            for bone in ("arm", "forearm")
        }
        meshes.append(figure.posed(turns))
    return meshes


def ball() -> MaterialMesh:
    """Return the object that appears."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=SPHERE_RADIUS)
    normals: NDArray[np.float32] = (sphere.vertices / SPHERE_RADIUS).astype(np.float32)
    return MaterialMesh(
        vertices=(sphere.vertices + np.asarray(SPHERE_CENTER)).astype(np.float32),
        faces=sphere.faces,
        normals=normals,
        base_color=np.tile(SPHERE_COLOR, (len(normals), 1)),
        roughness=np.full(len(normals), 0.4),
    )


def beside(mesh: MaterialMesh, other: MaterialMesh) -> MaterialMesh:
    """Return two meshes as one, the first's vertices and triangles first."""
    joined = {
        name: np.concatenate([getattr(mesh, name), getattr(other, name)])
        for name in ("vertices", "normals", "base_color", "roughness")
    }
    return MaterialMesh(faces=np.concatenate([mesh.faces, other.faces + len(mesh.vertices)]), **joined)
