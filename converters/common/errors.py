"""The error of a file that breaks its format."""

from __future__ import annotations

from pathlib import Path

from beam_warp.errors import AssetFormatError


def malformed(path: Path, contract: str, got: str, remedy: str) -> AssetFormatError:
    """Make the error of a file that breaks its format."""
    return AssetFormatError(f"{path.name}: {contract}, got {got}. {remedy}")
