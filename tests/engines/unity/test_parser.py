"""The package's parser, run by mono: planes and weights bit by bit, frames number by number, one line an error."""

import re

import numpy as np
import pytest
from engines.unity.csharp import needs_mono, run
from engines.unity.takes import walk
from scipy.spatial.transform import Rotation

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.converters.delivery.decoder import Container
from beam_warp.world.axes import change_axes

pytestmark = needs_mono


TAKES = {
    "moving": ("a.b4d", lambda: walk(60, 14, noise=0.02), WriteOptions()),
    "folder": ("manifest.json", lambda: walk(17, 13, noise=0.0), WriteOptions()),
    "still with radiance": ("a.b4d", lambda: walk(33, 1, noise=0.0, degree=1), WriteOptions(sh_degree=1)),
}


@pytest.mark.parametrize(
    "name", [next(iter(TAKES)), *(pytest.param(name, marks=pytest.mark.slow) for name in list(TAKES)[1:])]
)
def test_the_parser_reads_what_python_reads(dump, tmp_path, name):
    file, make, options = TAKES[name]
    take = tmp_path / "take" / file
    take.parent.mkdir()
    converters.write(make(), take, options)
    (tmp_path / "out").mkdir()
    done = run(dump, take, tmp_path / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    container = Container(take)
    manifest = container.manifest
    facts = [*(f"{manifest[key]:g}" for key in ("frames", "count", "rate")), str(manifest["topology"] == "constant")]
    assert done.stdout.split() == facts
    found = {path.name: np.fromfile(path, np.float32) for path in (tmp_path / "out").iterdir()}
    for entry in (container.manifest["static"], *container.manifest["segments"]):
        for array, track in container.tracks(entry, entry.get("frames", 1)).items():
            for c, component in enumerate(track):
                part = f"{entry['file'].removesuffix('.bin')}.{array}{c}"
                planes = [*component.summed, *(unpack() for unpack in component.plain)]
                assert (found.pop(f"{part}.weights") == component.weights.ravel()).all(), part
                theirs = found.pop(f"{part}.planes")
                assert len(theirs) == sum(map(len, planes)), part
                assert not planes or (theirs == np.concatenate(planes).astype(np.float32)).all(), part
    for frame in range(container.manifest["frames"]):
        for array, values in container.frame(frame).items():
            theirs = found.pop(f"{frame}.{array}")
            # sums of some twenty float32 products, here of doubles: 25 steps of 6e-8, of the largest number
            np.testing.assert_allclose(theirs, values.ravel(), rtol=0, atol=1.5e-6 * max(1.0, np.abs(values).max()))
    assert not found


def damaged(take, place):
    content = bytearray(take.read_bytes())
    content[place(content)] ^= 1
    take.write_bytes(content)


def cut(take, size):
    take.write_bytes(take.read_bytes()[: int(size * take.stat().st_size)])


DAMAGES = {
    "altered segment": (
        lambda take: damaged(take, lambda b: b.rindex(b"PK\3\4") + 60),
        "000012.bin must have the digest",
    ),
    "altered static block": (
        lambda take: damaged(take, lambda b: b.index(b"static.bin", b.index(b"}]}")) + 99),
        "static.bin",
    ),
    "truncated segment": (lambda take: cut(take, 0.8), r"0000\d\d.bin must have \d+ bytes, got \d+"),
    "truncated manifest": (lambda take: cut(take, 0.01), "manifest.json must have at most"),
    "no file": (lambda take: take.unlink(), "a container must be a file, got no a.b4d"),
    "another file": (lambda take: take.write_bytes(b"splat" * 99), "a b4d file must be a zip archive that begins"),
    "empty": (lambda take: take.write_bytes(b""), "a b4d file must be a zip archive that begins"),
    "another version": (
        lambda take: take.write_bytes(take.read_bytes().replace(b'"version":1', b'"version":2')),
        "version must be 1 of b4d, got 2",
    ),
    "escaping name": (
        lambda take: take.write_bytes(take.read_bytes().replace(b'"static.bin"', b'"/tatic.bin"')),
        "blocks must say their file, a name beside the manifest, got /tatic.bin",
    ),
    "deep nesting": (
        lambda take: take.write_bytes(re.sub(rb'\{"format.{400}', b"[" * 407 + b"", take.read_bytes(), count=1)),
        "JSON must not be nested that deep",
    ),
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    take = tmp_path_factory.mktemp("sound") / "a.b4d"
    converters.write(walk(60, 14, noise=0.02), take, WriteOptions())
    return take.read_bytes()


@pytest.mark.parametrize(
    "name", [*list(DAMAGES)[:2], *(pytest.param(name, marks=pytest.mark.slow) for name in list(DAMAGES)[2:])]
)
def test_a_damaged_take_is_refused_in_one_line(dump, sound, tmp_path, name):
    take = tmp_path / "a.b4d"
    take.write_bytes(sound)
    change, said = DAMAGES[name]
    change(take)
    done = run(dump, take, tmp_path)
    assert done.returncode == 2, done.stderr
    assert done.stdout.count("\n") == 1
    assert re.match(said, done.stdout), done.stdout


@pytest.mark.slow
def test_segments_are_streamed_and_two_are_held(dump, sound, tmp_path):
    take = tmp_path / "a.b4d"
    take.write_bytes(sound)
    done = run(dump, take, tmp_path, "stream")
    assert done.stdout.split("\n")[:-1] == ["True True "] * 2, done.stderr


@pytest.mark.slow
def test_a_lost_segment_is_named_while_others_are_streamed(dump, sound, tmp_path):
    take = tmp_path / "a.b4d"
    take.write_bytes(sound)
    damaged(take, lambda content: content.rindex(b"PK\3\4") + 60)
    first, second, _ = run(dump, take, tmp_path, "stream").stdout.split("\n")
    assert first.startswith("True True")
    assert second.startswith("False True 000012.bin must have the digest")


@pytest.mark.slow
@pytest.mark.parametrize("axes", ["rdf", "rfu", "luf"])
def test_a_ply_with_materials_is_read_as_python_reads_it(dump, tmp_path, axes):
    path = tmp_path / "a.ply"
    converters.write(walk(40, 1, noise=0.0), path, WriteOptions(profile="beam", axes=axes))
    (tmp_path / "out").mkdir()
    done = run(dump, path, tmp_path / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    cloud = change_axes(converters.read(path)[0], "rub")
    found = {each.name: np.fromfile(each, np.float32) for each in (tmp_path / "out").iterdir()}
    assert found.keys() == cloud.arrays().keys() - {"radiance"}
    for name, values in found.items():
        theirs = values.reshape(-1, len(cloud)).T.reshape(cloud.arrays()[name].shape)
        if name == "orientations":  # axes of a Gaussian may point either way
            theirs, ours = covariances(theirs, cloud.scales), covariances(cloud.orientations, cloud.scales)
            np.testing.assert_allclose(theirs, ours, atol=1e-5 * ours.max())
        else:
            np.testing.assert_allclose(theirs, cloud.arrays()[name], rtol=1e-5, atol=1e-6, err_msg=name)


def covariances(orientations, scales):
    axes = Rotation.from_quat(orientations).as_matrix() * scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda content: content[:-1], "a.ply must hold 40 Gaussians of 22 numbers, got"),
        (
            lambda content: content.replace(b"comment beam_material linear\n", b""),
            "a.ply must be written with --profile beam",
        ),
        (lambda content: content[:40], "a.ply must have a header that ends"),
        (lambda content: content.replace(b"vertex 40", b"vertex -4"), "a.ply must have one element, vertex, got"),
        (lambda content: content.replace(b"float opacity", b"float opasity"), "a.ply must have all properties of the"),
    ],
)
def test_a_malformed_ply_is_refused_in_one_line(dump, tmp_path, change, said):
    path = tmp_path / "a.ply"
    converters.write(walk(40, 1, noise=0.0), path, WriteOptions(profile="beam"))
    path.write_bytes(change(path.read_bytes()))
    done = run(dump, path, tmp_path)
    assert done.returncode == 2, done.stderr
    assert done.stdout.startswith(said), done.stdout
    assert done.stdout.count("\n") == 1
