"""Sound files of the splat formats beside PLY, and how each is spoiled: in its bytes, and in what it packs."""

import base64
import gzip
import json
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hostile.ways import BOMB_BYTES, Case, Inside, Reader, Ways, bomb
from support.radiant_cloud import radiant_cloud

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.world.gaussians import GaussianSequence


def read_frames(path: Path, **options: Any) -> None:
    """Read every frame of what the converters read."""
    sequence = converters.read(path, **options)
    for frame in range(len(sequence)):
        sequence[frame]


def written(name: str, degree: int, **options: Any) -> Callable[[Path], Path]:
    """Return a function that writes three Gaussians into a folder; the name tells the format."""

    def make(folder: Path) -> Path:
        sequence = GaussianSequence.from_clouds([radiant_cloud(3, degree)])
        converters.write(sequence, folder / name, WriteOptions(**options))
        return folder / name

    return make


# SPZ

EARLY_POSITIONS = {1: struct.pack("<3e", 1.0, -2.0, 0.5), 2: bytes(range(9))}


def early_spz(version: int) -> Callable[[Path], Path]:
    """Return a function that writes one Gaussian of degree 0 in version 1 or 2."""

    def make(folder: Path) -> Path:
        header = struct.pack("<4sIIBBBx", b"NGSP", version, 1, 0, 12, 0)
        body = EARLY_POSITIONS[version] + bytes((255, 100, 120, 140, 80, 90, 100, 127, 127, 127))
        (folder / "a.spz").write_bytes(gzip.compress(header + body))
        return folder / "a.spz"

    return make


def _streams(content: bytes) -> Iterator[Case]:
    """Versions 1 to 3 that are packed twice, or whose stream is a bomb: counted in the header, or behind the end."""
    plain = gzip.decompress(content)
    yield Case("packed twice", gzip.compress(content))
    many = plain[:8] + struct.pack("<I", 20_000_000) + plain[12:16]
    for name, start in (("a bomb", many), ("a bomb behind the end", plain)):
        packer = zlib.compressobj(0, wbits=-15)
        packed = packer.compress(start) + packer.flush(zlib.Z_FULL_FLUSH) + bomb()
        yield Case(name, gzip.compress(b"")[:10] + packed + struct.pack("<II", 0, BOMB_BYTES))


def _zstandard_frames(content: bytes) -> Iterator[Case]:
    """Version 4 whose first stream unpacks to far more than it should, says so or not, or asks for much memory."""
    blocks = 4095 * b"\x02\x00\x10\x00" + b"\x03\x00\x10\x00"  # each repeats a zero 2^17 times
    frames = {
        "a bomb": b"\x28\xb5\x2f\xfd\x80\x50" + struct.pack("<I", BOMB_BYTES) + blocks,
        "a bomb of unstated size": b"\x28\xb5\x2f\xfd\x00\x50" + blocks,
        "a frame of 1 TiB": b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 1 << 40) + blocks,
        "a window of 1 TiB": b"\x28\xb5\x2f\xfd\x00\xf0" + blocks,
    }
    for name, frame in frames.items():
        yield Case(name, content[:32] + struct.pack("<Q", len(frame)) + content[40 : 32 + 16 * content[15]] + frame)


SPZ_HEADER = {"version": (4, "<I"), "Gaussians": (8, "<I"), "degree": (12, "<B"), "fractional bits": (13, "<B")}
SPZ_FREE = frozenset({"fractional bits is 16"})
IN_GZIP = Ways(numbers=SPZ_HEADER, free=SPZ_FREE)
TABLE = {"streams": (15, "<B"), "table": (16, "<I"), "packed": (32, "<Q"), "unpacked": (40, "<Q")}


# glTF


def gltf(folder: Path) -> Path:
    """A document with its bytes beside it, and a node that moves, turns and enlarges."""
    path = written("a.gltf", 0)(folder)
    document = json.loads(path.read_text())
    document["nodes"][0] |= {"translation": [1.0, 2.0, 3.0], "rotation": [0.0, 0.0, 0.0, 1.0], "scale": [2.0, 2.0, 2.0]}
    path.write_text(json.dumps(document))
    return path


