"""Sound archives of every kind that is read, and how each is spoiled: its directory, its members, what they hold."""

import copy
import hashlib
import io
import json
import math
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from hostile.splats import read_frames, written
from hostile.ways import BOMB_BYTES, Case, Inside, Reader, Ways, bomb
from PIL import Image as PillowImage
from support.radiant_cloud import radiant_cloud

from beam_warp import converters
from beam_warp.converters.common.bounds import bounds_of
from beam_warp.schema.reader import read_asset
from beam_warp.world.gaussians import GaussianSequence


def zipped(files: Mapping[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    """Return the bytes of an archive."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, compression)
    return stream.getvalue()


def unzipped(content: bytes) -> dict[str, bytes]:
    """Return the files of an archive by name."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def member(name: str, ways: Ways) -> Inside:
    """Return one file of an archive as what is to be spoiled."""
    return Inside(
        lambda content: unzipped(content)[name], lambda content, part: zipped({**unzipped(content), name: part}), ways
    )


def archives(content: bytes) -> Iterator[Case]:
    """Archives that list too much or nothing, lie about sizes, or unpack to far more than they take."""
    start, end = content.index(b"PK\1\2"), content.rindex(b"PK\5\6")
    entry = content[start : start + 46 + sum(struct.unpack_from("<3H", content, start + 28))]
    long = 120_000 * entry
    yield Case("a long directory", content[:start] + long + _end(len(long), start))
    yield Case("no directory", content[:end] + _end(0, end))
    yield Case("a directory before the file", content[:end] + _end(2**31, 2**31))
    (name, first), *others = unzipped(content).items()
    rest = {"readme.txt": b"", **dict(others)}
    yield Case("nested", zipped({name: content, **rest}))
    for label, stated in (("a bomb", BOMB_BYTES), ("a bomb that lies", len(first))):
        yield Case(label, _explosive(name, stated, zipped(rest)))
    for label, place, value in (("encrypted", 8, 1), ("packed in an unknown way", 10, 99)):
        yield Case(label, content[: start + place] + struct.pack("<H", value) + content[start + place + 2 :])
    for label, other in (("absolute", "/a"), ("outside", "../a"), ("of another system", "c:\\a")):
        yield Case(f"a name {label}", zipped({other + name: first, **rest}))
    yield Case("no name", zipped({"": b"", **rest, name: first}), is_fatal=False)
    yield Case("a long name", zipped({name.rjust(300, "n"): first, **rest}))
    yield Case("a name that does not print", zipped({f"\x1b[31m{name}": first, **rest}), is_fatal=False)


def _explosive(name: str, stated: int, sound: bytes) -> bytes:
    """Return an archive with one more file, which is a bomb and states another size on request."""
    start, end = sound.index(b"PK\1\2"), sound.rindex(b"PK\5\6")
    facts = struct.pack("<5H3IH", 20, 0, zipfile.ZIP_DEFLATED, 0, 0, 0, len(bomb()), stated, len(name))
    local = b"PK\3\4" + facts + bytes(2) + name.encode() + bomb()
    listed = b"PK\1\2" + struct.pack("<H", 20) + facts + struct.pack("<4H2I", 0, 0, 0, 0, 0, start)
    directory = sound[start:end] + listed + name.encode()
    return sound[:start] + local + directory + _end(len(directory), start + len(local))


def _end(size: int, start: int) -> bytes:
    return struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 1, 1, size, start, 0)


# SOG


def webp(width: int, height: int, *, lossless: bool = True) -> bytes:
    """Return a picture of one colour, which is sound as every code."""
    stream = io.BytesIO()
    color = (0, 0, 128, 252)
    PillowImage.new("RGBA", (width, height), color).save(stream, "WEBP", lossless=lossless, exact=True)
    return stream.getvalue()


def _framed(picture: bytes, side: int) -> bytes:
    """Return a WebP whose canvas has another size than the picture on it."""
    canvas = struct.pack("<4sI4s", b"VP8X", 10, bytes(4)) + 2 * (side - 1).to_bytes(3, "little") + picture[12:]
    return b"RIFF" + struct.pack("<I", 4 + len(canvas)) + b"WEBP" + canvas


def _textures(content: bytes) -> Iterator[Case]:
    """Bundles with a texture of another size or kind, and those of far more Gaussians than they have bytes."""
    files = unzipped(content)
    sound = files["means_l.webp"]
    textures = {
        "too small": webp(1, 1),
        "too large": webp(9, 9),
        "lossy": webp(4, 4, lossless=False),
        "on a large canvas": _framed(sound, 16384),
        "on a canvas beyond pictures": _framed(sound, 2**24),
        "cut": sound[: len(sound) // 2],
        "empty": b"",
    }
    for name, texture in textures.items():
        yield Case(f"a texture {name}", zipped({**files, "means_l.webp": texture}))
    meta = json.loads(files["meta.json"])
    meta["means"]["maxs"] = [300.0] * 3  # positions overflow, which is found last
    for side in (1024, 2048):
        large = {name: webp(side, side) for name in files if name.endswith("webp") and "centroids" not in name}
        said = json.dumps(meta | {"count": side**2}).encode()
        yield Case(f"{side} x {side} Gaussians of one code", zipped({**files, **large, "meta.json": said}))


def sog_folder(folder: Path) -> Path:
    """The files of a bundle beside each other."""
    bundle = written("a.sog", 3)(folder)
    for name, content in unzipped(bundle.read_bytes()).items():
        (folder / name).write_bytes(content)
    bundle.unlink()
    return folder / "meta.json"


SOG_META = Ways(is_json=True, free=frozenset({"asset", "generator", "model", "antialias", "beam", "in UTF-16"}))


# NumPy and HDF5


def npz(folder: Path) -> Path:
    """Arrays by name."""
    return written("a.npz", 1)(folder)


def _npy(shape: tuple[int, ...], dtype: str, data: bytes = b"") -> bytes:
    header = f"{{'descr': {dtype!r}, 'fortran_order': False, 'shape': {shape!r}, }}".ljust(117).encode() + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + data


def _arrays(content: bytes) -> Iterator[Case]:
    """Arrays that would run code, or whose headers lie."""
    files = unzipped(content)
    members = {
        "pickled": _npy((3, 3), "|O", pickle.dumps([1.0] * 9)),
        "structured": _npy((3,), [("x", "<f4"), ("y", "<f4")], bytes(24)),
        "of texts": _npy((3, 3), "<U1", bytes(36)),
        "of dates": _npy((3, 3), "<M8[s]", bytes(72)),
        "of complex numbers": _npy((3, 3), "<c8", bytes(72)),
        "vast": _npy((2**62, 3), "<f4"),
        "of no size": _npy((2**62, 0), "<f4"),
        "of negative size": _npy((-1, -9), "<f4", bytes(36)),
        "of many axes": _npy((1,) * 65, "<f4", bytes(4)),
        "with a program in its header": _npy((3, 3), "<f4", bytes(36)).replace(b"False", b"1if1else[]"),
        "with an open header": _npy((3, 3), "<f4", bytes(36)).replace(b"}", b" "),
        "with a long header": b"\x93NUMPY\2\0" + struct.pack("<I", 2**20) + b"(" * 2**20,
    }
    for name, array in members.items():
        yield Case(f"an array {name}", zipped({**files, "positions.npy": array}))
    for name in ("axes", "meters_per_unit", "frames_per_second"):
        for form, array in (("a list", np.zeros(3)), ("NaN", np.array(math.nan)), ("ESC", np.array("\x1b[31m"))):
            stream = io.BytesIO()
            np.save(stream, array)
            said = zipped({**files, f"{name}.npy": stream.getvalue()})
            yield Case(f"{name} is {form}", said, is_fatal=form != "a list")


FIELDS: dict[str, Any] = {
    "positions": np.arange(6.0).reshape(2, 3),
    "orientations": np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)),
    "scales": np.ones((2, 3)),
    "opacities": np.ones(2),
}


