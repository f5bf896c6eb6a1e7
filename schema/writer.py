"""Writer of USD assets: decides on the files and puts them in place.

SPEC.md describes the files; `beam_warp.schema.authoring` makes the contents of each layer.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf

from beam_warp.checks import require_count, require_path
from beam_warp.errors import InvalidOptionError, OutputError
from beam_warp.outputs import replacing
from beam_warp.schema import register
from beam_warp.schema.authoring import (
    AssetContents,
    albedo_layer,
    author_albedo,
    author_clips,
    author_declarations,
    author_frames,
    author_stage,
    author_variants,
    define,
    static_layer,
)
from beam_warp.schema.clips import CLIP_FRAMES, MAX_FRAMES_IN_ONE_LAYER, clip_name
from beam_warp.schema.layout import ASSET_PATH, SPLATS_PATH
from beam_warp.schema.staging import publish_asset, staged_folder
from beam_warp.schema.survey import Survey, survey_sequence
from beam_warp.world.gaussians import GaussianSequence

SUFFIXES = (".usda", ".usdc", ".usdz")

USDZ_LIMIT = 2**32
"""Size that an archive must stay below [byte], since OpenUSD does not read ZIP64."""


def write_asset(
    sequence: GaussianSequence,
    path: str | Path,
    *,
    full_float: bool = False,
    lighting_variants: bool = False,
    segment_length: int = CLIP_FRAMES,
    bounds: Mapping[str, float] | None = None,
    clips: WrittenClips | None = None,
) -> list[Path]:
    """Write a relightable 4D Gaussian asset.

    Every frame is read twice, first to find what varies and which precision is safe; one segment is in memory at once.
    Arrays that are the same in every frame are written once. Arrays are written in half precision if that is safe
    (see `beam_warp.schema.layout`); positions are always in float. Files of an earlier asset with the same names are
    replaced, and its layers that this one lacks are removed.

    Args:
        sequence: Clouds with axes ``rub`` (stage y up) or ``rfu`` (stage z up), in metres. The metadata keys
            ``normal_source``, ``roughness_source``, ``radiance_meaning``, ``source_axes`` and ``source_units``, and
            those of `beam_warp.world.metadata`, set the attributes of these names; all keys but ``notes`` are kept in
            ``customData`` of ``/Asset``.
        path: ``x.usda``: a small text layer with binary layers beside it (value clips above 60 frames).
            ``x.usdc``: one binary file. ``x.usdz``: one package, below 4 GiB.
        full_float: Write every array in float.
        lighting_variants: Add the variant set ``lighting`` to ``/Asset``. Its variant ``captured``, the one that is
            selected, is the asset as it is without the set. In the variant ``albedo``, the radiance is the base colour,
            for renderers that light Gaussians and take their radiance for albedo. Not for ``.usdc``.
        segment_length: Frames in one value clip, and held in memory at once.
        bounds: How far arrays may be from their originals, by name (`beam_warp.schema.keys.departure`); an array that
            is not named must be the same. Arrays then have time samples at keys only, at most `segment_length` frames
            apart, and those that never leave their bound have none. The topology is then ``constant``: rows that are
            not the same Gaussian must not be blended. None writes a sample at every frame.
        clips: Clips of this sequence that `write_clip` has written; None to write all here.

    Returns:
        The files written, the one to open last.

    Raises:
        InvalidOptionError: Axes, file name or options break their contract, or the metadata that of
            `beam_warp.world.metadata`.
        InvalidArrayError: The frames do not hold the same arrays, or there is no base colour for an albedo.
        OutputError: The files cannot be written, or a package would reach 4 GiB. Nothing is left behind.
    """
    target = _require_target(path)
    if lighting_variants and target.suffix == ".usdc":
        raise InvalidOptionError(
            f"path must end in .usda or .usdz for lighting variants, got {target.name!r}. Choose another suffix."
        )
    require_count("segment_length", segment_length)
    register()
    if bounds is not None and len(sequence) > 1 and sequence.topology != "constant":
        raise InvalidOptionError(
            f"bounds of keys must go with a constant topology, got {sequence.topology}: its rows are not the same "
            "Gaussians in every frame. Write a sample at every frame."
        )
    bounds = bounds if len(sequence) > 1 else None
    survey = survey_sequence(sequence, bounds) if clips is None else clips.survey
    half = frozenset() if full_float else survey.half
    clipped = len(sequence) > MAX_FRAMES_IN_ONE_LAYER and bool(survey.varying) and target.suffix != ".usdc"
    contents = AssetContents(sequence, survey, half, segment_length if clipped else 0, bounds)
    if target.suffix == ".usdz":
        _require_below_limit(target, contents.byte_count)
    with staged_folder(target) as folder:
        root = f"{target.stem}.plain.usda" if lighting_variants else f"{target.stem}.usda"
        if clipped:
            names = _write_clips(contents, folder, target.stem, root, clips)
        elif target.suffix == ".usda" or lighting_variants:
            names = _write_text_and_data(contents, folder, target.stem, root, segment_length)
        else:
            names = _write_single(contents, folder, f"{target.stem}.usdc", segment_length)
        if lighting_variants:
            names += _write_variants(contents, folder, target.stem, root, segment_length)
        if target.suffix == ".usdz":
            names = [_pack(folder, names, target)]
        return publish_asset(folder, names, target.parent)


def _write_single(contents: AssetContents, folder: Path, name: str, save_every: int) -> list[str]:
    """Write one binary layer with everything, saved repeatedly so that USD keeps frames on disk and not in memory."""
    layer = static_layer(contents, folder / name)
    frames = contents.frames()
    for _ in range(0, len(contents.sequence) if contents.varying else 0, save_every):
        author_frames(layer, contents, islice(frames, save_every))
        _save(layer)
    _save(layer)
    return [name]


def _write_text_and_data(contents: AssetContents, folder: Path, stem: str, root: str, save_every: int) -> list[str]:
    """Write a text root layer and one binary layer with all frames."""
    data = f"{stem}.static.usdc" if not contents.varying else f"{stem}.frames.usdc"
    names = _write_single(contents, folder, data, save_every)
    return [*names, _write_root(contents, folder, stem, root, data, [])]


@dataclass(frozen=True)
class WrittenClips:
    """Clips of a long sequence that were written one by one, by `write_clip`.

    Attributes:
        survey: Properties of the sequence.
        folder: Where they are, under the names that they have in the asset.
    """

    survey: Survey
    folder: Path


def write_clip(
    sequence: GaussianSequence, survey: Survey, start: int, path: Path, turned: NDArray[np.bool_] | None = None
) -> None:
    """Write one clip of an asset that `write_asset` then completes, the same bytes that it would write.

    Args:
        sequence: As for `write_asset`.
        survey: Properties of the sequence.
        start: The clip's first frame, a multiple of `CLIP_FRAMES`.
        path: The file, named by `clip_name`.
        turned: With constant topology, quaternions whose sign is turned in the first frame; see `turned_signs`.

    Raises:
        OutputError: It cannot be written; nothing is left behind.
    """
    register()
    contents = AssetContents(sequence, survey, survey.half, CLIP_FRAMES)
    with replacing(path) as temporary:
        _write_clip(contents, contents.frames(start, start + CLIP_FRAMES, turned), temporary)


def _write_clip(contents: AssetContents, frames: Iterable[tuple[int, Mapping[str, NDArray[Any]]]], path: Path) -> None:
    layer = _clip_layer(contents, path)
    author_frames(layer, contents, frames)
    _save(layer)


def _write_clips(
    contents: AssetContents, folder: Path, stem: str, root: str, written: WrittenClips | None = None
) -> list[str]:
    """Write a text root layer, a binary layer of constant arrays, a manifest, and a binary layer for each segment."""
    _save(static_layer(contents, folder / f"{stem}.static.usdc"))
    _save(_clip_layer(contents, folder / f"{stem}.manifest.usda"))
    starts = range(0, len(contents.sequence), contents.segment_length)
    segments = [(start, clip_name(stem, start)) for start in starts]
    frames = contents.frames()
    for _, name in segments:
        if written is None:
            _write_clip(contents, islice(frames, contents.segment_length), folder / name)
        else:
            _link(written.folder / name, folder / name)
    data = [name for _, name in segments]
    _write_root(contents, folder, stem, root, f"{stem}.static.usdc", segments)
    return [f"{stem}.static.usdc", f"{stem}.manifest.usda", *data, root]


def _link(source: Path, target: Path) -> None:
    """Give a file a second name; where the file system has no such thing, copy it."""
    try:
        target.hardlink_to(source)
    except OSError:
        shutil.copy2(source, target)


def _write_variants(contents: AssetContents, folder: Path, stem: str, plain: str, save_every: int) -> list[str]:
    """Write a binary layer of the albedo, and a text root layer that puts it over the plain asset in a variant."""
    names = [f"{stem}.albedo.usdc", f"{stem}.usda"]
    layer = albedo_layer(contents, folder / names[0])
    frames = range(len(contents.sequence) if "base_color" in contents.varying else 0)
    for start in frames[::save_every]:
        author_albedo(layer, contents, frames[start : start + save_every])
        _save(layer)
    _save(layer)
    root = Sdf.Layer.CreateNew(str(folder / names[1]))
    author_stage(root, contents)
    author_variants(root, f"./{plain}", f"./{names[0]}")
    _save(root)
    return names


def _clip_layer(contents: AssetContents, path: Path) -> Sdf.Layer:
    """Create a layer that declares exactly the varying attributes; USD reads all others from the static layer."""
    layer = Sdf.Layer.CreateNew(str(path))
    author_stage(layer, contents)
    author_declarations(Sdf.CreatePrimInLayer(layer, SPLATS_PATH), contents, tuple(sorted(contents.varying)))
    return layer


def _write_root(
    contents: AssetContents, folder: Path, stem: str, name: str, data: str, segments: list[tuple[int, str]]
) -> str:
    """Write the text layer to open: stage metadata, a reference to the data, and clips if there are any."""
    layer = Sdf.Layer.CreateNew(str(folder / name))
    author_stage(layer, contents)
    prim = define(layer, ASSET_PATH, "Xform")
    prim.referenceList.prependedItems = [Sdf.Reference(f"./{data}", ASSET_PATH)]
    if segments:
        relative = [(start, f"./{segment}") for start, segment in segments]
        splats = Sdf.CreatePrimInLayer(layer, SPLATS_PATH)
        author_clips(splats, f"./{stem}.manifest.usda", relative, len(contents.sequence) - 1)
    _save(layer)
    return name


def _save(layer: Sdf.Layer) -> None:
    if not layer.Save():
        raise OutputError(
            f"{Path(layer.realPath).name} must be writable, got a failed save. Free space or choose another place; "
            "nothing was left behind."
        )


def _pack(folder: Path, names: list[str], target: Path) -> str:
    """Pack staged layers into a package with the layer to open first, as USDZ requires."""
    _require_below_limit(target, sum((folder / name).stat().st_size for name in names))
    archive = Sdf.ZipFileWriter.CreateNew(str(folder / target.name))
    for name in reversed(names):
        archive.AddFile(str(folder / name), name)
    if not archive.Save():
        raise OutputError(f"{target} must be writable, got a failed save. Free space or choose another place.")
    return target.name


def _require_below_limit(target: Path, size: int) -> None:
    if size >= USDZ_LIMIT:
        raise OutputError(
            f"{target} must stay below 4 GiB, got {size / 2**30:.1f} GiB of data. "
            f"Write {target.stem}.usda, or fewer frames."
        )


def _require_target(path: str | Path) -> Path:
    """Refuse names that USD's asset paths cannot express."""
    target = require_path("path", path)
    if target.suffix not in SUFFIXES:
        raise InvalidOptionError(
            f"path must end in {', '.join(SUFFIXES)}, got {target.name!r}. Choose .usda for long sequences."
        )
    if re.search(r"[\[\]@:*?\"<>|\\\x00-\x1f]", target.name):
        raise InvalidOptionError(
            f'path must name a file without []@:*?"<>|\\ or control characters, got {target.name!r}. Rename it.'
        )
    return target
