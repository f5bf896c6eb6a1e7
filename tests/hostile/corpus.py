"""The corpus of malformed files: for every reader a sound file, and named ways to spoil it.

A new reader is a row of `READERS`.
"""

import json
import struct
from functools import partial
from pathlib import Path

import numpy as np
import write_lcc
from hostile.archives import ARCHIVES
from hostile.splats import SPLATS, read_frames
from hostile.ways import Reader
from PIL import Image as PillowImage
from support.drawn_ball import relightable

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.files import read_image, write_exr
from beam_warp.jobs.store import read_frame, write_frame
from beam_warp.schema.reader import read_asset
from beam_warp.stage.stage import Stage
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import read_lights


def _cloud() -> GaussianSequence:
    return GaussianSequence.from_clouds([relightable(np.arange(9.0).reshape(3, 3), scales=np.full((3, 3), 0.1))])


def ply(folder: Path) -> Path:
    """A binary PLY with materials."""
    (path,) = converters.write(_cloud(), folder / "a.ply", converters.WriteOptions(profile="beam"))
    return path


COLUMNS = (*("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"), *(f"scale_{i}" for i in range(3)))
COLUMNS += tuple(f"rot_{i}" for i in range(4))


def text_ply(folder: Path) -> Path:
    """A PLY of text."""
    header = "".join(f"property float {name}\n" for name in COLUMNS)
    rows = "".join(" ".join(f"{-3.0 - 0.25 * (i + j)}" for i in range(len(COLUMNS))) + "\n" for j in range(3))
    path = folder / "a.ply"
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 3\n{header}end_header\n{rows}")
    return path


def compressed_ply(folder: Path) -> Path:
    """PlayCanvas' compressed PLY, of two Gaussians."""
    bounds = [f"{end}{group}{axis}" for group in ("_", "_scale_") for end in ("min", "max") for axis in "xyz"]
    words = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    header = "element chunk 1\n" + "".join(f"property float {name}\n" for name in bounds)
    header += "element vertex 2\n" + "".join(f"property uint {name}\n" for name in words)
    body = np.linspace(-3.0, 3.0, 12, dtype="<f4").tobytes() + bytes(range(32))
    path = folder / "a.compressed.ply"
    path.write_bytes(f"ply\nformat binary_little_endian 1.0\n{header}end_header\n".encode() + body)
    return path


def usda(folder: Path) -> Path:
    """An asset in one layer of text."""
    from pxr import Usd

    converters.write(_cloud(), folder / "whole.usdc")
    Usd.Stage.Open(str(folder / "whole.usdc")).Flatten().Export(str(folder / "a.usda"))
    return folder / "a.usda"


def exr(folder: Path) -> Path:
    """An environment."""
    write_exr(folder / "a.exr", dict.fromkeys("RGB", np.linspace(0, 1, 16 * 32, dtype=np.float32).reshape(16, 32)))
    return folder / "a.exr"


def hdr(folder: Path) -> Path:
    """An environment, each component of a scanline as one run."""
    row = bytes((2, 2, 0, 32)) + b"".join(bytes((128 + 32, value)) for value in (90, 80, 70, 128))
    (folder / "a.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n" + 16 * row)
    return folder / "a.hdr"


def png(folder: Path) -> Path:
    """A photograph."""
    pixels = np.arange(30 * 40 * 4, dtype=np.uint8).reshape(30, 40, 4)
    PillowImage.fromarray(pixels).save(folder / "a.png")
    return folder / "a.png"