def _h5(change: Callable[[h5py.File], object] = lambda file: None) -> bytes:
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        for name, value in FIELDS.items():
            file[name] = value
        change(file)
    return stream.getvalue()


def h5(folder: Path) -> Path:
    """Arrays by name, beside another such file."""
    (folder / "a.h5").write_bytes(_h5())
    return folder / "a.h5"


def _in_place(name: str, make: Callable[[h5py.File], object]) -> Callable[[h5py.File], object]:
    """Return a change of a file that puts something else in the place of an array."""

    def change(file: h5py.File) -> None:
        del file[name]
        if (value := make(file)) is not None:
            file[name] = value

    return change


def _groups(count: int) -> Callable[[h5py.File], None]:
    """Return a change of a file that shows one group of arrays under many names."""

    def change(file: h5py.File) -> None:
        group = file.create_group("frame0")
        for name, value in FIELDS.items():
            group[name] = value
        for number in range(1, count):
            file[f"frame{number}"] = group

    return change


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((2, 3), "f8")
    layout[:] = h5py.VirtualSource("/dev/zero", "positions", (2, 3))
    file.create_virtual_dataset("positions", layout)


def _made(*arguments: Any, **options: Any) -> Callable[[h5py.File], None]:
    return lambda file: file.create_dataset("positions", *arguments, **options) and None


