"""``beam render``: its options; what is to be done is in `beam_warp.cli.render_relit` and `render_channel`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from beam_warp.cli.drawing import Antialiased, LowPass
from beam_warp.cli.render_checks import require_consistent


@dataclass(frozen=True)
class Render:
    """Light relightable assets and draw them: one image, numbered images, or a film; or draw one channel of an asset.

    Without a camera, the asset is framed from the front. Sequences are resumed: frames that are whole and of the same
    render are kept, whatever stopped it. A film (.mp4) is made by ffmpeg; without one, numbered PNGs are written.

    With --capture, every test record of the capture is drawn into the folder --out as CAMERA_FRAME.exr: with --aov, in
    the layers and units of the capture's ground truth.

    With --channel, one array is drawn and no light: a .png shows colours as they are, numbers and standard errors by a
    colour map whose range is printed, observability as the gravest flag of what each pixel sees, counted in the legend;
    an .exr holds the values. With --capture these are .png.

    See docs/sequences.md.

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

    One channel. Example: beam render person.usdz --channel base_color_error --out error.png
    """

    asset: Annotated[
        Positional[tuple[Path, ...]],
        arg(metavar="ASSET ...", help="PLY or USD files, folders of numbered PLY files; or one stage as .json."),
    ]
    out: Annotated[
        Path,
        arg(metavar="FILE", help=".png, .exr or .mp4; frames/%04d.png for numbers; a folder with --capture."),
    ]
    mode: Annotated[
        Literal["deferred", "path"], arg(help="Deferred shading in real time, or path tracing, which takes its time.")
    ] = "deferred"
    environment: Annotated[
        Path | None, arg(metavar="FILE", help="Lat-long light, .exr or .hdr; by default the capture's or stage's own.")
    ] = None
    rotate: Annotated[float, arg(metavar="DEG", help="Turn it about z, counter-clockwise from above.")] = 0.0
    rotate_per_second: Annotated[float, arg(metavar="DEG", help="Go on turning it as the film plays.")] = 0.0
    lights: Annotated[Path | None, arg(metavar="FILE", help="Lights as .json: directional, point, spot.")] = None
    ground: Annotated[
        Literal["plain", "shadows"] | None, arg(help="A floor under the assets, or only the shadows on it.")
    ] = None
    exposure: Annotated[float, arg(metavar="STOPS", help="Brighten what is rendered by powers of two.")] = 0.0
    view: Annotated[
        Literal["standard", "aces", "agx", "neutral"],
        arg(help="How .png and .mp4 show light above white: cut off, or bent by one of these curves."),
    ] = "standard"
    background: Annotated[
        tuple[float, float, float] | Literal["transparent", "environment"],
        arg(metavar="R G B", help="Display colour behind it, 0 to 1; or the environment; transparent by default."),
    ] = "transparent"
    orbit: Annotated[
        tuple[float, float] | None,
        arg(metavar="AZIMUTH ELEVATION", help="Frame the asset from here, in degrees; 0 0 looks along +y."),
    ] = None
    look_at: Annotated[
        tuple[float, float, float, float, float, float] | None,
        arg(metavar="EX EY EZ TX TY TZ", help="Camera position and what it looks at, in metres, z up."),
    ] = None
    camera: Annotated[Path | None, arg(metavar="FILE", help="Camera path, .json or a USD stage's camera.")] = None
    turntable: Annotated[
        float | None, arg(metavar="DEG", help="Go around the asset, so many degrees a second, from --orbit on.")
    ] = None
    turns: Annotated[float | None, arg(metavar="N", help="Go around it N times while it plays.")] = None
    capture: Annotated[Path | None, arg(metavar="DIR", help="Draw from the cameras of this capture.")] = None
    split: Annotated[str, arg(help="Which records of the capture.")] = "test"
    frame: Annotated[int | None, arg(metavar="N", help="Only this frame, counted from 0; all by default.")] = None
    frames: Annotated[
        str | None,
        arg(metavar="A:B[:STEP]", help="Only these frames; B is not one of them; --frames=-10: for the last ten."),
    ] = None
    seconds: Annotated[float | None, arg(metavar="S", help="How long it plays; all of the asset by default.")] = None
    fps: Annotated[
        float | None, arg(metavar="RATE", help="Images a second, blended between frames; the asset's by default.")
    ] = None
    speed: Annotated[float | None, arg(metavar="X", help="0.5 plays at half speed, more images for less time.")] = None
    loop: Annotated[bool, arg(help="Play assets again after their last frame; else that is held.")] = False
    spacing: Annotated[float | None, arg(metavar="M", help="Put the assets in a row along x, so far apart.")] = None
    on_ground: Annotated[bool, arg(help="Put the lowest point of every asset at height 0.")] = False
    width: Annotated[int | None, arg(metavar="PX", help="Image width; 1024 by default.")] = None
    height: Annotated[int | None, arg(metavar="PX", help="Image height; the width by default.")] = None
    fov: Annotated[float | None, arg(metavar="DEG", help="Vertical field of view; 35 by default.")] = None
    spp: Annotated[
        int | None,
        arg(metavar="N", help="Path: samples a pixel, at most if there is an error to reach; 64 by default."),
    ] = None
    bounces: Annotated[
        int | None, arg(metavar="N", help="How often light goes from surface to surface; 4 by default, deferred 2.")
    ] = None
    target_error: Annotated[
        float | None,
        arg(metavar="E", help="Path: stop where noise is below this display value; 0.004 is 8 bits' step."),
    ] = None
    denoise: Annotated[
        Literal["none", "auto", "oidn", "bilateral"] | None, arg(help="Path: take the noise off; none by default.")
    ] = None
    seed: Annotated[int | None, arg(metavar="N", help="Path: same seed, same device, same noise; 0 by default.")] = None
    environment_shadows: Annotated[
        int | None, arg(metavar="N", help="Deferred: directions from which the environment casts shadows; 0 for none.")
    ] = None
    shadow_resolution: Annotated[int | None, arg(metavar="PX", help="Deferred: side of a lamp's shadow map.")] = None
    antialiased: Antialiased = None
    low_pass: LowPass = None
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
    aov: Annotated[
        bool,
        arg(help="Also write base colour, roughness, occlusion, what errors there are of them, normal, depth (.exr)."),
    ] = False
    crf: Annotated[int | None, arg(metavar="N", help="Quality of a film, 0 (lossless) to 51; 18 by default.")] = None
    overwrite: Annotated[bool, arg(help="Replace a film, or numbered images of another render.")] = False
    source_axes: Annotated[str | None, arg(metavar="CODE", help="Axes of a PLY that does not state them.")] = None
    drop_invalid: Annotated[bool, arg(help="Leave out rows with NaN or zero quaternions, and say how many.")] = False
    device: Annotated[str | None, arg(help="cpu, cuda:0, …; the first GPU by default, if there is one.")] = None
    quiet: Annotated[bool, arg(help="Print nothing but errors.")] = False
    json: Annotated[bool, arg(help="Print the result as JSON.")] = False


def render(args: Render) -> int:
    """Draw what was asked for, and say what was written."""
    require_consistent(args)
    if args.channel is not None:
        from beam_warp.cli.render_channel import render_channel

        return render_channel(args)
    from beam_warp.cli.render_relit import render_relit

    return render_relit(args)
