"""Keys of stored frames: a frame is taken from the store only if its key covers the same inputs."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from beam_warp.digests import code_digest
from beam_warp.reconstruction.frames.protocols import FrameSteps


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
