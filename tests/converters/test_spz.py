"""SPZ: bytes packed here by plain loops, files of the format's own library and of another program, and our own."""

import math
import struct
import time
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from reference.covariances import covariances
from reference.harmonics import sh_color

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.converters.spz import reader
from beam_warp.converters.spz import writer as spz
from beam_warp.errors import AssetFormatError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.harmonics import sh_basis
from beam_warp.world.metadata import raster_metadata, stated_raster

FOREIGN = Path(__file__).parent / "foreign"
EPSILON = float(np.finfo(np.float32).eps)

COORDINATES = 0xADBE0003


def smallest_three(quaternion):
    """The word of a quaternion xyzw."""
    largest = max(range(4), key=lambda i: abs(quaternion[i]))
    word = largest
    for index in (i for i in range(4) if i != largest):
        value = math.copysign(1.0, quaternion[largest]) * quaternion[index]
        word = word << 10 | (value < 0) << 9 | round(abs(value) / math.sqrt(0.5) * 511)
    return struct.pack("<I", word)


BITS = 12


def arrays_of(rows, version):
    """The six arrays of rows (position, opacity byte, colour bytes, scale bytes, quaternion, band bytes)."""
    position, rotation = b"", b""
    for x, _, _, _, quaternion, _ in rows:
        if version == 1:
            position += struct.pack("<3e", *x)
        else:
            position += b"".join(round(value * 2**BITS).to_bytes(3, "little", signed=True) for value in x)
        if version < 3:
            sign = math.copysign(1.0, quaternion[3])
            rotation += bytes(round(sign * value * 127.5 + 127.5) for value in quaternion[:3])
        else:
            rotation += smallest_three(quaternion)
    rest = [b"".join(bytes(row[place]) for row in rows) for place in (1, 2, 3, 5)]
    return [position, *rest[:3], rotation, rest[3]]


def spz_bytes(rows, version=3, *, bits=BITS, degree=1, flags=0, records=b"", count=None, **changes):
    """A file of rows; ``changes`` overrule ``magic``, ``streams`` and ``table_at`` of the header, and ``table``."""
    arrays = arrays_of(rows, version)
    facts = (changes.get("magic", b"NGSP"), version, len(rows) if count is None else count, degree, bits, flags)
    if version < 4 or changes.get("as_stream"):
        return zlib.compress(struct.pack("<4sIIBBBx", *facts) + b"".join(arrays) + records, wbits=31)
    arrays = [array for array in arrays if array]
    frames = [zstandard.compress(array) for array in arrays]
    table = [n for frame, array in zip(frames, arrays, strict=True) for n in (len(frame), len(array))]
    table = changes.get("table", table)
    places = (changes.get("streams", len(frames)), changes.get("table_at", 32 + len(records)))
    header = struct.pack("<4sIIBBBBI12x", *facts, *places)
    return header + records + struct.pack(f"<{len(table)}Q", *table) + b"".join(changes.get("frames", frames))


ROWS = [
    ((1.0, -2.0, 0.5), [0], [0, 255, 51], [0, 160, 255], (0.0, 0.0, 0.0, 1.0), [0, 128, 255, 1, 64, 192, 127, 129, 96]),
    ((-7.75, 0.0, 3.0), [255], [128, 0, 204], [16, 32, 48], (0.6, 0.0, -0.8, 0.0), [128] * 9),
]
"""Two Gaussians of degree 1; positions and quaternions are exact in every version, or nearly."""


def file_of(folder, content):
    (folder / "a.spz").write_bytes(content)
    return folder / "a.spz"


def read(folder, content, **options):
    return converters.read(file_of(folder, content), **options)


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_bytes_mean_what_the_format_says(tmp_path, version):
    sequence = read(tmp_path, spz_bytes(ROWS, version))
    cloud = sequence[0]
    assert np.array_equal(cloud.positions, [row[0] for row in ROWS])
    assert np.array_equal(cloud.opacities, [0.0, 1.0])
    shown = np.array([row[2] for row in ROWS]) / 255.0
    assert np.allclose(0.15 * cloud.radiance[:, 0] + 0.5, shown, atol=2 * EPSILON)
    logs = np.array([row[3] for row in ROWS]) / 16.0 - 10.0
    assert np.allclose(np.log(cloud.scales), logs, atol=10 * EPSILON)
    # Bytes of bands: coefficient after coefficient, red, green and blue of each.
    assert np.array_equal(cloud.radiance[0, 1:], (np.array(ROWS[0][5]).reshape(3, 3) - 128) / 128)
    assert np.array_equal(cloud.radiance[1, 1:], np.zeros((3, 3)))
    step = 1.0 / 255.0 if version < 3 else 0.5 * math.sqrt(0.5) / 511.0
    turns = np.abs(np.einsum("ij,ij->i", cloud.orientations, [row[4] for row in ROWS]))
    assert (turns >= 1.0 - 2 * 3 * step**2 - 4 * EPSILON).all() or version < 3  # 1 − |Δ|²/2, |Δ|² ≤ 12 h²
    assert (turns >= 0.99).all()
    assert (cloud.axes, cloud.radiance_color_space) == ("rub", DISPLAY_SRGB)
    assert stated_raster(sequence.metadata) is None