CHUNKS = {"maxshape": (None, 3), "compression": "gzip"}

IN_HDF5: dict[str, Callable[[h5py.File], object]] = {
    "an external link": _in_place("positions", lambda _: h5py.ExternalLink("b.h5", "/positions")),
    "a soft link": _in_place("positions", lambda _: h5py.SoftLink("/scales")),
    "a soft link to itself": _in_place("positions", lambda _: h5py.SoftLink("/positions")),
    "a group": _in_place("positions", lambda file: file.create_group("positions") and None),
    "a type": _in_place("positions", lambda _: np.dtype("f4")),
    "a virtual dataset": _in_place("positions", _virtual),
    "bytes of another file": _in_place("positions", _made((2, 3), "f8", external=[("/dev/zero", 0, 48)])),
    "texts": _in_place("positions", lambda _: [[b"a"] * 3] * 2),
    "lists": _in_place("opacities", lambda file: file.create_dataset("opacities", 2, h5py.vlen_dtype("f4")) and None),
    "records": _in_place("opacities", lambda _: np.zeros(2, [("x", "f4"), ("y", "f4")])),
    "nothing": _in_place("positions", lambda _: h5py.Empty("f4")),
    "a number": _in_place("opacities", lambda _: 1.0),
    "NaN": _in_place("opacities", lambda _: [math.nan, 1.0]),
    "a vast shape": _in_place("positions", _made((2**40, 3), "f4", chunks=(1024, 3), compression="gzip")),
    "a vast chunk": _in_place("positions", _made(data=FIELDS["positions"], dtype="f4", chunks=(2**23, 3), **CHUNKS)),
    "a unit that is none": lambda file: file.attrs.update(meters_per_unit=math.nan),
    "a unit of texts": lambda file: file.attrs.update(meters_per_unit="\x1b[31m"),
    "axes of numbers": lambda file: file.attrs.update(axes=np.zeros((9, 9))),
    "axes that do not print": lambda file: file.attrs.update(axes="\x1b[31m\n"),
    "a rate of nothing": lambda file: file.attrs.update(frames_per_second=h5py.Empty("f4")),
}


