"""Multi-view captures on disk, read lazily in any of three layouts: cameras, frames and images.

Distorted photographs are undistorted as they are read, so that every camera is a pinhole.
"""

from __future__ import annotations

import os

from beam_warp.capture import colmap, nerfstudio, projections
from beam_warp.capture.records import CaptureContents
from beam_warp.capture.records import CaptureRecord as CaptureRecord
from beam_warp.capture.records import SparsePoints as SparsePoints
from beam_warp.checks import require_number, require_path
from beam_warp.errors import MissingFileError


class Capture(CaptureContents):
    """Images of a scene from many places and times; `CaptureContents` lists what it holds."""

    @classmethod
    def read(cls, folder: str | os.PathLike[str], *, keep: float = 0.0) -> Capture:
        """Read a capture; images stay on disk until they are asked for.

        Three layouts are told apart by their files, in this order: nerfstudio's ``transforms.json``; a COLMAP model,
        ``cameras`` and ``images`` as ``.bin`` or ``.txt`` in the folder, in ``sparse`` or in ``sparse/0``; and 3 x 4
        matrices, ``<image>_P.txt`` (see `beam_warp.capture.projections`). Where a file states no frames or cameras,
        every record is of frame 0 at time 0, and its camera is named after its image. Nerfstudio's split is ``train``
        unless ``test_filenames`` or ``val_filenames`` lists the image.

        Args:
            folder: The folder of the capture, or its ``transforms.json``.
            keep: How much of a distorted photograph to keep: 0 for the part that fills an undistorted image, 1 for
                all of it with void at the borders (see `CaptureRecord.mask`), or a value between.

        Raises:
            MissingFileError: The folder has none of these layouts, or a file that it names does not exist.
            AssetFormatError: A file is damaged, a field is missing or out of range, a pose is not rigid, or a lens
                cannot be inverted over its photograph; the message names the record.
            InvalidOptionError: ``keep`` is out of range.
        """
        require_number("keep", keep, 0.0, 1.0)
        path = require_path("folder", folder)
        transforms = path / nerfstudio.FILE_NAME if path.is_dir() else path
        if transforms.is_file():
            return cls(**vars(nerfstudio.read(transforms, keep)))
        if (model := colmap.find(path)) is not None:
            return cls(**vars(colmap.read(path, *model, keep)))
        if matrices := projections.find(path):
            return cls(**vars(projections.read(path, matrices)))
        raise MissingFileError(
            f"capture must be a folder with {nerfstudio.FILE_NAME}, a COLMAP model (cameras and images, .bin "
            f"or .txt) or matrices (*{projections.SUFFIX}), got {path}"
            f"{'' if path.exists() else ' (no such folder)'}. Check the path."
        )
