"""The error of a file that breaks its format, in the words of the house."""

from __future__ import annotations

from pathlib import Path

from beam_warp.errors import AssetFormatError


def malformed(path: Path, contract: str, got: str, remedy: str) -> AssetFormatError:
    """Make the error of a file that breaks its format.

    Args:
        path: The file; its name is said.
        contract: What must hold, such as "the header must have 32 bytes".
        got: What was found instead.
        remedy: What to do, as a sentence.
    """
    return AssetFormatError(f"{path.name}: {contract}, got {got}. {remedy}")