def test_a_file_without_its_gzip(tmp_path):
    packed = spz_bytes(ROWS, 2)
    plain = read(tmp_path, zlib.decompress(packed, 31))[0]
    assert np.array_equal(plain.radiance, read(tmp_path, packed)[0].radiance)
    with pytest.raises(AssetFormatError, match="2 Gaussians must have 72 bytes, got 71"):
        read(tmp_path, zlib.decompress(packed, 31)[:-1])


def test_a_record_states_the_axes_and_others_are_named(tmp_path):
    def record(kind, content):
        return struct.pack("<II", kind, len(content)) + content

    records = record(0xADBE0002, bytes(12)) + record(COORDINATES, struct.pack("<I", 15))
    for version in (3, 4):
        sequence = read(tmp_path, spz_bytes(ROWS, version, flags=3, records=records))
        assert sequence[0].axes == "lbu"
        assert sequence.metadata["notes"] == "extensions left out: 0xadbe0002"
        assert stated_raster(sequence.metadata) == (True, pytest.approx(0.3))
        assert read(tmp_path, spz_bytes(ROWS, version), source_axes="rdf")[0].axes == "rdf"


BAND_ERRORS = {8: 0.5 / 128, 5: 4.5 / 128, 4: 8.5 / 128}
"""Largest error of a band by its bits: half its step, and half of a byte, since the library rounds twice."""

CASES = [
    ("library_v2.spz", "rub", 8, 8, False),
    ("library_v3.spz", "rub", 5, 4, True),
    ("library_v4.spz", "rdf", 8, 8, True),
    ("splat_transform_v3.spz", "rdf", 5, 4, False),
    ("splat_transform_v4.spz", "rdf", 5, 4, False),
]


def require_near(back, cloud, band_1, band_rest, turn):
    """Judge Gaussians by what they look like; ``turn`` bounds the error of a unit quaternion."""
    assert np.abs(back.positions - cloud.positions).max() <= 2**-13 + 4 * EPSILON
    assert np.abs(np.log(back.scales) - np.log(cloud.scales)).max() <= 1 / 32 + 10 * EPSILON
    assert np.abs(back.opacities - cloud.opacities).max() <= 0.5 / 255 + EPSILON
    # ‖ΔR‖ ≤ 2 |Δq| and ‖ΔΣ‖ ≤ 2 ‖ΔR‖ s², with the same scales s in both.
    difference = covariances(back.orientations, cloud.scales) - covariances(cloud.orientations, cloud.scales)
    largest = np.linalg.norm(difference, ord=2, axis=(1, 2)) / cloud.scales.max(axis=1) ** 2
    assert largest.max() <= 4 * turn
    count = cloud.radiance.shape[1]
    errors = np.full(count, band_rest)
    errors[:4] = band_1
    errors[0] = 0.5 / (0.15 * 255)
    for direction in np.concatenate([np.eye(3), -np.eye(3), np.full((1, 3), 3**-0.5)]):
        bound = np.abs(sh_basis(direction, round(math.sqrt(count)) - 1)) @ errors
        assert np.abs(sh_color(back.radiance, direction) - sh_color(cloud.radiance, direction)).max() <= bound + 1e-5


SMALLEST_THREE_TURN = 1.01 * math.sqrt(12) * 0.5 * math.sqrt(0.5) / 511
"""Three components are off by h, the largest, m ≥ 1/2, by h (a + b + c)/m ≤ 3 h to first order: √12 h in all."""

