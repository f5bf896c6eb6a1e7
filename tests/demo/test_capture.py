"""The demo's capture: it reads back as any other, and its images, truth and meshes tell of the same surface."""

import json

import numpy as np
import pytest
import trimesh

from beam_warp.demo.capture import dome_cameras, write_demo_capture
from beam_warp.demo.lights import studio
from beam_warp.errors import MissingFileError, OutputError
from beam_warp.world.environment import EnvironmentMap

ONE_VIEW = {"frame_count": 1, "camera_count": 1, "test_camera_count": 0, "device": "cpu"}


def truth_mesh(capture, frame):
    with np.load(capture.folder / f"truth/mesh_{frame:04d}.npz") as file:
        return trimesh.Trimesh(file["vertices"], file["faces"], process=False)


def first_hits(mesh, camera, rows, columns):
    """Depth along the optical axis and unit normal where rays through pixels first meet a mesh (Möller, Trumbore)."""
    corners = np.asarray(mesh.triangles)
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    depth, normals = np.full(len(rows), np.inf), np.zeros((len(rows), 3))
    for index, direction in enumerate(camera.directions()[rows, columns]):
        cross = np.cross(direction, two)
        scale = (one * cross).sum(axis=1)
        offset = camera.position - corners[:, 0]
        other = np.cross(offset, one)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = (offset * cross).sum(axis=1) / scale, (other @ direction) / scale
            distance = (other * two).sum(axis=1) / scale
        hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)
        face = np.flatnonzero(hit)[np.argmin(distance[hit])]
        depth[index] = distance[face] * (direction @ camera.forward)
        normals[index] = mesh.face_normals[face]
    return depth, normals


class TestLayout:
    def test_records_are_those_of_the_documented_layout(self, tiny_capture):
        assert tiny_capture.frames == (0, 1)
        assert tiny_capture.splits == ("test", "train")
        assert len(tiny_capture.select(split="train", frames=[0])) == 6
        test = tiny_capture.select(split="test", frames=[1])[0]
        assert (test.camera_name, test.name, test.time) == ("test_00", "test_00_0001", 1.0 / 24.0)
        assert test.image_path == tiny_capture.folder / "images/test_00/0001.exr"
        assert test.truth_path == tiny_capture.folder / "truth/test_00_0001.exr"
        assert all(record.truth_path is None for record in tiny_capture.select(split="train"))
        assert tiny_capture.frames_per_second == 24.0
        content = json.loads((tiny_capture.folder / "transforms.json").read_text())
        pose = np.array(content["frames"][0]["transform_matrix"])
        # OpenGL axes: a camera looks down its own -z, at the figure in the middle, with its own y up.
        assert (pose[:3, :3] @ [0.0, 0.0, -1.0]) @ (np.array([0.0, 0.0, 0.9]) - pose[:3, 3]) > 2.0
        assert pose[2, 1] > 0.0

    def test_truth_has_the_documented_channels(self, tiny_capture):
        names = {"A", "ambient_occlusion", "roughness", "depth"}
        names |= {f"base_color.{c}" for c in "RGB"} | {f"normal.{c}" for c in "XYZ"}
        for record in tiny_capture.select(split="test"):
            assert set(record.truth().channels) == names

    def test_environment_is_the_light_of_the_capture(self, tiny_capture):
        light = EnvironmentMap.read(tiny_capture.environment_path)
        np.testing.assert_allclose(light.radiance, studio().radiance, rtol=1e-6)

    def test_a_camera_stays_where_it_is(self, tiny_capture):
        first, second = (tiny_capture.select(split="train", frames=[frame]) for frame in (0, 1))
        for a, b in zip(first, second, strict=True):
            assert np.array_equal(a.camera.camera_to_world, b.camera.camera_to_world)

    def test_folder_with_content_is_refused_and_left_alone(self, tmp_path):
        (tmp_path / "mine.txt").write_text("mine")
        with pytest.raises(OutputError, match="folder must be new or empty"):
            write_demo_capture(tmp_path, **ONE_VIEW, size=8)
        assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]

    def test_what_stops_half_way_leaves_nothing(self, tmp_path):
        def stop(stage, done, total):
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            write_demo_capture(tmp_path / "capture", **ONE_VIEW, size=8, samples=1, progress=stop)
        assert not list(tmp_path.iterdir())


