"""Report of a job: the code, versions and device that made its result, and the JSON file that they are written to."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from beam_warp._version import __version__
from beam_warp.digests import code_digest
from beam_warp.kernels.common.launching import thread_count
from beam_warp.outputs import replacing

REPORT_NAME = "report.json"


def versions() -> dict[str, str]:
    """Return the versions that a result depends on; ``code`` is the digest of this package's source."""
    return {
        "beam-warp": __version__,
        "code": code_digest(),
        "warp": wp.__version__,
        "numpy": np.__version__,
        "usd-core": version("usd-core"),
        "python": platform.python_version(),
    }


def device_facts(device: Any) -> dict[str, Any]:
    """Return the name and kind of a Warp device, and the threads of a CPU, JSON-able."""
    return {
        "name": device.name,
        "kind": "cuda" if device.is_cuda else "cpu",
        "threads": None if device.is_cuda else thread_count(),
    }


def write_report(out: Path, report: Mapping[str, Any]) -> None:
    """Write ``out/report.json`` whole or not at all."""
    write_json(out / REPORT_NAME, report)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file whole or not at all.

    Raises:
        OutputError: The file cannot be written; nothing is left behind.
    """
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