POSE = [[1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.25], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def nerfstudio(folder: Path) -> Path:
    """A capture of one photograph, with every field that is read."""
    png(folder)
    record = {"file_path": "a.png", "transform_matrix": POSE, "camera": "front", "frame": 0, "time": 0.5}
    record |= {"split": "train", "color_space": "srgb", "truth": "a.png", "relit": {"noon": "a.png"}}
    content = {"w": 40, "h": 30, "fl_x": 50.0, "fl_y": 50.0, "cx": 20.0, "cy": 15.0, "k1": 0.01, "k2": 0.0, "p1": 0.0}
    content |= {"camera_model": "OPENCV", "fps": 24.0, "train_filenames": ["a.png"], "frames": [record]}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder / "transforms.json"


def colmap_text(folder: Path, spoiled: str = "cameras.txt") -> Path:
    """A model of one photograph, one of whose files is spoiled."""
    (folder / "images.txt").write_text("1 1 0 0 0 0.5 0.25 3 1 a.png\n\n")
    (folder / "cameras.txt").write_text("1 PINHOLE 40 30 50.0 50.0 20.0 15.0\n")
    (folder / "points3D.txt").write_text("1 0.5 0.5 3 255 128 0 0.5 1 2\n")
    return folder / spoiled


def colmap_binary(folder: Path, spoiled: str = "cameras.bin") -> Path:
    """A binary model of one photograph, one of whose files is spoiled."""
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, 40, 30, 50.0, 50.0, 20.0, 15.0))
    image = struct.pack("<QI7dI", 1, 1, 1.0, 0.0, 0.0, 0.0, 0.5, 0.25, 3.0, 1) + b"a.png\0" + struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(image)
    points = struct.pack("<QQ3d3BdQII", 1, 1, 0.5, 0.5, 3.0, 255, 128, 0, 0.5, 1, 1, 2)
    (folder / "points3D.bin").write_bytes(points)
    return folder / spoiled


def projections(folder: Path) -> Path:
    """A projection matrix beside its photograph."""
    png(folder)
    (folder / "a_P.txt").write_text("50 0 20 10\n0 50 15 5\n0 0 1 3\n")
    return folder / "a_P.txt"


def projection_options(folder: Path) -> Path:
    """The same; its options are spoiled."""
    projections(folder)
    (folder / "capture.json").write_text(json.dumps({"scale": 1.0, "pixel_centers": "half", "color_space": "srgb"}))
    return folder / "capture.json"


def stage(folder: Path) -> Path:
    """A stage with every part."""
    ply(folder)
    exr(folder)
    asset = {"path": "a.ply", "name": "statue", "translate": [1, 2, 3], "rotate": [10, 20, 30], "scale": 0.5}
    asset |= {"start": 0.25, "speed": 2, "loop": True, "blend": "rows", "on_ground": True, "centered": True}
    content = {
        "beam-stage": 1,
        "fps": 20,
        "duration": 1.5,
        "assets": [asset],
        "meshes": [{"ground": True, "size": 8, "height": 0.5, "catches_shadows": True}],
        "lights": [{"type": "point", "position": [1, -2, 2], "intensity": [4, 4, 4], "radius": 0.1}],
        "environment": {"path": "a.exr", "rotate": 30, "degrees_per_second": 10, "exposure": 1},
        "camera": {"type": "orbit", "turns": 1, "elevation": 10, "fov": 30},
    }
    (folder / "stage.json").write_text(json.dumps(content))
    return folder / "stage.json"


def lights(folder: Path) -> Path:
    """Lamps."""
    spot = {"type": "spot", "position": [1, -2, 2], "direction": [0, 0, -1], "intensity": [4, 4, 4]}
    spot |= {"inner_angle": 20, "outer_angle": 30, "radius": 0.1, "casts_shadows": True}
    (folder / "lights.json").write_text(json.dumps({"lights": [spot]}))
    return folder / "lights.json"


def stored(folder: Path) -> Path:
    """A frame that a job keeps."""
    write_frame(folder / "a.h5", {"a": np.arange(100.0), "b": np.ones((4, 3), np.float32)})
    return folder / "a.h5"


def _capture(path: Path) -> None:
    Capture.read(path.parent).points()


PLY_SWAPS = {
    "a count beyond the file": (b"element vertex ", b"element vertex 99999999"),
    "a negative count": (b"element vertex ", b"element vertex -"),
    "another type": (b"property float x", b"property list uchar float x"),
    "a control character": (b"property float y", b"property \x1b[31m y"),
    "no end": (b"end_header", b"end_headex"),
}

EARLY = (0.0, 0.1, 0.3)
"""Cuts of files whose last part may be missing."""

