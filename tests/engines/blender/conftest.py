"""The zip of the Blender add-on."""

import importlib
import sys
import zipfile
from pathlib import Path

import pytest

ENGINE = Path(__file__).parents[3] / "engines" / "blender"


@pytest.fixture(scope="session")
def addon(tmp_path_factory):
    """The folder that the zip unpacks to; the part of it that needs no Blender can be imported."""
    folder = tmp_path_factory.mktemp("extensions")
    sys.path.insert(0, str(ENGINE))
    try:
        importlib.import_module("zip_addon").build(folder / "addon.zip")
    finally:
        sys.path.remove(str(ENGINE))
    zipfile.ZipFile(folder / "addon.zip").extractall(folder / "beam_relightable")
    return folder / "beam_relightable"
