"""The folder of a reconstruction that may be stopped at any time and continued: finished frames and their previews.

Each finished frame is one file with its Gaussians and all that the next frame needs, under a key that covers
everything it depends on: a frame is taken from the store only under the same key.
"""

from __future__ import annotations

import hashlib
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
from beam_warp.image.files import write_png
from beam_warp.jobs.report import write_json
from beam_warp.jobs.store import frame_key, frame_names, make_folders, read_frame, write_frame
from beam_warp.outputs import remove_leftovers
from beam_warp.reconstruction.frames.model import FrameModel
from beam_warp.reconstruction.frames.protocols import FrameSteps
from beam_warp.world.gaussians import ATTRIBUTES, WORLD_AXES, GaussianCloud, GaussianSequence

ID_BITS = 32
"""Identities of a segment start at the number of its first frame times 2 to this power: no two segments share one."""

HEADER, TRACK = "header", "track_"


class FrameStore:
    """Finished frames of a reconstruction, in folders beside its asset.

    Attributes:
        digests: Digests of the capture's files, which are read again only if they changed.
        notes: What a killed call had left half written, and was removed.
    """

    def __init__(self, out: Path) -> None:
        """Make ``out``, and ``frames``, ``previews`` and ``digests`` in it.

        Raises:
            OutputError: A folder cannot be made.
        """
        self._folders = make_folders(out, "frames", "previews", "digests")
        self.digests = CaptureDigests(self._folders[2])
        self.notes = remove_leftovers(out, *self._folders)

    def path(self, frame: int) -> Path:
        """Return the file of a frame."""
        return self._folders[0] / f"frame_{frame:06d}.h5"

    def preview_path(self, frame: int) -> Path:
        """Return the file of a frame's preview."""
        return self._folders[1] / f"frame_{frame:06d}.png"

    def key(self, frame: int) -> str | None:
        """Return the key of a frame; None if it is not there."""
        return frame_key(self.path(frame))

    def write(self, frame: int, key: str, model: FrameModel) -> None:
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
        write_frame(self.path(frame), key, {**stored, HEADER: np.frombuffer(text.encode(), np.uint8)})

    def report(self, frame: int) -> dict[str, Any]:
        """Read the report of a frame; see `FrameModel`."""
        return json.loads(read_frame(self.path(frame), (HEADER,))[HEADER].tobytes())["report"]

    def track_arrays(self, frame: int) -> dict[str, NDArray[Any]]:
        """Read the arrays of a frame's track."""
        stored = read_frame(self.path(frame))
        shared = json.loads(stored[HEADER].tobytes())["shared"]
        own = {name.removeprefix(TRACK): array for name, array in stored.items() if name.startswith(TRACK)}
        return own | {name: stored[name] for name in shared}

    def has_preview(self, frame: int, key: str) -> bool:
        """Return whether the preview of the frame with this key is there."""
        return self._note(frame).get("key") == key and self.preview_path(frame).is_file()

    def write_preview(self, frame: int, key: str, picture: NDArray[np.uint8], seconds: float | None) -> None:
        """Store a preview, and then a note that vouches for it and holds the time the frame took, if it is known."""
        write_png(self.preview_path(frame), picture)
        write_json(self.path(frame).with_suffix(".json"), {"key": key, "seconds": seconds})

    def seconds(self, frame: int) -> float | None:
        """Read how long a frame took [s]; None if that is not known."""
        return self._note(frame).get("seconds")

    def _note(self, frame: int) -> dict[str, Any]:
        try:
            return dict(json.loads(self.path(frame).with_suffix(".json").read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return {}


def stored_sequence(
    paths: Sequence[Path], frames_per_second: float, stated: Mapping[str, str] = MappingProxyType({})
) -> GaussianSequence:
    """Return frames of the store as a sequence; they are read when they are asked for.

    Its topology is constant where every frame has the same identities, in the same rows.

    Args:
        paths: The frames' files, in order.
        frames_per_second: Playback rate [1/s].
        stated: Further metadata: how the Gaussians were drawn, which frames of the capture they show (see
            `beam_warp.world.metadata`).
    """
    ids = read_frame(paths[0], ("ids",))["ids"]
    constant = all(np.array_equal(read_frame(path, ("ids",))["ids"], ids) for path in paths[1:])
    return GaussianSequence(
        frame_count=len(paths),
        read_frame=lambda frame: stored_cloud(paths[frame]),
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


def stored_cloud(path: Path) -> GaussianCloud:
    """Read the Gaussians of a frame of the store."""
    names = tuple(name for name in frame_names(path) if name in ATTRIBUTES)
    return GaussianCloud(**read_frame(path, names), axes=WORLD_AXES, radiance_color_space=LINEAR_REC709)


def common_inputs(steps: FrameSteps, device: Any) -> str:
    """Return all that every frame of a job depends on, as JSON: the code, the kind of Warp device, the options."""
    content = {"code": code_digest(), "device": "cuda" if device.is_cuda else "cpu", "options": steps.options()}
    return json.dumps(content, sort_keys=True)


def key_of_frame(common: str, frame: int, digest: str, previous: str) -> str:
    """Return the key of a frame.

    Args:
        common: See `common_inputs`.
        frame: Number of the frame.
        digest: Digest of its records and images.
        previous: Key of the frame before in its segment; empty for the first of a segment.
    """
    text = f"{common}\n{frame}\n{digest}\n{previous}"
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
