"""Keys of stored frames: a frame is taken from the store only if its key covers the same inputs."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any, Self

from beam_warp._version import __version__
from beam_warp.reconstruction.protocols import FrameSteps


@dataclass(frozen=True)
class FrameKeys:
    """Makes the keys of one job's frames.

    Attributes:
        common: All that every frame depends on, as JSON: the version, the kind of device, and the options.
    """

    common: str

    @classmethod
    def of(cls, steps: FrameSteps, device: Any) -> Self:
        """Return the maker of keys for frames that some steps find on a Warp device."""
        return cls(
            json.dumps(
                {
                    "version": __version__,
                    "device": "cuda" if device.is_cuda else "cpu",
                    "options": steps.options(),
                },
                sort_keys=True,
            )
        )

    def key(self, frame: int, digest: str, previous: str) -> str:
        """Return the key of a frame.

        Args:
            frame: Its number.
            digest: The digest of its records and images.
            previous: The key of the frame before in its segment; empty for the first of a segment.
        """
        text = f"{self.common}\n{frame}\n{digest}\n{previous}"
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