def _scenes(content: bytes) -> Iterator[Case]:
    """Documents whose nodes turn in circles or never end, and that show few bytes again and again."""
    document = json.loads(content)
    one = document["nodes"][0]

    def changed(**parts: Any) -> bytes:
        return json.dumps(document | parts).encode()

    yield Case("a circle", changed(nodes=[one | {"children": [1]}, {"children": [0]}]))
    yield Case("a million nodes", changed(nodes=[one, *1_000_000 * [{}]]))
    yield Case("a long chain", changed(nodes=[*({"children": [n + 1]} for n in range(20_000)), one]))
    yield Case("900 splats", changed(scenes=[{"nodes": list(range(900))}], nodes=900 * [one]), is_fatal=False)
    # Zeros are no quaternions, which is found last.
    count = 50_000
    data = {"byteLength": 16 * count, "uri": f"data:;base64,{base64.b64encode(bytes(16 * count)).decode()}"}
    large = {
        "buffers": [data],
        "bufferViews": [{"buffer": 0, "byteLength": 16 * count}],
        "accessors": [item | {"bufferView": 0, "count": count} for item in document["accessors"]],
    }
    again = {"scenes": [{"nodes": list(range(900))}], "nodes": 900 * [one]}
    (primitive,) = document["meshes"][0]["primitives"]
    yield Case("20 large splats", changed(**large, meshes=[{"primitives": 20 * [primitive]}]))
    yield Case("900 large splats", changed(**large, **again))
    yield Case(
        "large splats beside an absent buffer", changed(**large | {"buffers": [data, {"byteLength": 2**52}]}, **again)
    )
    yield Case("900 large primitives", changed(**large, meshes=[{"primitives": 900 * [primitive]}]))
    for uri in ("../a.bin", "%2e%2e/a.bin", "/dev/zero", "file:///dev/zero", "http://127.0.0.1/a.bin", "data:,a"):
        yield Case(f"bytes at {uri}", changed(buffers=[document["buffers"][0] | {"uri": uri}]))
    view = document["bufferViews"][0]
    for stride in (1, 2**31, 2**52):
        views = [view | {"byteStride": stride}, *document["bufferViews"][1:]]
        yield Case(f"a stride of {stride}", changed(bufferViews=views))
    sparse = {"sparse": {"count": 2**31, "indices": {"bufferView": 0}, "values": {"bufferView": 0}}}
    yield Case("a sparse accessor", changed(accessors=[document["accessors"][0] | sparse, *document["accessors"][1:]]))


GLTF = Ways(
    is_json=True,
    others=_scenes,
    free=frozenset(
        (
            "generator",
            "extensionsUsed",
            "min",
            "max",
            "normalized",
            "COLOR_0",
            "kernel",
            "framesPerSecond",
            "name",
            "meshes.primitives.extras is an object",
            "meshes.primitives.extras.beam is an object",
        )
    ),
)


def glb_json(content: bytes) -> bytes:
    """Return the document of a GLB."""
    return content[20 : 20 + struct.unpack_from("<I", content, 12)[0]]


def glb_with(content: bytes, document: bytes) -> bytes:
    """Return a GLB with another document."""
    document += b" " * (-len(document) % 4)
    binary = content[20 + len(glb_json(content)) :]
    size = 20 + len(document) + len(binary)
    return struct.pack("<4sIII4s", b"glTF", 2, size, len(document), b"JSON") + document + binary


# Raw rows


def ksplat(folder: Path) -> Path:
    """Two Gaussians of level 1 in a full bucket."""
    header, section = bytearray(4096), bytearray(1024)
    struct.pack_into("<BBxxIIIIH", header, 0, 0, 1, 1, 1, 2, 2, 1)
    struct.pack_into("<4If", section, 0, 2, 2, 2, 1, 5.0)
    struct.pack_into("<HxxIxxxxII", section, 20, 12, 32767, 1, 0)
    row = struct.pack("<3H7e4B", 1, 2, 3, 0.5, 0.5, 0.5, 1.0, 0.0, 0.0, 0.0, 9, 9, 9, 255)
    (folder / "a.ksplat").write_bytes(bytes(header + section) + struct.pack("<3f", 1.0, 2.0, 3.0) + 2 * row)
    return folder / "a.ksplat"


KSPLAT = {
    "version": (0, "<B"),
    "sections": (4, "<I"),
    "Gaussians": (16, "<I"),
    "level": (20, "<H"),
    "least harmonic": (36, "<f"),
    "greatest harmonic": (40, "<f"),
    "rows": (4100, "<I"),
    "rows of a bucket": (4104, "<I"),
    "buckets": (4108, "<I"),
    "block": (4112, "<f"),
    "bytes of a bucket": (4116, "<H"),
    "steps": (4120, "<I"),
    "full buckets": (4128, "<I"),
    "other buckets": (4132, "<I"),
    "degree": (4136, "<H"),
    "a centre": (5120, "<f"),
    "a position": (5132, "<H"),
    "a scale": (5138, "<e"),
    "a rotation": (5144, "<e"),
}

SPLATS = {
    **{
        f"spz {version}": Reader(
            early_spz(version) if version < 3 else written("a.spz", 1),
            read_frames,
            "splats",
            others=_streams,
            inside=Inside(gzip.decompress, lambda _, part: gzip.compress(part), IN_GZIP),
        )
        for version in (1, 2, 3)
    },
    "spz 4": Reader(
        written("a.spz", 1, spz_version=4),
        read_frames,
        "splats",
        numbers=SPZ_HEADER | TABLE,
        free=SPZ_FREE,
        others=_zstandard_frames,
    ),
    "gltf": Reader(gltf, read_frames, "splats", is_json=True, others=_scenes, free=GLTF.free),
    "glb": Reader(
        written("a.glb", 1),
        read_frames,
        "splats",
        numbers={"version": (4, "<I"), "length": (8, "<I"), "length of the document": (12, "<I")},
        inside=Inside(glb_json, glb_with, GLTF),
    ),
    "splat": Reader(
        written("a.splat", 0),
        read_frames,
        "splats",
        cuts=(0.3, 0.6, 0.9),
        numbers={"x": (0, "<f"), "a scale": (12, "<f")},
        others=lambda content: iter([Case("no rotation", content[:28] + 4 * b"\x80" + content[32:])]),
        free=frozenset({"zeros"}),
    ),
    "ksplat": Reader(ksplat, read_frames, "splats", numbers=KSPLAT, free=frozenset({"steps", "a position"})),
}
"""Every reader of splats beside PLY and archives."""