FIRST_THREE_TURN = math.sqrt(3 * (1 + math.sqrt(3)) ** 2 / 255**2 + 2 * math.sqrt(3) / 255 + 3 / 255**2)
"""h = 1/255 of each component, (1 + √3) h if all are scaled to unit length; w² is off by 2 (x + y + z) h + 3 h²."""


@pytest.mark.parametrize(("name", "axes", "band_1", "band_rest", "antialiased"), CASES)
def test_files_of_other_programs(name, axes, band_1, band_rest, antialiased):
    cloud = change_axes(converters.read(FOREIGN / "cloud.ply")[0], axes)
    sequence = converters.read(FOREIGN / name, source_axes=axes)
    back = sequence[0]
    turn = FIRST_THREE_TURN if "v2" in name else SMALLEST_THREE_TURN
    three = back.with_arrays(radiance=back.radiance[:, :16])
    require_near(three, cloud, BAND_ERRORS[band_1], BAND_ERRORS[band_rest], turn)
    assert (stated_raster(sequence.metadata) is not None) == antialiased
    if name == "library_v4.spz":
        row, k, channel = np.ogrid[:32, 15:24, :3]
        fourth = 0.9 * np.sin(1.0 + row + 5 * k + 2 * channel)
        assert np.abs(back.radiance[:, 16:] - fourth).max() <= BAND_ERRORS[8] + EPSILON


def write(cloud, path, *, metadata=None, **options):
    return converters.write(GaussianSequence.from_clouds([cloud], metadata=metadata), path, WriteOptions(**options))


@pytest.mark.parametrize(("version", "degree"), [(3, 0), (3, 3), (4, 0), (4, 2), (4, 4)])
def test_written_and_read_again(make_cloud, tmp_path, version, degree):
    cloud = make_cloud(count=300, degree=degree, axes="rub")
    bands = np.clip(cloud.radiance, -0.93, 0.93)  # what the bytes of the bands hold, rounded to 16: ± 119/128
    cloud = cloud.with_arrays(
        radiance=np.concatenate([np.clip(cloud.radiance[:, :1], -3.3, 3.3), bands[:, 1:]], axis=1),
        positions=np.clip(cloud.positions * 3.0, -9.0, 9.0),
        scales=np.clip(cloud.scales, 5e-5, None),
    )
    metadata = raster_metadata(degree == 3, 0.1)
    write(cloud, tmp_path / "a.spz", spz_version=version, metadata=metadata)
    sequence = converters.read(tmp_path / "a.spz")
    require_near(sequence[0], cloud, 4 / 128, 8 / 128, SMALLEST_THREE_TURN)
    assert sequence.metadata["producer"] == "unknown"
    assert stated_raster(sequence.metadata) == ((True, pytest.approx(0.3)) if degree == 3 else None)
    first = (tmp_path / "a.spz").read_bytes()
    write(cloud, tmp_path / "a.spz", spz_version=version, metadata=metadata)
    assert (tmp_path / "a.spz").read_bytes() == first


def test_what_the_bytes_cannot_hold_is_held_at_their_ends(make_cloud, tmp_path):
    cloud = make_cloud(count=2, degree=1, axes="rub")
    far = np.full((2, 4, 3), 50.0, np.float32) * np.array([1.0, -1.0], np.float32)[:, None, None]
    write(cloud.with_arrays(radiance=far, scales=[[0.0] * 3, [1e9] * 3], opacities=[0.0, 1.0]), tmp_path / "a.spz")
    back = converters.read(tmp_path / "a.spz")[0]
    assert np.allclose(np.log(back.scales), [[-10.0] * 3, [255 / 16 - 10] * 3], atol=10 * EPSILON)
    assert np.array_equal(back.opacities, [0.0, 1.0])
    assert np.allclose(back.radiance[:, 0, 0], [0.5 / 0.15, -0.5 / 0.15], atol=4 * EPSILON)
    assert np.array_equal(back.radiance[:, 1, 0], [127 / 128, -1.0])


@given(st.floats(1e-30, 2.0**22 * 0.999))
def test_positions_fit_into_24_bits_and_are_fine_enough(reach):
    bits = spz.fractional_bits(reach)
    assert round(reach * 2**bits) < 2**23
    assert 2.0**-bits <= max(reach / 4096, 2.0**-22)  # at least 4096 steps to the farthest
    assert bits >= 12 or reach >= 1024