class TestImages:
    def test_alpha_is_antialiased_and_color_is_premultiplied(self, tiny_capture):
        for record in tiny_capture.records:
            image = record.image()
            partly = (image.alpha > 0.0) & (image.alpha < 1.0)
            # An outline of some 150 pixels, each of them covered in part.
            assert partly.sum() > 50
            assert (image.rgb()[image.alpha == 0.0] == 0.0).all()
            assert (image.alpha == 1.0).sum() > 100

    def test_all_of_the_figure_is_seen(self, tiny_capture):
        for record in tiny_capture.records:
            alpha = record.image().alpha
            edge = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
            assert (edge == 0.0).all()

    def test_truth_is_that_of_the_mesh(self, tiny_capture, rng):
        """Rays through centres of solid pixels meet the mesh where the truth says, within what a pixel spans."""
        for record in tiny_capture.select(split="test"):
            truth, camera = record.truth(), record.camera
            solid = np.argwhere(truth.channels["A"] > 0.999)
            rows, columns = rng.permutation(solid)[:60].T
            depth, normals = first_hits(truth_mesh(tiny_capture, record.frame), camera, rows, columns)
            pixel = np.median(depth) / camera.focal_x
            # The mean over a pixel of a surface seen at up to 60 degrees is within a pixel's width of its centre.
            assert np.median(np.abs(depth - truth.channels["depth"][rows, columns])) < pixel
            cosine = (normals * truth.stack("normal.X", "normal.Y", "normal.Z")[rows, columns]).sum(axis=1)
            assert np.median(cosine) > np.cos(np.radians(15.0))  # a pixel of 40 mm spans that much of most limbs

    def test_same_seed_gives_the_same_images_and_another_seed_others(self, tmp_path):
        def image(name, seed):
            capture = write_demo_capture(tmp_path / name, **ONE_VIEW, size=24, samples=4, seed=seed)
            return capture.records[0].image().rgb()

        first = image("a", 3)
        assert np.array_equal(first, image("b", 3))
        assert not np.array_equal(first, image("c", 4))

    def test_topology_is_constant_and_the_figure_moves(self, tiny_capture):
        first, second = (truth_mesh(tiny_capture, frame) for frame in (0, 1))
        assert np.array_equal(first.faces, second.faces)
        assert first.is_watertight
        moved = np.linalg.norm(first.vertices - second.vertices, axis=1)
        assert 0.002 < np.median(moved) < 0.02
        assert moved.max() < 0.06


def test_dome_looks_at_the_middle_from_one_distance():
    points = np.random.default_rng(3).uniform((-0.5, -0.3, 0.0), (0.5, 0.3, 1.8), (200, 3))
    dome = dome_cameras([points[:100], points[100:]], 8, 2, 64, 48)
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    assert [entry.name for entry in dome] == [f"train_{i:02d}" for i in range(8)] + ["test_00", "test_01"]
    distances = [np.linalg.norm(entry.camera.position - center) for entry in dome]
    np.testing.assert_allclose(distances, distances[0])
    for entry in dome:
        seen = entry.camera.project(points)
        assert ((seen[:, :2] > 0) & (seen[:, :2] < (64, 48))).all()
    azimuths = np.sort([np.arctan2(*(e.camera.position - center)[:2]) for e in dome if e.split == "train"])
    np.testing.assert_allclose(np.diff(azimuths), np.pi / 4.0)


class TestRelit:
    def test_the_light_of_the_capture_gives_its_own_image(self, tmp_path):
        """The same paths under the same light: but for the half floats of images, 2^-11 of a value."""
        lights = {"same": studio(), "dark": EnvironmentMap.constant((0.0, 0.0, 0.0))}
        sizes = {**ONE_VIEW, "test_camera_count": 1, "size": 32, "samples": 2}
        capture = write_demo_capture(tmp_path / "capture", **sizes, relit=lights)
        train, test = capture.records
        assert train.relit_paths == {}
        assert test.relit_paths["dark"] == capture.folder / "truth/relit_dark/test_00_0000.exr"
        image, same, dark = (shown.linear_rgba() for shown in (test.image(), test.relit("same"), test.relit("dark")))
        np.testing.assert_allclose(image, same, rtol=2.0**-11, atol=2.0**-25)
        assert dark[..., :3].max() == 0.0
        np.testing.assert_array_equal(dark[..., 3], same[..., 3])
        light = EnvironmentMap.read(capture.folder / "truth/same.exr")
        np.testing.assert_array_equal(light.radiance, studio().radiance)

    def test_a_light_that_the_record_lacks(self, tiny_capture):
        record = tiny_capture.select(split="test")[0]
        with pytest.raises(MissingFileError, match=r"light must be one that test_00_0000 is known under \(none\), got"):
            record.relit("noon")