def _places(content: bytes) -> Iterator[Case]:
    """HDF5 files whose arrays lie elsewhere, hold no numbers, or are larger than they may be."""
    del content
    for name, change in IN_HDF5.items():
        yield Case(name, _h5(change))
    yield Case("groups without end", _h5(_groups(20_000)))
    elsewhere = h5py.ExternalLink("/dev/zero", "/")
    yield Case("a link to follow nowhere", _h5(lambda file: file.update(frame0=elsewhere)), is_fatal=False)


# Frames in a zip archive, and packages of USD


def frames(folder: Path) -> Path:
    """Two numbered splats."""
    splat = written("a.splat", 0)(folder).read_bytes()
    (folder / "a.splat").unlink()
    (folder / "a.zip").write_bytes(zipped({"a_0.splat": splat, "a_1.splat": splat}))
    return folder / "a.zip"


CRATE = {"version": (8, "<H"), "table of contents": (16, "<Q")}

# Delivery


def delivery(folder: Path) -> Path:
    """Three relightable Gaussians that move over two frames."""
    clouds = [radiant_cloud(3, 0, materials=True, seed=7, positions=place * np.eye(3)) for place in (1.0, 2.0)]
    converters.write(GaussianSequence.from_clouds(clouds), folder / "a.b4d")
    return folder / "a.b4d"


def delivery_folder(folder: Path) -> Path:
    """The files of a container beside each other."""
    for name, content in unzipped(delivery(folder).read_bytes()).items():
        (folder / name).write_bytes(content)
    (folder / "a.b4d").unlink()
    return folder / "manifest.json"


DELIVERY_FREE = frozenset(
    {"generator", "topology", "bounds", "metadata", "offset", "in UTF-16", "turns", *bounds_of(radiant_cloud(3))}
)


def _repacked(
    content: bytes, name: str, packed: bytes, unpacked: int | None = None, parts: Any = None, **said: Any
) -> bytes:
    """Return a container with another block, of which the manifest says what is true, but for what is given."""
    files = unzipped(content)
    manifest = json.loads(files["manifest.json"])
    (entry,) = (each for each in (manifest["static"], *manifest["segments"]) if each["file"] == name)
    was = len(files[name])
    entry |= {"bytes": len(packed), "sha256": hashlib.sha256(packed).hexdigest()}
    entry["unpacked"] = len(zlib.decompress(packed)) if unpacked is None else unpacked
    entry["parts"] = parts
    for other in manifest["segments"]:
        other["offset"] += len(packed) - was if name == "static.bin" else 0
    files[name] = packed
    return zipped({**files, "manifest.json": json.dumps(manifest | said).encode()})


def _block(name: str, content: bytes) -> bytes:
    return zlib.decompress(unzipped(content)[name])


def _with_header(block: bytes, header: bytes) -> bytes:
    old = 4 + struct.unpack_from("<I", block)[0]
    return struct.pack("<I", len(header)) + header + block[old:]