def test_other_axes_are_stated(make_cloud, tmp_path):
    from beam_warp.converters.common.frames import FrameToWrite

    facts = {
        "number": 0,
        "frames_per_second": 30.0,
        "units_per_meter": 1.0,
        "raster": None,
        "beside": tmp_path.joinpath,
    }
    for version in (3, 4):
        frame = FrameToWrite(name="a", cloud=make_cloud(axes="rdf"), **facts)
        spz.encode(frame, tmp_path / "a.spz", WriteOptions(spz_version=version))
        assert converters.read(tmp_path / "a.spz")[0].axes == "rdf"
    with pytest.raises(InvalidOptionError, match=r"axes must be one of ldb, .* for SPZ, got fru"):
        spz.encode(FrameToWrite(name="a", cloud=make_cloud(axes="fru"), **facts), tmp_path / "b.spz", WriteOptions())


def test_what_is_not_written(make_cloud, tmp_path):
    cloud = make_cloud(degree=4, axes="rub", materials=True)
    with pytest.raises(InvalidOptionError, match=r"sh_degree must be at most 3 in SPZ 3, got 4\. Pass sh_degree 3, or"):
        write(cloud, tmp_path / "a.spz")
    with pytest.raises(InvalidOptionError, match="profile must be standard for SPZ, which has no materials, got beam"):
        write(cloud, tmp_path / "a.spz", profile="beam", sh_degree=3)
    with pytest.raises(InvalidOptionError, match=r"positions must be within 4194304 units for SPZ, got 5e\+06"):
        write(cloud.with_arrays(positions=cloud.positions * 0 + 5e6), tmp_path / "a.spz", sh_degree=0)
    with pytest.raises(InvalidOptionError, match=r"spz_version must be an integer in \[3, 4\], got 2"):
        WriteOptions(spz_version=2)
    assert not list(tmp_path.iterdir())


def test_no_gaussians(make_cloud, tmp_path):
    for version in (3, 4):
        write(make_cloud(count=0, axes="rub"), tmp_path / "a.spz", spz_version=version)
        sequence = converters.read(tmp_path / "a.spz")
        assert len(sequence[0]) == 0
        assert "holds no Gaussians" in sequence.metadata["notes"]


def refused(folder, content, message=""):
    """Reading refuses ``content``, in one line after the file's name, soon and with little memory."""
    path = file_of(folder, content)
    started = time.process_time()
    tracemalloc.start()
    with pytest.raises(AssetFormatError) as caught:
        converters.read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert time.process_time() - started < 2.0
    assert peak < 64 * 2**20 + 2 * len(content)
    said = str(caught.value)
    assert said.startswith("a.spz: ")
    assert "\n" not in said
    assert message in said


@pytest.mark.parametrize("version", [2, 3, 4])
def test_cut_anywhere(tmp_path, version):
    content = spz_bytes(ROWS, version, flags=2, records=struct.pack("<III", COORDINATES, 4, 4))
    for size in range(len(content)):
        refused(tmp_path, content[:size])
    bare = spz_bytes(ROWS, version)
    for size in range(len(bare)):
        with pytest.raises(AssetFormatError):
            reader.probe(file_of(tmp_path, bare[:size]))
    assert reader.probe(file_of(tmp_path, content)).count == reader.probe(file_of(tmp_path, bare)).count == 2


EMPTY_RECORD = struct.pack("<II", COORDINATES, 4)

