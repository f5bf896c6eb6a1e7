"""The folder of a reconstruction: finished frames and their previews.

Each finished frame is one file with its Gaussians and all that the next frame needs. The receipts of the job's plan say
what it was made from.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp._version import __version__
from beam_warp.capture.digests import CaptureDigests
from beam_warp.digests import code_digest
from beam_warp.image.color import LINEAR_REC709
from beam_warp.jobs.store import frame_names, make_folders, read_frame, write_frame
from beam_warp.outputs import remove_leftovers
from beam_warp.reconstruction.frames.model import FrameModel
from beam_warp.reconstruction.frames.protocols import FrameSteps
from beam_warp.world.gaussians import ATTRIBUTES, WORLD_AXES, GaussianCloud, GaussianSequence

ID_BITS = 32
"""Identities of a segment start at the number of its first frame times 2 to this power: no two segments share one."""

HEADER, TRACK = "header", "track_"

FOLDERS = ("frames", "previews", "digests")


class FrameStore:
    """Finished frames of a reconstruction, in folders beside its asset.

    Attributes:
        digests: Digests of the capture's files, which are read again only if they changed.
    """

    def __init__(self, out: Path, stem: str = "frame") -> None:
        """Take the folder ``out``, and ``frames``, ``previews`` and ``digests`` in it; files begin with ``stem``."""
        self._out, self._stem = out, stem
        self._folders = [out / name for name in FOLDERS]
        self.digests = CaptureDigests(self._folders[2])

    def make_folders(self) -> list[str]:
        """Make the folders, and remove what a killed call had left half written; say so in notes.

        Raises:
            OutputError: A folder cannot be made.
        """
        return remove_leftovers(self._out, *make_folders(self._out, *FOLDERS))

    def path(self, frame: int) -> Path:
        """Return the file of a frame."""
        return self._folders[0] / f"{self._stem}_{frame:06d}.h5"

    def preview_path(self, frame: int) -> Path:
        """Return the file of a frame's preview."""
        return self._folders[1] / f"frame_{frame:06d}.png"

    def write(self, frame: int, model: FrameModel) -> None:
        """Store a frame, whole: its Gaussians, its track without what both share, and a header.

        Raises:
            OutputError: The file cannot be written.
        """
        cloud, report = model.track.cloud, model.report
        own = np.arange(len(cloud)) if cloud.ids is None else cloud.ids
        stored: dict[str, NDArray[Any]] = {**cloud.arrays(), "ids": own + (np.int64(report["segment"]) << ID_BITS)}
        shared = []
        for name, array in model.track.arrays().items():
            if name in stored and array.dtype == stored[name].dtype and np.array_equal(array, stored[name]):
                shared.append(name)
            else:
                stored[TRACK + name] = array
        text = json.dumps({"report": report, "shared": sorted(shared)}, sort_keys=True, allow_nan=False)
        write_frame(self.path(frame), {**stored, HEADER: np.frombuffer(text.encode(), np.uint8)})

    def report(self, frame: int) -> dict[str, Any]:
        """Read the report of a frame; see `FrameModel`."""
        return _header(self.path(frame))["report"]

    def track_arrays(self, frame: int) -> dict[str, NDArray[Any]]:
        """Read the arrays of a frame's track."""
        stored = read_frame(self.path(frame))
        shared = json.loads(stored[HEADER].tobytes())["shared"]
        own = {name.removeprefix(TRACK): array for name, array in stored.items() if name.startswith(TRACK)}
        return own | {name: stored[name] for name in shared}


def stored_sequence(
    paths: Sequence[Path],
    frames_per_second: float,
    stated: Mapping[str, str] = MappingProxyType({}),
    is_constant: bool | None = None,
    fading: Mapping[int, tuple[Path, float]] = MappingProxyType({}),
) -> GaussianSequence:
    """Return frames of the store as a sequence; they are read when they are asked for.

    Its topology is constant where every frame has the same identities, in the same rows.

    Args:
        paths: The frames' files, in order.
        frames_per_second: Playback rate [1/s].
        stated: Further metadata: how the Gaussians were drawn, which frames of the capture they show (see
            `beam_warp.world.metadata`).
        is_constant: Whether the topology is constant, where that is known without reading all frames.
        fading: What is laid over some frames, by their place; see `stored_cloud`.
    """
    constant = _has_same_rows(paths) if is_constant is None else is_constant
    return GaussianSequence(
        frame_count=len(paths),
        read_frame=lambda frame: stored_cloud(paths[frame], fading.get(frame)),
        frames_per_second=frames_per_second,
        constant=frozenset({"ids"}) if constant else frozenset(),
        topology="constant" if constant else "perFrame",
        metadata={
            "generator": f"beam-warp {__version__}",
            "radiance_meaning": "captured",
            "source_axes": WORLD_AXES,
            **stated,
        },
    )


def _has_same_rows(paths: Sequence[Path]) -> bool:
    ids = read_frame(paths[0], ("ids",))["ids"]
    return all(np.array_equal(read_frame(path, ("ids",))["ids"], ids) for path in paths[1:])


def stored_cloud(path: Path, fading: tuple[Path, float] | None = None) -> GaussianCloud:
    """Read the Gaussians of a frame of the store.

    Opacities of two overlaid models of a surface add up to those of one: each is multiplied by its share.

    Args:
        path: File of the frame.
        fading: File of the same frame as the segment before goes on to show it, and its share in (0, 1); its Gaussians
            are the last rows. It is left out where tracking was lost.
    """
    names = tuple(name for name in frame_names(path) if name in ATTRIBUTES)
    arrays: dict[str, NDArray[Any]] = read_frame(path, names)
    if fading is not None and not _header(fading[0])["report"]["lost"]:
        before, share = read_frame(fading[0], names), np.float32(fading[1])
        before["opacities"] = before["opacities"] * share
        arrays["opacities"] = arrays["opacities"] * (1 - share)
        arrays = {name: np.concatenate([arrays[name], before[name]]) for name in names}
    return GaussianCloud(**arrays, axes=WORLD_AXES, radiance_color_space=LINEAR_REC709)


def _header(path: Path) -> dict[str, Any]:
    return json.loads(read_frame(path, (HEADER,))[HEADER].tobytes())


def common_inputs(steps: FrameSteps, device_kind: str) -> str:
    """Return all that every frame of a job depends on, as JSON: the code, the kind of device, the options."""
    content = {"code": code_digest(), "device": device_kind, "options": steps.options()}
    return json.dumps(content, sort_keys=True)