READERS: dict[str, Reader] = {
    **SPLATS,
    **ARCHIVES,
    "ply": Reader(ply, read_frames, "splats", swaps=PLY_SWAPS),
    "text ply": Reader(
        text_ply, read_frames, "splats", swaps={**PLY_SWAPS, "a word": (b"-3.5", b"three"), "nan": (b"-3.5", b"nan")}
    ),
    "compressed ply": Reader(
        compressed_ply,
        read_frames,
        "splats",
        swaps={
            "a count beyond the file": (b"vertex 2", b"vertex 2000000"),
            "chunks beyond the file": (b"chunk 1", b"chunk 1000000000"),
            "no chunk": (b"element chunk 1", b"element chunk 0"),
            "bounds that are none": (np.float32(-3.0).tobytes(), np.float32(np.nan).tobytes()),
        },
    ),
    "usda": Reader(
        usda,
        lambda path: read_asset(path, trusted=True)[0],
        swaps={
            "a scalar for an array": (b"point3f[] positions = [", b"point3f positions = (0, 0, 0) #"),
            "no unit": (b"metersPerUnit = 1", b"metersPerUnit = 1e-300"),
            "a string for a count": (b"int beam:sequence:frameCount = 1", b'string beam:sequence:frameCount = "1"'),
            "a count beyond samples": (b"sequence:frameCount = 1", b"sequence:frameCount = 2147483647"),
            "another axis": (b'upAxis = "', b'upAxis = "\x1b[31m'),
        },
        cuts=(0.0, 0.01, 0.1, 0.3, 0.6),
    ),
    "exr": Reader(
        exr,
        EnvironmentMap.read,
        "images",
        swaps={
            "a window of zeros": (struct.pack("<4i", 0, 0, 31, 15), struct.pack("<4i", 0, 0, 8191, 4095)),
            "a window of ones": (struct.pack("<4i", 0, 0, 31, 15), struct.pack("<4i", 5, 5, 4, 4)),
            "a hidden channel": (b"\0R\0", b"\0\x1b\0"),
        },
    ),
    "hdr": Reader(
        hdr,
        EnvironmentMap.read,
        "images",
        swaps={
            "a large size": (b"-Y 16 +X 32", b"-Y 16384 +X 32768"),
            "a size beyond the file": (b"-Y 16 +X 32", b"-Y 512 +X 1024"),
            "a negative size": (b"-Y 16", b"-Y -16"),
            "an exposure that is none": (b"FORMAT", b"EXPOSURE=nan\nFORMAT"),
            "an exposure next to none": (b"FORMAT", b"EXPOSURE=1e-320\nFORMAT"),
            "another format": (b"rgbe\n", b"xyze\x1b\n"),
            "a run too long": (bytes((128 + 32, 90)), bytes((255, 90))),
            "turned by a quarter": (b"-Y 16 +X 32", b"+X 32 -Y 16"),
        },
    ),
    "png": Reader(
        png,
        read_image,
        "images",
        swaps={"a large size": (struct.pack(">II", 40, 30), struct.pack(">II", 2**30, 2**30))},
        cuts=EARLY,
    ),
    "nerfstudio": Reader(
        nerfstudio, _capture, "captures", is_json=True, free=frozenset({"k1", "k2", "p1", "truth", "noon", "relit"})
    ),
    "colmap cameras, text": Reader(
        colmap_text,
        _capture,
        "captures",
        swaps={"a word": (b"40 30", b"40 x"), "nan": (b"50.0", b"nan"), "a model": (b"PINHOLE", b"\x1b[31m")},
        cuts=(0.0, 0.3, 0.6),
    ),
    "colmap images, text": Reader(
        partial(colmap_text, spoiled="images.txt"),
        _capture,
        "captures",
        swaps={"a word": (b"0.25", b"x"), "nan": (b"0.25", b"nan"), "zero": (b"1 1 0", b"1 0 0")},
        cuts=(0.0, 0.3),
    ),
    "colmap points, text": Reader(
        partial(colmap_text, spoiled="points3D.txt"),
        _capture,
        "captures",
        swaps={"nan": (b"0.5 0.5", b"nan 0.5")},
        cuts=(0.3,),
    ),
    "colmap cameras": Reader(
        colmap_binary,
        _capture,
        "captures",
        swaps={
            "a count beyond the file": (struct.pack("<QI", 1, 1), struct.pack("<QI", 2**60, 1)),
            "a size of nothing": (struct.pack("<QQ", 40, 30), struct.pack("<QQ", 0, 30)),
            "a model": (struct.pack("<Ii", 1, 1), struct.pack("<Ii", 1, 99)),
        },
    ),
    "colmap images": Reader(
        partial(colmap_binary, spoiled="images.bin"),
        _capture,
        "captures",
        swaps={
            "a count beyond the file": (struct.pack("<QI", 1, 1), struct.pack("<QI", 2**63, 1)),
            "a name without end": (b"a.png\0", b"a.pngx"),
            "nan": (struct.pack("<d", 0.25), struct.pack("<d", np.nan)),
        },
    ),
    "colmap points": Reader(
        partial(colmap_binary, spoiled="points3D.bin"),
        _capture,
        "captures",
        swaps={"a count beyond the file": (struct.pack("<QQ", 1, 1), struct.pack("<QQ", 2**62, 1))},
    ),
    "projections": Reader(
        projections,
        _capture,
        "captures",
        swaps={
            "a word": (b"50 0 20", b"x 0 20"),
            "nan": (b"50 0 20", b"nan 0 20"),
            "singular": (b"0 0 1 3", b"0 0 0 3"),
        },
        cuts=(0.0, 0.1, 0.3, 0.6),
    ),
    "projection options": Reader(projection_options, _capture, "captures", is_json=True),
    "stage": Reader(stage, lambda path: Stage.read(path).cloud_at(0.0), is_json=True, free=frozenset({"name"})),
    "lights": Reader(lights, read_lights, "captures", is_json=True),
    "stored frame": Reader(stored, read_frame, cuts=(0.0, 0.01, 0.1, 0.3)),
}
"""Every reader of files that strangers made."""