MALFORMED = [
    (b"", "SPZ must start with NGSP, plain or in gzip, got b''"),
    (b"ply\n", "SPZ must start with NGSP, plain or in gzip, got b'ply\\n'. Check that it is SPZ."),
    (spz_bytes(ROWS, magic=b"NGSQ"), "SPZ must start with NGSP, plain or in gzip, got b'NGSQ'"),
    (spz_bytes(ROWS, 99), "the version of SPZ must be 1 to 4, got 99"),
    (spz_bytes(ROWS, 0), "the version of SPZ in gzip must be 1 to 3, got 0"),
    (spz_bytes(ROWS, 4, as_stream=True), "the version of SPZ in gzip must be 1 to 3, got 4"),
    (spz_bytes(ROWS, 3, degree=5), "degree and fractional bits must be at most 4 and 24, got 5 and 12"),
    (spz_bytes(ROWS, 4, bits=25), "degree and fractional bits must be at most 4 and 24, got 1 and 25"),
    (spz_bytes(ROWS, 3, count=2**32 - 1), "must unpack to at most 16777216 bytes, got 4294967295 Gaussians of degree"),
    (spz_bytes(ROWS, 4, count=2**32 - 1), "must unpack to at most 16777216 bytes, got 4294967295 Gaussians of degree"),
    (spz_bytes(ROWS, 3, count=500_000), "500000 Gaussians must have 14500016 bytes, got 74"),
    (spz_bytes(ROWS, 4, count=500_000), "stream positions must hold 4500000 bytes, got 18 packed in"),
    (spz_bytes(ROWS, 4, streams=255), "degree 1 must have 6 streams, got 255"),
    (spz_bytes(ROWS, 4, table_at=2**32 - 1), "the table of 6 streams must follow the header, got 0 bytes at 42949"),
    (spz_bytes(ROWS, 4, table_at=0), "the table of 6 streams must follow the header, got 96 bytes at 0"),
    (spz_bytes(ROWS, 4, table=[2**63, 18] * 6), "stream positions must hold 18 bytes, got 18 packed in 92233720368"),
    (spz_bytes(ROWS, 4, table=[27, 2**63] * 6), "stream positions must hold 18 bytes, got 92233720368"),
    (spz_bytes(ROWS, 4, frames=[b"x" * 30] * 6), "stream positions must be Zstandard, got "),
    (spz_bytes(ROWS, 3, flags=2, records=EMPTY_RECORD), "extensions must be whole and known, got type 0xadbe0003 of 4"),
    (spz_bytes(ROWS, 4, flags=2, records=EMPTY_RECORD + bytes(4)), "must be whole and known, got type 0xadbe0003 of 4"),
    (spz_bytes(ROWS, 4, flags=2, records=struct.pack("<II", 7, 2**32 - 1)), "got type 0x7 of 4294967295 bytes"),
]


@pytest.mark.parametrize(("content", "message"), MALFORMED, ids=[message[:60] for _, message in MALFORMED])
def test_malformed(tmp_path, content, message):
    refused(tmp_path, content, message)


def table_of(packed):
    """The table of two Gaussians of degree 1, each stream in as many bytes."""
    return [number for size in (18, 2, 6, 6, 8, 18) for number in (packed, size)]


def test_bombs(tmp_path):
    header = struct.pack("<4sIIBBBx", b"NGSP", 3, 2, 0, 12, 0)
    refused(
        tmp_path,
        zlib.compress(header + bytes(32 * 2**20), wbits=31),
        "2 Gaussians must fill 56 bytes of gzip, got more after 57",
    )
    many = struct.pack("<4sIIBBBx", b"NGSP", 3, 5_000_000, 0, 12, 0)
    refused(tmp_path, zlib.compress(many + bytes(32 * 2**20), wbits=31), "the file must unpack to at most 16777216")
    zeros = zstandard.compress(bytes(32 * 2**20))
    bomb = spz_bytes(ROWS, 4, table=table_of(len(zeros)), frames=[zeros] * 6)
    refused(tmp_path, bomb, "stream positions must hold 18 bytes, got another number")
    # A frame that states 2^60 bytes: magic, a descriptor with 8 bytes of size, the size, an empty last block.
    stated = struct.pack("<IBQ", 0xFD2FB528, 0xE0, 2**60) + b"\1\0\0"
    bomb = spz_bytes(ROWS, 4, table=table_of(len(stated)), frames=[stated] * 6)
    refused(tmp_path, bomb, "stream positions must hold 18 bytes, got another number")


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_halves_that_are_not_finite(tmp_path, value):
    rows = [ROWS[0], ((0.0, value, 0.0), *ROWS[1][1:])]
    refused(tmp_path, spz_bytes(rows, 1), "positions must be finite, got NaN or infinity at row 1")
    assert len(read(tmp_path, spz_bytes(rows, 1), drop_invalid=True)[0]) == 1


@pytest.mark.parametrize("version", [2, 3, 4])
def test_damaged_files_are_read_or_refused(tmp_path, rng, version):
    content = spz_bytes(ROWS * 20, version)
    plain = content if version == 4 else zlib.decompress(content, 31)
    refusals = []
    for _ in range(150):
        damaged = bytearray(plain)
        for at in rng.integers(0, 64, 2):
            damaged[at] = rng.integers(256)
        path = file_of(tmp_path, bytes(damaged) if version == 4 else zlib.compress(bytes(damaged), wbits=31))
        try:
            converters.read(path)
        except AssetFormatError as error:
            refusals.append(str(error))
    assert all(said.startswith("a.spz: ") for said in refusals)
    assert 20 < len(refusals) < 150
