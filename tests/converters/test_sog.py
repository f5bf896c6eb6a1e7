"""SOG in: one Gaussian at a time by hand, other programs' files, and every place where a file can lie."""

import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from beam_warp import converters
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.sog import reader as sog
from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError
from beam_warp.world.metadata import stated_raster

FOREIGN = Path(__file__).parent / "foreign" / "splat_transform_3_7.sog"

COEFFICIENTS = (0, 3, 8, 15)

EPSILON = float(np.finfo(np.float32).eps)


def webp(pixels):
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "WEBP", lossless=True, exact=True)
    return stream.getvalue()


def random_sog(count=11, degree=2, version=2, size=(4, 4), entries=70, seed=0):
    """Files by name, with meta.json as an object and textures as arrays, of random codes."""
    rng = np.random.default_rng(seed)
    shape = (size[1], size[0])
    alpha = {"quats": rng.integers(252, 256, (*shape, 1)), "sh0": rng.integers(0, 256, (*shape, 1))}
    files = {f"{name}.webp": rng.integers(0, 256, (*shape, 3)) for name in ("means_l", "means_u", "scales")}
    files |= {f"{name}.webp": np.dstack([rng.integers(0, 256, (*shape, 3)), alpha[name]]) for name in ("quats", "sh0")}
    meta = {
        "means": {"mins": [-1.0, -2.0, 0.5], "maxs": [3.0, -0.5, 0.5], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"files": ["sh0.webp"]},
    }
    if degree:
        entries = entries if version == 2 else 128
        rows = -(-entries // 64)
        files["shN_centroids.webp"] = rng.integers(0, 256, (rows, 64 * COEFFICIENTS[degree], 3))
        labels = rng.integers(0, entries, shape)
        files["shN_labels.webp"] = np.dstack([labels % 256, labels // 256, 0 * labels])
        meta["shN"] = {"files": ["shN_centroids.webp", "shN_labels.webp"]}
    if version == 2:
        meta |= {"version": 2, "count": count}
        for group, low, high in (("scales", -9.0, 1.0), ("sh0", -2.0, 3.0), ("shN", -1.0, 1.0)):
            if group in meta:
                meta[group]["codebook"] = np.sort(rng.uniform(low, high, 256)).tolist()
        if degree:
            meta["shN"] |= {"count": entries, "bands": degree}
    else:
        meta["means"]["shape"] = [count, 3]
        meta["scales"] |= {"mins": [-9.0, -8.0, -7.0], "maxs": [0.0, 1.0, 0.5]}
        meta["sh0"] |= {"mins": [-1.0, -2.0, -1.5, -6.0], "maxs": [1.0, 2.0, 1.5, 7.0]}
        if degree:
            meta["shN"] |= {"mins": -0.7, "maxs": 0.9}
    return {"meta.json": meta, **{name: pixels.astype(np.uint8) for name, pixels in files.items()}}


def contents(files):
    """The bytes of files whose content is an object, an array or bytes."""
    made = {dict: lambda content: json.dumps(content).encode(), np.ndarray: webp, bytes: bytes}
    return {name: made[type(content)](content) for name, content in files.items()}


def bundle(files, path, compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in contents(files).items():
            archive.writestr(name, content)
    return path


def folder(files, path):
    path.mkdir()
    for name, content in contents(files).items():
        (path / name).write_bytes(content)
    return path


def by_hand(files, index):
    """One Gaussian in float64, as the specification words it: position, xyzw, scales, opacity, coefficients."""
    meta = files["meta.json"]
    new = meta.get("version") == 2
    texel = {
        name.removesuffix(".webp"): p.reshape(-1, p.shape[2])[index] for name, p in files.items() if name[-1] == "p"
    }

    def between(group, code, axis=None):
        low, high = (meta[group][key] if axis is None else meta[group][key][axis] for key in ("mins", "maxs"))
        return low + (high - low) * code

    def value(group, code, axis=None):
        return meta[group]["codebook"][code] if new else between(group, code / 255, axis)

    position = []
    for axis in range(3):
        code = 256 * int(texel["means_u"][axis]) + int(texel["means_l"][axis])
        logarithm = between("means", code / 65535, axis)
        position.append(math.copysign(math.exp(abs(logarithm)) - 1, logarithm))
    *three, mode = (int(code) for code in texel["quats"])
    wxyz = [(code / 255 * 2 - 1) / math.sqrt(2) for code in three]
    square = sum(part**2 for part in wxyz)
    wxyz.insert(mode - 252, math.sqrt(max(0.0, 1 - square)))
    length = math.sqrt(max(1.0, square))
    w, x, y, z = (part / length for part in wxyz)
    scales = [math.exp(value("scales", texel["scales"][axis], axis)) for axis in range(3)]
    raw = texel["sh0"][3]
    opacity = raw / 255 if new else 1 / (1 + math.exp(-value("sh0", raw, 3)))
    coefficients = [[value("sh0", texel["sh0"][axis], axis) for axis in range(3)]]
    if "shN" in meta:
        label = 256 * int(texel["shN_labels"][1]) + int(texel["shN_labels"][0])
        palette = files["shN_centroids.webp"]
        for k in range(palette.shape[1] // 64):
            pixel = palette[label // 64, label % 64 * (palette.shape[1] // 64) + k]
            coefficients.append([value("shN", code) for code in pixel])
    return position, [x, y, z, w], scales, opacity, coefficients


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_gaussian_is_what_the_specification_says(degree, version, tmp_path):
    files = random_sog(degree=degree, version=version)
    sequence = converters.read(bundle(files, tmp_path / "a.sog"))
    cloud = sequence[0]
    assert (len(cloud), cloud.sh_degree, cloud.axes) == (11, degree, "rdf")
    assert "axes are not stated" in sequence.metadata["notes"]
    for index in range(len(cloud)):
        position, orientation, scales, opacity, coefficients = by_hand(files, index)
        # Every value is rounded to float32 once, except 1 + |x|, whose rounding in float64 is far below.
        assert np.allclose(cloud.positions[index], position, rtol=EPSILON, atol=1e-15)
        assert np.allclose(cloud.orientations[index], orientation, rtol=EPSILON, atol=EPSILON)
        assert np.allclose(cloud.scales[index], scales, rtol=EPSILON, atol=0)
        assert math.isclose(cloud.opacities[index], opacity, rel_tol=EPSILON)
        assert np.allclose(cloud.radiance[index], coefficients, rtol=EPSILON, atol=EPSILON)


def foreign_gaussians():
    """Gaussians of which SplatTransform made the fixture: positions, xyzw, log scales, opacities, coefficients."""
    row = np.arange(64)[:, None]

    def wave(first, count):
        column = first + np.arange(count)
        return np.sin(1.0 + row * 0.7 + column * 1.9 + row * column * 0.31)

    xyzw = wave(3, 4) / np.linalg.norm(wave(3, 4), axis=1, keepdims=True)
    positions = 3 * wave(0, 3) * np.array([1, 2, 5])
    return positions, xyzw, 2 * wave(7, 3) - 4, (row[:, 0] + 1) / 65, 0.8 * wave(10, 27).reshape(64, 9, 3)


def test_a_bundle_of_another_program():
    sequence = converters.read(FOREIGN)
    cloud = sequence[0]
    positions, xyzw, log_scales, opacities, coefficients = foreign_gaussians()
    row = np.rint(cloud.opacities * 65).astype(int) - 1  # opacities are 4 steps of a byte apart, so they tell the row
    assert sorted(row) == list(range(64))
    assert sequence.metadata["producer"] == "splat-transform v3.7.0, by its meta.json"
    assert stated_raster(sequence.metadata) == (True, 0.3)
    # That program cuts codes off, so that an error is up to a whole step.
    logs = np.copysign(np.log1p(np.abs(positions)), positions)
    step = np.ptp(logs, axis=0) / 65535
    got = np.copysign(np.log1p(np.abs(cloud.positions)), cloud.positions)
    assert (np.abs(got - logs[row]) <= step * 1.01).all()
    cosine = np.abs(np.einsum("ij,ij->i", cloud.orientations, xyzw[row]))
    # A component has an error of up to d = sqrt(2) / 255; the largest, at least 1/2, makes the whole at most doubled.
    assert (2 * np.sin(np.arccos(np.minimum(cosine, 1)) / 2) <= 2 * math.sqrt(3) * (math.sqrt(2) / 255) * 1.05).all()
    assert np.abs(cloud.opacities - opacities[row]).max() <= 1 / 255
    # The palette has an entry for each of 64 Gaussians, so that the rest is codes, each of which is the nearest.
    with zipfile.ZipFile(FOREIGN) as archive:
        meta = json.loads(archive.read("meta.json"))
    for got, wanted, group in (
        (np.log(cloud.scales), log_scales[row], "scales"),
        (cloud.radiance[:, 0], coefficients[row][:, 0], "sh0"),
        (cloud.radiance[:, 1:], coefficients[row][:, 1:], "shN"),
    ):
        nearest = np.abs(wanted[..., None] - np.array(meta[group]["codebook"])).min(axis=-1)
        assert np.allclose(np.abs(got - wanted), nearest, atol=8 * EPSILON)


@pytest.mark.parametrize(("count", "height"), [(3000, 1.08), (8406, 1.08)])
def test_folders_of_a_real_scene(count, height, data_dir):
    sequence = converters.read(data_dir / "splats" / f"playbot_{count}_sog" / "meta.json")
    cloud = sequence[0]
    assert (len(cloud), cloud.sh_degree) == (count, 2)
    assert cloud.positions[:, 1].min() == pytest.approx(-height, abs=0.01)  # a figure of 1.08 m upon y = 0, y down
    assert np.median(cloud.scales) < 0.02
    color = 0.5 + 0.2821 * cloud.radiance[:, 0]
    assert ((color > -0.35) & (color < 1.5)).mean() > 0.9


def test_a_bundle_a_folder_and_its_meta_are_the_same(tmp_path):
    files = random_sog()
    place = folder(files, tmp_path / "scene")
    ways = [bundle(files, tmp_path / "a.sog"), bundle(files, tmp_path / "b.sog", zipfile.ZIP_DEFLATED), place]
    first, *others = [sog.decode(path, ReadOptions()).fields for path in (*ways, place / "meta.json")]
    for fields in others:
        assert all(np.array_equal(fields[name], first[name]) for name in first)
    assert sog.probe(place).count == sog.probe(ways[0]).count == 11


def test_numbered_bundles_are_a_sequence(tmp_path):
    for number in (8, 9, 10):
        bundle(random_sog(count=number), tmp_path / f"walk{number}.sog")
    assert [len(cloud) for cloud in converters.read(tmp_path)] == [8, 9, 10]
    (tmp_path / "walk10.sog").write_bytes((tmp_path / "walk10.sog").read_bytes()[:-30])
    with pytest.raises(AssetFormatError, match=r"walk10\.sog: a SOG bundle must be a zip archive"):
        converters.read(tmp_path)


def test_a_codebook_that_begins_with_null_goes_on_as_the_rest(tmp_path):
    files = random_sog(degree=0)
    book = files["meta.json"]["sh0"]["codebook"] = [None, *np.linspace(1.0, 2.0, 255).tolist()]
    files["sh0.webp"][:] = 0
    cloud = converters.read(bundle(files, tmp_path / "a.sog"))[0]
    assert np.allclose(cloud.radiance[:, 0], book[1] - 1 / 255, rtol=EPSILON)


def test_how_splats_are_drawn(tmp_path):
    files = random_sog()
    for key, value in (("model", "antialiased"), ("antialias", True)):
        files["meta.json"] = random_sog()["meta.json"] | {key: value}
        assert stated_raster(converters.read(bundle(files, tmp_path / "a.sog")).metadata) == (True, 0.3)
    files["meta.json"] = random_sog()["meta.json"] | {"model": "2dgs"}
    sequence = converters.read(bundle(files, tmp_path / "a.sog"))
    assert not sequence[0].scales[:, 2].any()
    assert "2D Gaussians" in sequence.metadata["notes"]


def test_pixels_without_alpha_are_opaque_and_a_png_is_as_good(tmp_path):
    files = random_sog()
    stream = io.BytesIO()
    Image.fromarray(files["scales.webp"]).save(stream, "PNG")
    wanted = sog.decode(bundle(files, tmp_path / "a.sog"), ReadOptions()).fields
    files["scales.webp"] = stream.getvalue()
    files["sh0.webp"] = files["sh0.webp"][..., :3]
    got = sog.decode(bundle(files, tmp_path / "a.sog"), ReadOptions()).fields
    assert np.array_equal(got["scales"], wanted["scales"])
    assert (got["opacities"] == 1.0).all()


def test_rotations_that_are_none_are_dropped_on_request(tmp_path):
    files = random_sog()
    files["quats.webp"][0, 2, 3] = 251
    path = bundle(files, tmp_path / "a.sog")
    with pytest.raises(
        AssetFormatError, match=r"quats\.webp must have alpha 252 to 255, got 251 at row 2\. .*--drop-in"
    ):
        converters.read(path)
    sequence = converters.read(path, drop_invalid=True)
    assert len(sequence[0]) == 10
    assert "1 with a zero quaternion" in sequence.metadata["notes"]


def lossy(pixels):
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "WEBP", lossless=False)
    return stream.getvalue()


def vast(width, height):
    """A WebP header that states any size, with nothing behind it."""
    sides = (width - 1 | height - 1 << 14).to_bytes(4, "little")
    return b"RIFF" + (22).to_bytes(4, "little") + b"WEBPVP8L" + (10).to_bytes(4, "little") + b"\x2f" + sides + bytes(5)


def put(value, *keys):
    """A change of one entry of meta.json."""

    def change(files):
        *outer, last = keys
        place = files["meta.json"]
        for key in outer:
            place = place[key]
        place[last] = value

    return change


def replace(name, make):
    """A change of one file."""

    def change(files):
        files[name] = make(files[name])

    return change


BOOK = [0.0] * 255

MALFORMED = {
    "no meta": (lambda files: files.pop("meta.json"), r"a SOG must hold meta\.json|must be an existing file"),
    "no texture": (lambda files: files.pop("scales.webp"), r"a SOG must hold scales\.webp"),
    "no JSON": (replace("meta.json", lambda _: b"{"), r"meta\.json must be JSON"),
    "nesting": (replace("meta.json", lambda _: b"[" * 500_000), r"meta\.json must be JSON"),
    "a list": (replace("meta.json", lambda _: b"[]"), r"meta\.json must hold an object, got list"),
    "long meta": (replace("meta.json", lambda _: b" " * 2_000_000), r"meta\.json must have at most 1048576 bytes"),
    "version 3": (put(3, "version"), r"version must be 1 or 2, got 3\. Update"),
    "no means": (lambda files: files["meta.json"].pop("means"), r"must describe means, got nothing"),
    "scales no object": (put(7, "scales"), r"must describe scales, got 7"),
    "count 2^31": (put(2**31, "count"), r"count must be a number of Gaussians below 2\^31"),
    "count true": (put(True, "count"), r"count must be a number"),
    "count of digits": (replace("meta.json", lambda _: b'{"count": ' + b"9" * 5000 + b"}"), r"must be JSON"),
    "count above pixels": (put(17, "count"), r"means_l\.webp must have a pixel for each of 17 .* 4 x 4 px"),
    "count above bytes": (put(2**30, "count"), r"bytes must hold at most 4 Gaussians each, got count 1073741824"),
    "NaN in a codebook": (put([math.nan, *BOOK], "scales", "codebook"), r"scales\.codebook must be 256 finite"),
    "short codebook": (put(BOOK, "sh0", "codebook"), r"sh0\.codebook must be 256 finite numbers"),
    "huge number": (put([10**400, *BOOK], "shN", "codebook"), r"shN\.codebook must be 256 finite"),
    "text in a codebook": (put(["a", *BOOK], "shN", "codebook"), r"shN\.codebook must be 256 finite"),
    "linear scales": (put([*BOOK, 99.0], "scales", "codebook"), r"scales must be natural logs up to 20, got 99"),
    "bounds": (put([0.0, math.inf, 1.0], "means", "maxs"), r"means\.maxs must be 3 finite numbers"),
    "overflow": (put([1e4] * 3, "means", "maxs"), r"positions must be finite"),
    "a way out": (put(["../a.webp"], "quats", "files"), r"quats\.files must be 1 plain file names"),
    "absolute": (put(["/etc/passwd"], "quats", "files"), r"quats\.files must be 1 plain file names"),
    "one name of two": (put(["means_l.webp"], "means", "files"), r"means\.files must be 2 plain file names"),
    "escape codes": (put(["\x1b[2J"], "sh0", "files"), r"sh0\.files must be 1 plain file names, got \['\\x1b"),
    "own axes": (put({"axes": "xyz"}, "beam"), r"beam must state axes"),
    "own rate": (
        put({"axes": "rdf", "radianceMeaning": "none", "framesPerSecond": 0}, "beam"),
        r"beam\.framesPerSecond must lie in",
    ),
    "bands": (put(4, "shN", "bands"), r"spherical harmonics must have degree 1 to 3, got shN\.bands 4"),
    "other bands": (put(3, "shN", "bands"), r"palette of 70 rows of degree 3 must be 960 px wide.* 512 x 2 px"),
    "short palette": (put(129, "shN", "count"), r"palette of 129 rows"),
    "vast palette": (put(2**16 + 1, "shN", "count"), r"shN\.count must be at most 65536"),
    "label": (put(5, "shN", "count"), r"labels of spherical harmonics must be below 5, got \d+ at row"),
    "cut texture": (replace("sh0.webp", lambda p: webp(p)[:-9]), r"sh0\.webp must have the \d+ bytes that it states"),
    "damage": (
        replace("quats.webp", lambda p: webp(p)[:30] + bytes(len(webp(p)) - 30)),
        r"quats\.webp must be an intact picture",
    ),
    "no picture": (replace("quats.webp", lambda _: b"GIF89a"), r"quats\.webp must be a lossless WebP or an 8-bit PNG"),
    "lossy": (replace("quats.webp", lossy), r"quats\.webp must be lossless"),
    "other size": (replace("sh0.webp", lambda p: p[:2]), r"sh0\.webp must have 4 x 4 px like means_l\.webp, got 4 x 2"),
    "vast": (replace("means_l.webp", lambda _: vast(16384, 16384)), r"pixel for each of 11 .* 16384 x 16384 px"),
    "vast, believed": (
        lambda files: files.update({n: vast(500, 500) for n in files if n not in ("meta.json", "shN_centroids.webp")}),
        r"means_l\.webp must be an intact picture",
    ),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed(case, tmp_path):
    change, message = MALFORMED[case]
    files = random_sog()
    change(files)
    for path in (bundle(files, tmp_path / "a.sog"), folder(files, tmp_path / "b") / "meta.json"):
        with pytest.raises((AssetFormatError, MissingFileError), match=message) as caught:
            converters.read(path)
        assert "\n" not in str(caught.value)


def test_every_truncation_of_a_bundle_is_one_error(tmp_path):
    whole = FOREIGN.read_bytes()
    for end in (0, 1, 22, 100, 1000, *range(2000, len(whole), 1499), len(whole) - 1):
        (tmp_path / "a.sog").write_bytes(whole[:end])
        with pytest.raises(AssetFormatError, match="must be a zip archive"):
            converters.read(tmp_path / "a.sog")


def test_tricks_of_archives(tmp_path):
    path = tmp_path / "a.sog"
    bundle(random_sog() | {"scales.webp": bytes(20_000_000)}, path, zipfile.ZIP_DEFLATED)
    with pytest.raises(AssetFormatError, match=r"scales\.webp must unpack to at most \d+ bytes, got more"):
        converters.read(path)
    bundle(random_sog() | {f"{number}" * 9: b"" for number in range(4000)}, path)
    with pytest.raises(
        AssetFormatError,
        match=r"^a\.sog: a SOG bundle must be a zip archive of few files, got .*a directory of \d+ bytes",
    ):
        converters.read(path)
    content = bytearray(bundle(random_sog(), path).read_bytes())
    content[content.index(b"RIFF") + 40] ^= 255
    path.write_bytes(content)
    with pytest.raises(AssetFormatError, match=r"must be readable, got a damaged one \(Bad CRC-32"):
        converters.read(path)


def test_what_is_not_there_and_what_says_nothing(tmp_path):
    with pytest.raises(MissingFileError, match="input must be an existing file"):
        converters.read(tmp_path / "a.sog")
    with pytest.raises(InvalidOptionError, match="activation must be left out for SOG"):
        converters.read(bundle(random_sog(), tmp_path / "a.sog"), activation="linear")
