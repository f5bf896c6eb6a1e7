"""``beam mesh``: the surface of every frame of a Gaussian sequence, and texture coordinates for one of them."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.checks import require_count
from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import Device, Json, Quiet, ReadingFlags, notes_of
from beam_warp.digests import array_digest, code_digest
from beam_warp.errors import InvalidOptionError
from beam_warp.image.files import replacing, write_png
from beam_warp.jobs.store import make_folders
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud
from beam_warp.world.metadata import numbers_of_frames

if TYPE_CHECKING:
    import trimesh

    from beam_warp.mesh.depths import DepthImages
    from beam_warp.raster.records import RasterOptions

UNWRAP_FACES = 50_000
"""Triangles of the mesh that is unwrapped, about; cutting charts takes half a minute for so many."""

PREVIEW_SIDE = 512


@dataclass(frozen=True)
class Mesh:
    """Fuse the depth of a Gaussian sequence into one mesh a frame, watertight where it is seen.

    Depth is drawn from the training cameras of a capture, or without one from 32 cameras around the cloud; pixels that
    no second camera confirms are left out. Writes OUT/mesh000000.ply, one a frame, and OUT/mesh000000.json with its
    counts of boundary edges and holes. Frames whose files are there, made of the same Gaussians and options, are kept.

    PLY and OBJ are in the world's axes, z up; GLB is y up, as glTF demands. Units are metres.

    Example: beam mesh person.usda --capture walker --out meshes --unwrap
    """

    sequence: Annotated[
        Positional[Path], arg(metavar="SEQUENCE", help="File of Gaussians, or a folder of numbered files.")
    ]
    out: Annotated[Path, arg(metavar="DIR", help="Folder for the meshes; made if it does not exist.")]
    capture: Annotated[
        Path | None, arg(metavar="DIR", help="Use the cameras of this capture, of the same frame and split.")
    ] = None
    split: Annotated[str, arg(help="Which records of the capture.")] = "train"
    size: Annotated[int, arg(metavar="PX", help="Side of the depth images without --capture.")] = 512
    format: Annotated[Literal["ply", "obj", "glb"], arg(help="Format of the meshes.")] = "ply"
    voxel: Annotated[
        float | None, arg(metavar="M", help="Edge of a voxel in metres; the width of a pixel by default.")
    ] = None
    frames: Annotated[tuple[int, ...], arg(metavar="N", help="Only these frames, counted from 0; all by default.")] = ()
    depth: Annotated[Literal["median", "mean"], arg(help="Which depth of a pixel's Gaussians is fused.")] = "median"
    color: Annotated[
        Literal["none", "base_color", "radiance"] | None,
        arg(help="Colour of the vertices; base colour by default, else radiance, if the Gaussians have it."),
    ] = None
    confirmations: Annotated[
        int, arg(metavar="N", help="Leave out pixels that fewer other cameras confirm, or more contradict.")
    ] = 1
    unwrap: Annotated[
        bool, arg(help="Also write canonical.glb and .obj: the first of the frames with texture coordinates.")
    ] = False
    preview: Annotated[bool, arg(help="Also draw every mesh, as .png.")] = False
    reading: OmitArgPrefixes[ReadingFlags] = field(default_factory=ReadingFlags)
    device: Device = None
    quiet: Quiet = False
    json: Json = False


def mesh(args: Mesh) -> int:
    """Mesh the frames that are not there yet, and say what was found."""
    started = time.perf_counter()
    if args.unwrap:
        from beam_warp.mesh.unwrap import require_unwrapping

        require_unwrapping()
    capture = None if args.capture is None else Capture.read(args.capture)
    sequence = args.reading.read(args.sequence)
    frames = _frames(args, len(sequence))
    options = args.reading.raster(sequence)
    notes = notes_of(sequence)
    numbers = numbers_of_frames(sequence.metadata, len(sequence))
    cameras_of = {} if capture is None else {n: _capture_cameras(args, capture, numbers[n]) for n in frames}
    make_folders(args.out)
    reports = []
    with progress(args.quiet or args.json) as report:
        for done, frame in enumerate(frames, start=1):
            cloud = change_axes(sequence[frame], WORLD_AXES)
            canonical = args.unwrap and done == 1
            reports.append(_mesh_frame(args, options, frame, cloud, cameras_of.get(frame), canonical))
            report("mesh", done, len(frames))
    seconds = time.perf_counter() - started
    if args.json:
        print_json({"frames": reports, "notes": notes, "seconds": round(seconds, 3)})
    elif not args.quiet:
        print_notes(notes)
        for entry in reports:
            print(_line(entry))
        print(f"{len(reports)} meshes in {args.out}, {seconds:.1f} s")
    return 0


def _frames(args: Mesh, frame_count: int) -> list[int]:
    """Return the frames that were asked for."""
    for frame in args.frames:
        require_count("frames", frame, 0, frame_count - 1)
    return sorted(set(args.frames)) or list(range(frame_count))


def _capture_cameras(args: Mesh, capture: Capture, frame: int) -> tuple[Camera, ...]:
    """Return the cameras of a frame of the capture."""
    records = capture.select(split=args.split, frames=(frame,))
    if not records:
        raise InvalidOptionError(
            f"split must name records of frame {frame} of the capture, got {args.split!r} (it has splits "
            f"{', '.join(capture.splits)} and frames {capture.frames[0]} to {capture.frames[-1]}). "
            "Choose another split, or --frames."
        )
    return tuple(record.camera for record in records)


def _mesh_frame(
    args: Mesh,
    options: RasterOptions,
    frame: int,
    cloud: GaussianCloud,
    cameras: Sequence[Camera] | None,
    canonical: bool,
) -> dict[str, Any]:
    """Write the files of a frame unless they are there, and return its report."""
    from beam_warp.mesh.extract import surrounding_cameras

    seen_from = surrounding_cameras(cloud, side=args.size) if cameras is None else cameras
    path = converters.numbered_path(args.out / f"mesh.{args.format}", frame)
    wanted = [path, *([path.with_suffix(".png")] if args.preview else [])]
    wanted += [args.out / "canonical.glb", args.out / "canonical.obj"] if canonical else []
    key = _key(args, options, cloud, seen_from, canonical)
    known = _read_report(path.with_suffix(".json"))
    if known.get("key") == key and all(file.is_file() for file in wanted):
        return {**known, "kept": True}
    started = time.perf_counter()
    report = {"frame": frame, "output": path.name, "key": key, "cameras": len(seen_from)}
    report |= _write_meshes(args, options, cloud, seen_from, path, canonical)
    report["seconds"] = round(time.perf_counter() - started, 3)
    # Last of all: with it the frame is done.
    with replacing(path.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(report, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    return {**report, "kept": False}


def _write_meshes(
    args: Mesh, options: RasterOptions, cloud: GaussianCloud, cameras: Sequence[Camera], path: Path, canonical: bool
) -> dict[str, Any]:
    """Fuse a frame, write what was asked for, and return what was found."""
    from beam_warp.mesh.consistency import depth_consistency
    from beam_warp.mesh.extract import draw_depths
    from beam_warp.mesh.files import write_mesh
    from beam_warp.mesh.fusion import fuse_depths
    from beam_warp.mesh.preview import shaded_image
    from beam_warp.mesh.topology import mesh_report

    color = args.color
    if color is None:
        color = "base_color" if cloud.base_color is not None else "radiance" if cloud.radiance is not None else "none"
    images = draw_depths(cloud, cameras, depth=args.depth, color=color, options=options, device=args.device)
    consistency = depth_consistency(images)
    if len(cameras) > 1:
        images.keep(consistency.mask(args.confirmations))
    surface = fuse_depths(images, voxel=args.voxel)
    write_mesh(surface, path)
    if args.preview:
        camera = Camera.frame_points(surface.vertices, azimuth=25.0, width=PREVIEW_SIDE, height=PREVIEW_SIDE)
        write_png(path.with_suffix(".png"), shaded_image(surface, camera, args.device))
    found = mesh_report(surface).as_dict()
    report = {"voxel": surface.metadata["voxel"], "mesh": found, "consistency": consistency.as_dict()}
    if canonical:
        report["canonical"] = _write_canonical(args, images, surface)
    return report


def _write_canonical(args: Mesh, images: DepthImages, surface: trimesh.Trimesh) -> dict[str, Any]:
    """Unwrap a frame, fused again with a larger voxel if it has too many triangles: that stays manifold."""
    from beam_warp.mesh.files import write_mesh
    from beam_warp.mesh.fusion import fuse_depths
    from beam_warp.mesh.unwrap import unwrapped

    while len(surface.faces) > UNWRAP_FACES:
        # Triangles are as many as squares of a voxel fit on the surface, and a few less where details vanish.
        voxel = surface.metadata["voxel"] * 1.01 * float(np.sqrt(len(surface.faces) / UNWRAP_FACES))
        surface = fuse_depths(images, voxel=voxel)
    flat = unwrapped(surface)
    for suffix in ("glb", "obj"):
        write_mesh(flat, args.out / f"canonical.{suffix}")
    return {"faces": len(flat.faces), "vertices": len(flat.vertices), "voxel": surface.metadata["voxel"]}


def _key(args: Mesh, options: RasterOptions, cloud: GaussianCloud, cameras: Sequence[Camera], canonical: bool) -> str:
    """Return what a frame's files are made of, as a digest."""
    asked = (args.format, args.voxel, args.depth, args.color, args.confirmations, options, canonical)
    lenses = [(c.width, c.height, c.focal_x, c.focal_y, c.center_x, c.center_y) for c in cameras]
    arrays, poses = cloud.arrays(), [camera.camera_to_world for camera in cameras]
    return array_digest(*arrays.values(), *poses, text=repr((code_digest(), asked, lenses, list(arrays))))


def _read_report(path: Path) -> dict[str, Any]:
    """Return a frame's report; empty if there is none that can be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _line(report: dict[str, Any]) -> str:
    """Return one line about a frame."""
    found = report["mesh"]
    edge = "closed" if found["closed"] else f"{found['holes']} holes, {found['boundary_edges']} boundary edges"
    agreed = report["consistency"]["confirmed"]
    made = "kept" if report["kept"] else f"{report['seconds']:.1f} s"
    return (
        f"{report['output']}: {found['faces']:,} triangles of voxels of {1e3 * report['voxel']:.2f} mm, {edge}, "
        f"{100.0 * agreed:.1f} % of the depth confirmed by a second camera, {made}"
    )
