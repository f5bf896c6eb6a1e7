"""Compiling the Unity package's C# with mono, and running its parser."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "engines" / "unity" / "com.beam.relightable"
HERE = Path(__file__).parent
PARSER = sorted((PACKAGE / "Runtime" / "Delivery").glob("*.cs"))
MCS, MONO = shutil.which("mcs"), shutil.which("mono")

needs_compiler = pytest.mark.skipif(MCS is None, reason="there is no mcs (Debian package mono-mcs)")
needs_mono = pytest.mark.skipif(MCS is None or MONO is None, reason="there is no mono (Debian package mono-mcs)")


def compiled(sources, out, *options):
    """Compile C# 7 files, warnings as errors; return what the compiler says, an empty text if all is well."""
    command = [MCS, "-langversion:7", "-warnaserror", *options, f"-out:{out}", *map(str, sources)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    return "" if run.returncode == 0 else run.stdout + run.stderr


def run(program, *arguments):
    return subprocess.run([MONO, str(program), *map(str, arguments)], capture_output=True, text=True, check=False)
