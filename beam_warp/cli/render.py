"""``beam render``: an asset under a given light, or one of its channels, from one camera or from those of a capture."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional, arg

from beam_warp import converters
from beam_warp.asset_metadata import numbers_of_frames
from beam_warp.assets import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.axes import change_axes
from beam_warp.cameras import MAX_SIDE, Camera, bulk
from beam_warp.captures import Capture
from beam_warp.checks import require_choice, require_count, require_range
from beam_warp.cli.console import print_json, progress
from beam_warp.cli.drawing import Antialiased, LowPass, raster_options
from beam_warp.environments import EnvironmentMap
from beam_warp.errors import InvalidOptionError, OutputError
from beam_warp.images import display_image, srgb_to_linear, write_exr, write_png

if TYPE_CHECKING:
    from beam_warp.raster_records import RasterOptions

DEFAULT_SIDE = 1024
"""Width and height where none is given [pixel]."""

_LIT = ("environment", "rotate", "exposure", "background", "aov")
"""Options of what is lit."""

FRAMING_FRAMES = 3
"""A camera that frames a moving subject looks at this many of its frames: first, last and between."""


@dataclass(frozen=True)
class Render:
    """Light a relightable asset and draw it, or draw one of its channels.

    Without a camera, the asset is framed from the front. With --capture, every test record of the capture is drawn
    into the folder --out as CAMERA_FRAME.exr: with --aov, in the layers and units of the capture's ground truth.

    With --channel, one array is drawn and no light: a .png shows colours as they are, numbers and standard errors by a
    colour map whose range is printed, observability as the gravest flag of what each pixel sees, counted in the legend;
    an .exr holds the values. With --capture these are .png.

    Example: beam render person.usdz --environment studio.hdr --orbit 30 10 --out person.png

    Example: beam render person.usdz --channel base_color_error --out error.png
    """

    asset: Annotated[Positional[Path], arg(metavar="ASSET", help="PLY or USD file, or a folder of numbered PLY files.")]
    out: Annotated[
        Path, arg(metavar="FILE", help=".png or .exr, numbered if there are several frames; a folder with --capture.")
    ]
    environment: Annotated[
        Path | None, arg(metavar="FILE", help="Lat-long light, .exr or .hdr; by default the capture's own.")
    ] = None
    channel: Annotated[
        str | None, arg(metavar="NAME", help="Draw this array instead: roughness_error, observability, normals, ….")
    ] = None
    range: Annotated[
        tuple[float, float] | None,
        arg(
            metavar="LOW HIGH",
            help="Ends of the colour map of --channel; by default 0 and what most Gaussians are below.",
        ),
    ] = None
    orbit: Annotated[
        tuple[float, float] | None,
        arg(metavar="AZIMUTH ELEVATION", help="Frame the asset from here, in degrees; 0 0 looks along +y."),
    ] = None
    look_at: Annotated[
        tuple[float, float, float, float, float, float] | None,
        arg(metavar="EX EY EZ TX TY TZ", help="Camera position and what it looks at, in metres, z up."),
    ] = None
    capture: Annotated[Path | None, arg(metavar="DIR", help="Draw from the cameras of this capture.")] = None
    split: Annotated[str, arg(help="Which records of the capture.")] = "test"
    frame: Annotated[int | None, arg(metavar="N", help="Only this frame, counted from 0; all by default.")] = None
    width: Annotated[int | None, arg(metavar="PX", help=f"Image width; {DEFAULT_SIDE} by default.")] = None
    height: Annotated[int | None, arg(metavar="PX", help="Image height; the width by default.")] = None
    fov: Annotated[float | None, arg(metavar="DEG", help="Vertical field of view; 35 by default.")] = None
    rotate: Annotated[float, arg(metavar="DEG", help="Turn the light about z, counter-clockwise from above.")] = 0.0
    exposure: Annotated[float, arg(metavar="STOPS", help="Brighten the light by powers of two.")] = 0.0
    background: Annotated[
        tuple[float, float, float] | Literal["transparent"],
        arg(metavar="R G B", help="Display colour behind the asset, 0 to 1; transparent by default."),
    ] = "transparent"
    aov: Annotated[
        bool,
        arg(help="Also write base colour, roughness, occlusion, what errors there are of them, normal, depth (.exr)."),
    ] = False
    antialiased: Antialiased = None
    low_pass: LowPass = None
    source_axes: Annotated[str | None, arg(metavar="CODE", help="Axes of a PLY that does not state them.")] = None
    drop_invalid: Annotated[bool, arg(help="Leave out rows with NaN or zero quaternions, and say how many.")] = False
    device: Annotated[str | None, arg(help="cpu, cuda:0, …; the first GPU by default, if there is one.")] = None
    quiet: Annotated[bool, arg(help="Print nothing but errors.")] = False
    json: Annotated[bool, arg(help="Print the result as JSON.")] = False


@dataclass(frozen=True)
class View:
    """One image to draw: which frame, from where, into which file."""

    frame: int
    camera: Camera
    path: Path


def render(args: Render) -> int:
    """Draw what was asked for, and say what was written."""
    started = time.perf_counter()
    _require_consistent(args)
    capture = None if args.capture is None else Capture.read(args.capture)
    environment = None if args.channel is not None else _environment(args, capture)
    sequence = converters.read(args.asset, source_axes=args.source_axes, drop_invalid=args.drop_invalid)
    _require_frame(args, len(sequence))
    options = raster_options(sequence.metadata, args.antialiased, args.low_pass)
    notes = [line for line in sequence.metadata.get("notes", "").splitlines() if line]
    if capture is not None:
        views = _capture_views(args, capture, numbers_of_frames(sequence.metadata, len(sequence)), notes)
    else:
        views = _numbered_views(args, sequence)

    from beam_warp.devices import resolve_device

    device = str(resolve_device(args.device))
    drawing = _Channel(args, options) if environment is None else _Relit(args, options, environment, device)
    gaussian_count = 0
    with progress(args.quiet or args.json) as report:
        for done, (view, cloud) in enumerate(_with_clouds(args, views, sequence), start=1):
            drawing.draw(view, cloud)
            gaussian_count = max(gaussian_count, len(cloud))
            report("render", done, len(views))
    seconds = time.perf_counter() - started
    if args.json:
        print_json(
            {
                "outputs": [str(view.path) for view in views],
                "frames": sorted({view.frame for view in views}),
                "gaussian_count": gaussian_count,
                "device": device,
                "notes": notes,
                **drawing.facts(),
                "seconds": round(seconds, 3),
            }
        )
    elif not args.quiet:
        for note in notes:
            print(f"note: {note}", file=sys.stderr)
        last = f" … {views[-1].path.name}" if len(views) > 1 else ""
        images = f"{len(views)} images, " if len(views) > 1 else ""
        print(f"wrote {views[0].path}{last}: {images}{gaussian_count:,} Gaussians, {seconds:.2f} s")
        for line in drawing.lines():
            print(line)
    return 0


def _environment(args: Render, capture: Capture | None) -> EnvironmentMap:
    """Read the light, as it is to be used."""
    path = args.environment or (None if capture is None else capture.environment_path)
    if path is None:
        raise InvalidOptionError(
            "environment must be given, got none. Pass --environment with a lat-long .exr or .hdr image."
        )
    return EnvironmentMap.read(path).rotated(args.rotate).exposed(args.exposure)


def _require_consistent(args: Render) -> None:
    """Refuse options that contradict each other, before anything is read."""
    given = [
        flag
        for flag, value in (("orbit", args.orbit), ("look-at", args.look_at), ("capture", args.capture))
        if value is not None
    ]
    if len(given) > 1:
        raise InvalidOptionError(f"camera must be given once, got --{' and --'.join(given)}. Leave one out.")
    if args.channel is None and args.range is not None:
        raise InvalidOptionError(f"range must come with --channel, got {args.range} without. Leave it out.")
    if args.channel is not None:
        _require_channel(args)
    if args.background != "transparent":
        require_range("background", np.asarray(args.background), 0.0, 1.0, "Use display values from 0 to 1.")
    if args.capture is not None:
        sized = [name for name in ("width", "height", "fov") if getattr(args, name) is not None]
        if sized:
            raise InvalidOptionError(
                f"{sized[0]} must be left out with --capture, got {getattr(args, sized[0])}. "
                "Its cameras have their own."
            )
        if args.out.exists() and not args.out.is_dir():
            raise OutputError(f"out must be a folder with --capture, got the file {args.out}. Name a folder.")
        return
    if args.out.suffix.lower() not in (".png", ".exr"):
        raise InvalidOptionError(f"out must end in .png or .exr, got {args.out.name}. Rename it.")
    if args.aov and args.out.suffix.lower() != ".exr":
        raise InvalidOptionError(f"out must end in .exr to hold the layers of --aov, got {args.out.name}. Rename it.")
    if not args.out.parent.is_dir():
        raise OutputError(f"out must be in a folder that exists, got {args.out.parent}. Create it first.")


def _require_channel(args: Render) -> None:
    """Refuse a channel that is none, and what a channel has no use for."""
    from beam_warp.channel_images import DRAWABLE

    require_choice("channel", args.channel or "", DRAWABLE)
    lit = {field.name: field.default for field in fields(args) if field.name in _LIT}
    superfluous = [name for name, default in lit.items() if getattr(args, name) != default]
    if superfluous:
        raise InvalidOptionError(
            f"{superfluous[0]} must be left out with --channel, got {getattr(args, superfluous[0])}: a channel is "
            "drawn on grey, and without light. Leave it out."
        )
    if args.range is not None and not args.range[0] < args.range[1]:
        raise InvalidOptionError(f"range must be two numbers, the lower one first, got {args.range}. Swap them.")


def _require_frame(args: Render, frame_count: int) -> None:
    """Refuse a frame that the asset lacks."""
    if args.frame is not None:
        require_count("frame", args.frame, 0, frame_count - 1)


def _capture_views(args: Render, capture: Capture, numbers: tuple[int, ...], notes: list[str]) -> list[View]:
    """Plan one image for each record of the split whose frame the asset has; say what is left out."""
    records = capture.select(split=args.split, frames=None if args.frame is None else (numbers[args.frame],))
    if not records:
        frame = "" if args.frame is None else f" of frame {numbers[args.frame]}"
        raise InvalidOptionError(
            f"split must name records of the capture{frame}, got {args.split!r} "
            f"(it has {', '.join(capture.splits)}). Choose one of them."
        )
    place = {number: frame for frame, number in enumerate(numbers)}
    within = [record for record in records if record.frame in place]
    if len(within) < len(records):
        beyond = sorted({record.frame for record in records} - place.keys())
        notes.append(
            f"{len(records) - len(within)} records are of frames that the asset lacks "
            f"({', '.join(map(str, beyond[:5]))}{', …' if len(beyond) > 5 else ''}): not drawn"
        )
    if not within:
        raise InvalidOptionError(
            f"asset must have a frame that the records of split {args.split!r} show, got {len(numbers)} frames in "
            f"{args.asset}. Choose another split."
        )
    bent = sum(record.is_distorted for record in within)
    if bent:
        notes.append(f"{bent} records were photographed through a lens that bends lines: drawn as undistorted images")
    try:
        args.out.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"out must be a folder that can be made, got {args.out} ({error.strerror}). Name another."
        ) from error
    suffix = "exr" if args.channel is None else "png"
    return [View(place[record.frame], record.camera, args.out / f"{record.name}.{suffix}") for record in within]


def _numbered_views(args: Render, sequence: GaussianSequence) -> list[View]:
    """Plan one image for each frame, all from one camera."""
    frames = range(len(sequence)) if args.frame is None else range(args.frame, args.frame + 1)
    camera = _camera(args, sequence, frames)
    if len(frames) == 1:
        return [View(frames[0], camera, args.out)]
    return [View(frame, camera, converters.numbered_path(args.out, frame)) for frame in frames]


def _camera(args: Render, sequence: GaussianSequence, frames: range) -> Camera:
    """Place the camera that was asked for; one that frames the asset sees several of its frames."""
    width = require_count("width", DEFAULT_SIDE if args.width is None else args.width, 1, MAX_SIDE)
    lens = {
        "width": width,
        "height": width if args.height is None else args.height,
        "vertical_fov": 35.0 if args.fov is None else args.fov,
    }
    if args.look_at is not None:
        return Camera.look_at(args.look_at[:3], args.look_at[3:], **lens)
    picked = sorted({frames[round(i)] for i in np.linspace(0, len(frames) - 1, FRAMING_FRAMES)})
    clouds = (_cloud(args, sequence, frame) for frame in picked)
    seen = np.concatenate([bulk(cloud.positions, cloud.opacities) for cloud in clouds])
    azimuth, elevation = (0.0, 0.0) if args.orbit is None else args.orbit
    return Camera.frame_points(seen, azimuth=azimuth, elevation=elevation, **lens)


def _with_clouds(args: Render, views: list[View], sequence: GaussianSequence) -> Iterator[tuple[View, GaussianCloud]]:
    """Give each view its cloud, frame by frame, so that each is read once and one is held at a time."""
    held, cloud = -1, None
    for view in sorted(views, key=lambda view: view.frame):
        if cloud is None or view.frame != held:
            held, cloud = view.frame, _cloud(args, sequence, view.frame)
        yield view, cloud


def _cloud(args: Render, sequence: GaussianSequence, frame: int) -> GaussianCloud:
    """Read a frame into the internal world; it must be relightable to be lit."""
    cloud = sequence[frame]
    if args.channel is None and not cloud.is_relightable:
        missing = [
            name for name in ("base_color", "roughness", "ambient_occlusion", "normals") if getattr(cloud, name) is None
        ]
        raise InvalidOptionError(
            f"asset must be relightable, got one without {', '.join(missing)} at {args.asset}. "
            "Estimate its materials with beam run."
        )
    return change_axes(cloud, WORLD_AXES)


class _Relit:
    """Draws the asset under a light."""

    def __init__(self, args: Render, options: RasterOptions, environment: EnvironmentMap, device: str) -> None:
        from beam_warp.deferred import EnvironmentLighting

        self._args = args
        self._options = options
        self._lighting = EnvironmentLighting.from_environment(environment, device=device)

    def draw(self, view: View, cloud: GaussianCloud) -> None:
        """Draw one image and write it."""
        from beam_warp.deferred import relight
        from beam_warp.rasterizing import ERROR_CHANNELS, MATERIAL_CHANNELS, rasterize

        args = self._args
        errors = [name for name in ERROR_CHANNELS if args.aov and getattr(cloud, name) is not None]
        channels = (*MATERIAL_CHANNELS, *errors)
        buffer = rasterize(cloud, view.camera, channels=channels, options=self._options, device=args.device)
        radiance = relight(buffer, self._lighting)
        alpha = buffer.alpha
        if args.background != "transparent":
            behind = srgb_to_linear(np.asarray(args.background, np.float32))
            radiance = (radiance + (1.0 - alpha[..., None]) * behind).astype(np.float32)
            alpha = np.ones_like(alpha)
        if view.path.suffix.lower() == ".png":
            write_png(view.path, _display(radiance, alpha))
            return
        layers: dict[str, NDArray[np.float32]] = dict(buffer.layers()) if args.aov else {}
        layers.update({"R": radiance[..., 0], "G": radiance[..., 1], "B": radiance[..., 2], "A": alpha})
        write_exr(view.path, layers)

    def facts(self) -> dict[str, Any]:
        """Return what JSON says of it besides."""
        return {}

    def lines(self) -> list[str]:
        """Return what is said of it besides."""
        return []


class _Channel:
    """Draws one channel of the asset; all images have one range, that of the first."""

    def __init__(self, args: Render, options: RasterOptions) -> None:
        self._args = args
        self._options = options
        self._name = args.channel or ""
        self._range = args.range
        self._is_mapped = False
        self._shares: list[dict[str, float]] = []

    def draw(self, view: View, cloud: GaussianCloud) -> None:
        """Draw one image and write it."""
        from beam_warp.channel_images import OBSERVABILITY, channel_range, see_channel

        seen = see_channel(cloud, view.camera, self._name, options=self._options, device=self._args.device)
        self._is_mapped = seen.is_mapped
        if self._range is None:
            self._range = channel_range(cloud, self._name)
        if self._name == OBSERVABILITY:
            self._shares.append(seen.flag_shares())
        if view.path.suffix.lower() == ".png":
            write_png(view.path, seen.picture(self._range))
        else:
            write_exr(view.path, seen.layers())

    def facts(self) -> dict[str, Any]:
        """Return what JSON says of it besides: the range of numbers, or the flags' shares of what is seen."""
        said: dict[str, Any] = {"channel": self._name}
        if self._shares:
            said["flags"] = {word: float(np.mean([image[word] for image in self._shares])) for word in self._shares[0]}
        elif self._is_mapped and self._range is not None:
            said["range"] = list(self._range)
        return said

    def lines(self) -> list[str]:
        """Return the same in words."""
        said = self.facts()
        if "flags" in said:
            return [f"{self._name}: " + ", ".join(f"{word} {share:.1%}" for word, share in said["flags"].items())]
        return [f"{self._name}: {said['range'][0]:g} (dark) to {said['range'][1]:g}"] if "range" in said else []


def _display(radiance: NDArray[np.float32], alpha: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Encode premultiplied radiance for a PNG, whose alpha is straight; without alpha if it is 1 everywhere."""
    straight = np.divide(radiance, alpha[..., None], out=np.zeros_like(radiance), where=alpha[..., None] > 0.0)
    color = display_image(straight)
    if (alpha == 1.0).all():
        return color
    return np.concatenate([color, np.rint(alpha[..., None] * 255.0).astype(np.uint8)], axis=-1)