def _deliveries(content: bytes) -> Iterator[Case]:
    """Containers that lie about sizes, lead elsewhere, or hold blocks that are bombs or break their rules."""
    for name in ("static.bin", "000000.bin"):
        block = _block(name, content)
        end = 4 + struct.unpack_from("<I", block)[0]
        header = json.loads(block[4:end])
        for label, size in (("that says so", BOMB_BYTES), ("that lies", len(block))):
            packed = b"x\x9c" + bomb()
            yield Case(f"{name} is a bomb {label}", _repacked(content, name, packed, size))
        for label, other in (("cut", block[:-1]), ("longer", block + b"\0"), ("without a header", block[end:])):
            yield Case(f"{name} {label}", _repacked(content, name, zlib.compress(other)), is_fatal=label != "longer")
        for value in (math.nan, math.inf, 1e30):
            other = block[:end] + struct.pack("<f", value) + block[end + 4 :]
            yield Case(f"{name} with a weight of {value}", _repacked(content, name, zlib.compress(other)))
        planes = ([[5], []], [[-1], []], [[], [10**9]], [["1"], []], [[1]], [], None, [[1] * 100_000, []])
        for which, plane in enumerate(planes):
            arrays = copy.deepcopy(header["arrays"])
            arrays[0]["planes"][0] = plane
            other = _with_header(block, json.dumps({"arrays": arrays}).encode())
            yield Case(f"{name} with planes {which}", _repacked(content, name, zlib.compress(other)))
        for label, arrays in (("unknown", [{"name": "a", "planes": []}]), ("twice", 2 * header["arrays"]), ("none", 0)):
            other = _with_header(block, json.dumps({"arrays": arrays}).encode())
            yield Case(f"{name} with arrays {label}", _repacked(content, name, zlib.compress(other)))
        files = unzipped(content)
        manifest = json.loads(files["manifest.json"])
        (sizes,) = (e["parts"] for e in (manifest["static"], *manifest["segments"]) if e["file"] == name)
        head, rest, size = files[name][: sizes[0]], files[name][sizes[0] :], len(block)
        last = zlib.compressobj(9, zlib.DEFLATED, -15)
        burst = last.compress(bytes(BOMB_BYTES)) + last.flush()
        yield Case(
            f"{name} with a part that is a bomb",
            _repacked(content, name, head + burst + rest, size, [sizes[0], len(burst), *sizes[2:]]),
        )
        lies = {"fewer": sizes[:-1], "more": [*sizes, 0], "moved": [sizes[0], sizes[1] - 1, *sizes[2:]]}
        lies |= {repr(parts): parts for parts in ([-1], [2**70], ["1"], {}, 3, "ab")}
        for label, parts in lies.items():  # {}: nothing is said of parts, the block is one
            said = _repacked(content, name, files[name], size, parts)
            yield Case(f"{name} with parts {label}", said, is_fatal=parts != {})
    static = unzipped(content)["static.bin"]
    for count in (0, 1, 2**18, 2**31, -1, 3.0, True):
        yield Case(f"count {count}", _repacked(content, "static.bin", static, count=count))
    for file in ("../static.bin", "/dev/zero", "..", "", "a\\b", "\x1b[31m", None):
        manifest = json.loads(unzipped(content)["manifest.json"])
        manifest["static"]["file"] = file
        said = zipped({**unzipped(content), "manifest.json": json.dumps(manifest).encode()})
        yield Case(f"a block in {file!r}", said)


ARCHIVES = {
    "b4d": Reader(
        delivery,
        read_frames,
        "splats",
        others=_deliveries,
        inside=member("manifest.json", Ways(is_json=True, free=DELIVERY_FREE)),
        free=frozenset({"cut at 90%"}),  # of the archive's directory, which is not needed
    ),
    "b4d folder": Reader(delivery_folder, read_frames, "splats", is_json=True, free=DELIVERY_FREE),
    "sog": Reader(
        written("a.sog", 3),
        read_frames,
        "splats",
        others=lambda content: (case for way in (archives, _textures) for case in way(content)),
        inside=member("meta.json", SOG_META),
    ),
    "sog folder": Reader(sog_folder, read_frames, "splats", is_json=True, free=SOG_META.free),
    "npz": Reader(
        npz,
        read_frames,
        "splats",
        others=lambda content: (case for way in (archives, _arrays) for case in way(content)),
        inside=member("positions.npy", Ways(cuts=(0.0, 0.3, 0.9))),
    ),
    "h5": Reader(h5, read_frames, others=_places, cuts=(0.0, 0.01, 0.1, 0.3, 0.6)),
    "zip": Reader(
        frames,
        read_frames,
        "splats",
        others=archives,
        inside=member("a_0.splat", Ways(cuts=(0.3,), free=frozenset({"zeros"}))),
    ),
    "usdz": Reader(written("a.usdz", 0), read_asset, others=archives, free=frozenset({"a long name"}), is_slow=True),
    "usdc": Reader(written("a.usdc", 0), read_asset, numbers=CRATE, is_slow=True),
}
"""Every reader of archives."""
