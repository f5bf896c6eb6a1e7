"""Options of ``beam render``: records of what is shown, camera, light, time, output, and one for each renderer."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp.cli.common.flags import Antialiased, Device, DropInvalid, Json, LowPass, MetersPerUnit, Quiet, SourceAxes
from beam_warp.cli.common.pages import SECOND_PAGE
from beam_warp.cli.common.targets import TargetFlags
from beam_warp.converters.numbering import SOG_NAMES


@dataclass(frozen=True)
class AssetFlags:
    """What is shown."""

    asset: Annotated[
        Positional[tuple[Path, ...]],
        arg(metavar="ASSET ...", help="Files or folders of Gaussians; or one stage as .json."),
    ]
    ground: Annotated[
        Literal["plain", "shadows"] | None, arg(help="A floor under the assets, or only the shadows on it.")
    ] = None
    spacing: Annotated[
        float | None, arg(metavar="M", help="Put the assets in a row along x, so far apart."), SECOND_PAGE
    ] = None
    on_ground: Annotated[bool, arg(help="Put the lowest point of every asset at height 0."), SECOND_PAGE] = False
    source_axes: Annotated[SourceAxes, SECOND_PAGE] = None
    meters_per_unit: Annotated[MetersPerUnit, SECOND_PAGE] = None
    drop_invalid: Annotated[DropInvalid, SECOND_PAGE] = False


@dataclass(frozen=True)
class StillCameraFlags:
    """Where a camera stands that does not move; or those of a capture."""

    orbit: Annotated[
        tuple[float, float] | None,
        arg(metavar="AZIMUTH ELEVATION", help="Frame the asset from here, in degrees; 0 0 looks along +y."),
    ] = None
    look_at: Annotated[
        tuple[float, float, float, float, float, float] | None,
        arg(metavar="EX EY EZ TX TY TZ", help="Camera position and what it looks at, in metres, z up."),
        SECOND_PAGE,
    ] = None
    capture: Annotated[Path | None, arg(metavar="DIR", help="Draw from the cameras of this capture.")] = None
    split: Annotated[str, arg(help="Which records of the capture."), SECOND_PAGE] = "test"
    width: Annotated[int | None, arg(metavar="PX", help="Image width; 1024 by default.")] = None
    height: Annotated[int | None, arg(metavar="PX", help="Image height; the width by default."), SECOND_PAGE] = None
    fov: Annotated[float | None, arg(metavar="DEG", help="Vertical field of view; 35 by default."), SECOND_PAGE] = None


@dataclass(frozen=True)
class CameraFlags(StillCameraFlags):
    """Where the camera is, and how it moves."""

    camera: Annotated[Path | None, arg(metavar="FILE", help="Camera path, .json or a USD stage's camera.")] = None
    turns: Annotated[float | None, arg(metavar="N", help="Go around the asset N times while it plays.")] = None
    turntable: Annotated[
        float | None,
        arg(metavar="DEG", help="Go around the asset, so many degrees a second, from --orbit on."),
        SECOND_PAGE,
    ] = None


@dataclass(frozen=True)
class LightFlags:
    """What shines on it."""

    environment: Annotated[
        Path | None, arg(metavar="FILE", help="Lat-long light, .exr or .hdr; by default the capture's or stage's own.")
    ] = None
    rotate: Annotated[float, arg(metavar="DEG", help="Turn it about z, counter-clockwise from above."), SECOND_PAGE] = (
        0.0
    )
    rotate_per_second: Annotated[float, arg(metavar="DEG", help="Go on turning it as the film plays."), SECOND_PAGE] = (
        0.0
    )
    lights: Annotated[Path | None, arg(metavar="FILE", help="Lights as .json: directional, point, spot.")] = None


@dataclass(frozen=True)
class TimeFlags:
    """Which moments are shown."""

    frame: Annotated[int | None, arg(metavar="N", help="Only this frame, counted from 0; all by default.")] = None
    frames: Annotated[
        str | None,
        arg(metavar="A:B[:STEP]", help="Only these frames; B is not one of them; --frames=-10: for the last ten."),
    ] = None
    seconds: Annotated[
        float | None, arg(metavar="S", help="How long it plays; all of the asset by default."), SECOND_PAGE
    ] = None
    fps: Annotated[
        float | None,
        arg(metavar="RATE", help="Images a second, blended between frames; the asset's by default."),
        SECOND_PAGE,
    ] = None
    speed: Annotated[
        float | None, arg(metavar="X", help="0.5 plays at half speed, more images for less time."), SECOND_PAGE
    ] = None
    loop: Annotated[bool, arg(help="Play assets again after their last frame; else that is held."), SECOND_PAGE] = False


@dataclass(frozen=True)
class OutputFlags:
    """Which files are written, and how they show light."""

    out: Annotated[
        Path, arg(metavar="FILE", help=".png, .exr or .mp4; frames/%04d.png for numbers; a folder with --capture.")
    ]
    background: Annotated[
        tuple[float, float, float] | Literal["transparent", "environment"],
        arg(metavar="R G B", help="Display colour behind it, 0 to 1; or the environment; transparent by default."),
    ] = "transparent"
    exposure: Annotated[float, arg(metavar="STOPS", help="Brighten what is rendered by powers of two.")] = 0.0
    view: Annotated[
        Literal["standard", "aces", "agx", "neutral"],
        arg(help="How .png and .mp4 show light above white: cut off, or bent by one of these curves."),
    ] = "standard"
    aov: Annotated[
        bool,
        arg(help="Also write base colour, roughness, occlusion, what errors there are of them, normal, depth (.exr)."),
        SECOND_PAGE,
    ] = False
    crf: Annotated[
        int | None, arg(metavar="N", help="Quality of a film, 0 (lossless) to 51; 18 by default."), SECOND_PAGE
    ] = None
    overwrite: Annotated[bool, arg(help="Replace a film, or numbered images of another render."), SECOND_PAGE] = False


@dataclass(frozen=True)
class DeferredFlags:
    """How ``--mode deferred`` renders."""

    samples: Annotated[
        int | None,
        arg(
            metavar="N",
            help="Deferred: a pixel is the mean of N x N samples, as photographs average over a pixel; by default "
            "as many as the Gaussians were fitted with, 2 at least. 1 is faster and loses up to 7 dB of base colour.",
        ),
    ] = None
    environment_shadows: Annotated[
        int | None,
        arg(metavar="N", help="Deferred: shadow maps of the environment, its small sources' among them; 0 for none."),
        SECOND_PAGE,
    ] = None
    shadow_resolution: Annotated[
        int | None, arg(metavar="PX", help="Deferred: side of a lamp's shadow map."), SECOND_PAGE
    ] = None
    antialiased: Annotated[Antialiased, SECOND_PAGE] = None
    low_pass: Annotated[LowPass, SECOND_PAGE] = None


@dataclass(frozen=True)
class PathFlags:
    """How ``--mode path`` renders."""

    spp: Annotated[int | None, arg(metavar="N", help="Path: samples a pixel; 64 by default.")] = None
    denoise: Annotated[
        Literal["none", "auto", "oidn", "bilateral"] | None,
        arg(help="Path: take the noise off; none by default."),
        SECOND_PAGE,
    ] = None
    seed: Annotated[
        int | None, arg(metavar="N", help="Path: same seed, same device, same noise; 0 by default."), SECOND_PAGE
    ] = None


@dataclass(frozen=True)
class Render:
    """Light relightable assets and draw them: one image, numbered images, or a film.

    Without a camera, the asset is framed from the front. Sequences are resumed: frames that are whole and of the same
    render are kept, whatever stopped it. A film (.mp4) is made by ffmpeg; without one, numbered PNGs are written.

    With --capture, every test record of the capture is drawn into the folder --out as CAMERA_FRAME.exr: with --aov, in
    the layers and units of the capture's ground truth.

    See docs/sequences.md; `beam channel` draws one array of an asset without light.

    An image. Example: beam render person.usdz --environment studio.hdr --orbit 30 10 --out person.png

    A film. Example: beam render person.usdz --environment studio.hdr --frames 0:150 --mode path --out turntable.mp4

    Numbered images. Example: beam render person.usdz --environment studio.hdr --frames 0:150:10 --out frames/%04d.exr

    Slow motion. Example: beam render person.usdz --environment studio.hdr --speed 0.25 --fps 60 --out slow.mp4

    A turntable. Example: beam render person.usdz --environment studio.hdr --turns 1 --seconds 6 --out around.mp4

    Turning light. Example: beam render person.usdz --environment sky.hdr --rotate-per-second 60 --out light.mp4

    A camera path. Example: beam render person.usdz --environment studio.hdr --camera path.usda --out move.mp4

    Lamps and a floor. Example: beam render person.usdz --lights lamps.json --ground plain --view agx --out stage.png

    Several. Example: beam render a.usdz b.usdz --spacing 1 --environment studio.hdr --ground shadows --out both.png

    A stage. Example: beam render stage.json --mode path --target-error 0.004 --denoise auto --out stage.mp4

    In real time. Example: beam render person.usdz --environment studio.hdr --target-fps 30 --out person.mp4
    """

    assets: OmitArgPrefixes[AssetFlags]
    output: OmitArgPrefixes[OutputFlags]
    camera: OmitArgPrefixes[CameraFlags] = field(default_factory=CameraFlags)
    light: OmitArgPrefixes[LightFlags] = field(default_factory=LightFlags)
    time: OmitArgPrefixes[TimeFlags] = field(default_factory=TimeFlags)
    mode: Annotated[
        Literal["deferred", "path"] | None,
        arg(help="Deferred shading in real time (the default), or path tracing, which takes its time."),
    ] = None
    bounces: Annotated[
        int | None,
        arg(metavar="N", help="How often light goes from surface to surface; 4 by default, deferred 2."),
        SECOND_PAGE,
    ] = None
    deferred: OmitArgPrefixes[DeferredFlags] = field(default_factory=DeferredFlags)
    path: OmitArgPrefixes[PathFlags] = field(default_factory=PathFlags)
    targets: OmitArgPrefixes[TargetFlags] = field(default_factory=TargetFlags)
    device: Device = None
    quiet: Annotated[Quiet, SECOND_PAGE] = False
    json: Annotated[Json, SECOND_PAGE] = False

    @property
    def is_stage(self) -> bool:
        """Whether one stage is rendered, and not assets."""
        path = self.assets.asset[0]
        return len(self.assets.asset) == 1 and path.suffix.lower() == ".json" and path.name not in SOG_NAMES