def streamed_sog(folder: Path) -> Path:
    """A scene of one region."""
    converters.write(_cloud(), folder / "lod-meta.json")
    return folder / "lod-meta.json"


def lcc(folder: Path) -> Path:
    """A scene of four regions and two levels."""
    radiance = {"radiance": np.zeros((3, 1, 3), np.float32), "radiance_color_space": DISPLAY_SRGB}
    write_lcc.write_lcc(_cloud()[0].with_arrays(axes="rfu", **radiance), folder / "meta.lcc")
    return folder / "meta.lcc"


def lcc2(folder: Path) -> Path:
    """A scene of one leaf."""
    ply(folder)
    leaf = {"childNum": 0, "data": {"3dgs": {"name": 0, "start": 0, "count": 2}}}
    root = {"splatFiles": ["a.ply"], "childNum": 1, "child": {"0": leaf}}
    (folder / "a.lcc2").write_text(json.dumps({"version": "0.0.3", "splatType": ".ply", "root": root}))
    return folder / "a.lcc2"


LEVELS: dict[str, Reader] = {
    "streamed sog": Reader(
        streamed_sog,
        read_frames,
        "splats",
        swaps={
            "another version": (b'"version":1', b'"version":2'),
            "a file elsewhere": (b"0_0/meta.json", b"../../a.json "),
            "a file that is none": (b"0_0/meta.json", b"0_0/\\u001b[31m"),
            "a run beyond the file": (b'"offset":0', b'"offset":9'),
        },
        is_json=True,
        free=frozenset({"asset", "generator", "count", "bound", "min", "max"}),
    ),
    "lcc": Reader(
        lcc,
        read_frames,
        "splats",
        swaps={"levels that are not there": (b'"totalLevel": 2', b'"totalLevel": 1')},
        is_json=True,
        free=frozenset({"version", "totalSplats", "indexDataSize", "offset", "epsg", "splats"}),
    ),
    "lcc2": Reader(
        lcc2,
        read_frames,
        "splats",
        swaps={
            "a file elsewhere": (b'"a.ply"', b'"../a.ply"'),
            "a file of another kind": (b'"a.ply"', b'"a.lcc2"'),
            "a run beyond the file": (b'"start": 0', b'"start": 9'),
            "negative": (b'"count": 2', b'"count": -2'),
        },
        is_json=True,
        free=frozenset({"version", "childNum"}),
    ),
}
"""Readers of scenes with levels of detail."""

READERS |= LEVELS
