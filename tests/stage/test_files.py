"""Files of stages: what they say, what decides their images, and every mistake in them."""

import copy
import json
import os
import shutil

import numpy as np
import pytest
import trimesh
from support.small_stages import STILL, asset, cloud, moving, read, sequence, stage

from beam_warp import converters
from beam_warp.errors import AssetFormatError, MissingFileError, SchemaVersionError
from beam_warp.image.files import write_exr
from beam_warp.mesh.files import write_mesh
from beam_warp.stage.camera_paths import KeyframePath
from beam_warp.stage.environments import StageEnvironment
from beam_warp.stage.stage import Stage
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.lights import PointLight

RELIGHTABLE = converters.WriteOptions(profile="beam")


@pytest.fixture
def folder(tmp_path):
    """Two assets, a light map, a mesh and camera key frames."""
    converters.write(sequence(cloud([(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)])), tmp_path / "still.ply", RELIGHTABLE)
    (tmp_path / "walk").mkdir()
    converters.write(moving(3, ids=None), tmp_path / "walk" / "walk.ply", RELIGHTABLE)
    write_exr(tmp_path / "sky.exr", {name: np.full((4, 8), 0.5, np.float32) for name in "RGB"})
    write_mesh(trimesh.creation.box((1, 1, 1)), tmp_path / "box.ply")
    keys = [{"time": t, "position": [0, -4 - t, 1], "target": [0, 0, 1]} for t in (0, 1)]
    (tmp_path / "keys.json").write_text(json.dumps({"keyframes": keys}))
    lights = [{"type": "directional", "direction": [0, 0, -1], "irradiance": [1, 1, 1]}]
    (tmp_path / "lights.json").write_text(json.dumps(lights))
    return tmp_path


FULL = {
    "beam-stage": 1,
    "fps": 20,
    "duration": 1.5,
    "assets": [
        {"path": "still.ply", "name": "statue", "translate": [1, 2, 3], "rotate": [10, 20, 30], "scale": 0.5},
        {"path": "walk", "start": 0.25, "speed": 2, "loop": True, "blend": "rows", "on_ground": True, "centered": True},
    ],
    "meshes": [{"ground": True, "size": 8, "height": "auto", "catches_shadows": True}, {"path": "box.ply"}],
    "lights": [{"type": "point", "position": [1, -2, 2], "intensity": [4, 4, 4], "radius": 0.1}],
    "environment": {"path": "sky.exr", "rotate": 30, "degrees_per_second": 10, "exposure": 1},
    "camera": {"type": "orbit", "turns": 1, "elevation": 10, "fov": 30},
}


class TestFile:
    def test_everything_is_as_it_says(self, folder):
        scene = read(folder, FULL)
        assert (scene.rate, scene.seconds, scene.frame_count) == (20.0, 1.5, 30)
        statue, walk = scene.assets
        assert (statue.name, statue.translate, statue.rotate, statue.scale) == ("statue", (1, 2, 3), (10, 20, 30), 0.5)
        assert (walk.name, walk.start, walk.speed, walk.loop, walk.blend) == ("walk", 0.25, 2.0, True, "rows")
        assert (walk.on_ground, walk.centered) == (True, True)
        assert scene.lights == (PointLight(position=(1, -2, 2), intensity=(4, 4, 4), radius=0.1),)
        shot = scene.shot(0.75, 16, 12)
        np.testing.assert_array_equal(shot.environment.radiance, np.ones((4, 8, 3), np.float32))
        assert shot.environment_rotation == 37.5
        assert shot.mesh.catches_shadows.tolist() == [True, True, *([False] * 12)]
        assert scene.camera.degrees_per_second == 240.0
        assert len(shot.cloud) == 3

    def test_a_stage_made_without_a_file_is_the_same(self, folder):
        content = {"assets": ["still.ply", "walk"], "environment": "sky.exr", "camera": "keys.json"}
        scene = read(folder, content)
        light = StageEnvironment(map=EnvironmentMap.read(folder / "sky.exr"))
        made = Stage.of([folder / "still.ply", folder / "walk"], environment=light, camera=scene.camera)
        assert made.digest() == scene.digest()
        assert made.digest(0.1) == scene.digest(0.1)
        assert isinstance(scene.camera, KeyframePath)

    def test_a_row_of_assets(self, folder):
        scene = Stage.of([folder / "still.ply"] * 3, spacing=2.0, on_ground=True)
        got = scene.shot(0.0, 8, 6).cloud.positions
        np.testing.assert_allclose(got[:, 0], [-2, -2, 0, 0, 2, 2], atol=1e-6)
        np.testing.assert_allclose(got[:, 2], [0, 1, 0, 1, 0, 1], atol=1e-6)

    def test_texts_stand_for_paths(self, folder):
        scene = read(folder, {"assets": ["still.ply"], "lights": "lights.json", "camera": "keys.json"})
        assert len(scene.lights) == 1
        assert scene.seconds == 1.0
        np.testing.assert_allclose(scene.shot(1.0, 8, 6).camera.position, [0.0, -5.0, 1.0])

    def test_light_from_all_around_without_a_file(self, folder):
        shot = read(folder, {"assets": ["still.ply"], "environment": {"radiance": [1, 2, 3]}}).shot(0, 8, 6)
        np.testing.assert_array_equal(shot.environment.radiance[0, 0], [1, 2, 3])

    def test_fixed_cameras(self, folder):
        expected = Camera.look_at((0, -3, 1), (0, 0, 1), width=64, height=48, vertical_fov=50.0)
        by_place = {"type": "fixed", "position": [0, -3, 1], "target": [0, 0, 1], "fov": 50}
        by_pose = {"type": "fixed", "camera_to_world": expected.camera_to_world.tolist(), "fov": 50}
        for record in (by_place, by_pose):
            got = read(folder, {"camera": record}).shot(3.0, 64, 48).camera
            np.testing.assert_allclose(got.camera_to_world, expected.camera_to_world, atol=1e-15)
            assert got.focal_y == pytest.approx(expected.focal_y, rel=1e-14)


class TestDigest:
    def test_it_is_the_same_in_another_place(self, folder, tmp_path_factory):
        other = tmp_path_factory.mktemp("copy") / "stage"
        shutil.copytree(folder, other)
        first, second = read(folder, FULL), read(other, FULL)
        assert first.digest() == second.digest()
        assert first.digest(0.2) == second.digest(0.2)
        assert first.digest(0.2) != first.digest(0.25)

    @pytest.mark.parametrize(
        "change",
        [
            {"assets": FULL["assets"][:1]},
            {"assets": FULL["assets"][::-1]},
            {"assets": [{**FULL["assets"][0], "translate": [1, 2, 4]}, FULL["assets"][1]]},
            {"assets": [FULL["assets"][0], {**FULL["assets"][1], "start": 0}]},
            {"meshes": []},
            {"meshes": [{**FULL["meshes"][0], "catches_shadows": False}, FULL["meshes"][1]]},
            {"lights": []},
            {"environment": {**FULL["environment"], "exposure": 2}},
            {"environment": {**FULL["environment"], "rotate": 31}},
            {"camera": {**FULL["camera"], "fov": 31}},
        ],
    )
    def test_any_change_shows(self, folder, change):
        assert read(folder, FULL | change).digest(0.2) != read(folder, FULL).digest(0.2)

    def test_a_changed_file_shows_where_it_matters(self, folder):
        content = FULL | {"assets": [{"path": "walk"}], "meshes": []}
        camera = {"camera": {"type": "orbit", "center": [0, 0, 0], "distance": 3}}
        scene = read(folder, content | camera)
        before = {time: scene.digest(time) for time in (None, 0.0, 0.05, 0.1, 0.2)}
        path = sorted((folder / "walk").iterdir())[0]
        status, data = path.stat(), bytearray(path.read_bytes())
        data[-1] ^= 1
        path.write_bytes(data)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))  # size and time say nothing
        after = {time: scene.digest(time) for time in before}
        assert [after[time] != before[time] for time in before] == [True, True, True, False, False]

    def test_clouds_in_memory(self):
        def scene(place):
            return stage(asset(sequence(cloud(), cloud([(place, 0.0, 0.0)]))))

        assert scene(1.0).digest() == scene(1.0).digest()
        assert scene(1.0).digest() != scene(2.0).digest()
        assert scene(1.0).digest(0.0) == scene(2.0).digest(0.0)
        assert scene(1.0).digest(0.05) != scene(2.0).digest(0.05)

    def test_layers_of_a_usd_asset_count(self, tmp_path):
        converters.write(moving(2, axes="rub"), tmp_path / "a.usda")
        scene = Stage.of([tmp_path / "a.usda"], camera=STILL)
        before = scene.digest(), scene.digest(0.1)
        layer = tmp_path / "a.frames.usdc"
        data = bytearray(layer.read_bytes())
        data[-1] ^= 1
        layer.write_bytes(data)
        assert scene.digest() != before[0]
        assert scene.digest(0.1) != before[1]
        layer.write_bytes(bytes(data[:-1]) + bytes([data[-1] ^ 1]))
        assert (scene.digest(), scene.digest(0.1)) == before
        root = tmp_path / "a.usda"
        root.write_text(root.read_text() + "# seen\n")
        assert scene.digest(0.1) != before[1]

    def test_a_file_that_is_gone(self, folder):
        scene = read(folder, FULL)
        (folder / "still.ply").unlink()
        with pytest.raises(MissingFileError, match=r"input must be readable, got .*still\.ply"):
            scene.digest(0.0)


KEYS_OF_NO_PLACE = {"type": "keyframes", "keyframes": [{"time": 0, "position": [0, 0], "target": [0, 1, 0]}]}
LOOKS_NOWHERE = {"type": "fixed", "position": [0, 0, 0], "target": [0, 0, 0]}


def changed(place, value):
    """The full stage with one field changed; ``...`` removes it."""
    content = copy.deepcopy(FULL)
    target = content
    for step in place[:-1]:
        target = target[step]
    if value is ...:
        del target[place[-1]]
    else:
        target[place[-1]] = value
    return content


class TestMistakes:
    @pytest.mark.parametrize(
        ("place", "value", "message"),
        [
            (("beam-stage",), ..., "beam-stage must be 1, got nothing. State the version"),
            (("beam-stage",), True, "beam-stage must be 1, got true."),
            (("asets",), [], "must have no field but beam-stage, fps, duration, assets,"),
            (("fps",), "30", "fps must be a finite number, got '30'. Write one."),
            (("fps",), -3, "fps must be a number in [0.001, 1e+06], got -3.0."),
            (("duration",), 0, "duration must be a number in [1e-06, 1e+09], got 0.0."),
            (("assets",), {}, "assets must be a list, got {}. Put it in [ ]."),
            (("assets", 1), 5, "assets[1] must be an object, got 5. Write it in { }."),
            (("assets", 1, "path"), 3, "assets[1].path must be a text, got 3. Write it in quotes."),
            (("assets", 1, "translat"), 3, "assets[1] must have no field but path, name,"),
            (("assets", 1, "translate"), [1, 2, "3"], "assets[1].translate must be 3 finite numbers, got [1,"),
            (("assets", 1, "rotate"), [1, 2], "assets[1].rotate must be 3 finite numbers, got [1, 2]."),
            (("assets", 1, "rotate"), "90", "assets[1].rotate must be a finite number, got '90'."),
            (("assets", 1, "scale"), -1, "assets[1].scale must be a number in [1e-06, 1e+06], got -1.0."),
            (("assets", 1, "speed"), 0, "assets[1].speed must be a number in [0.001, 1000], got 0.0."),
            (("assets", 1, "loop"), "yes", "assets[1].loop must be true or false, got 'yes'."),
            (("assets", 1, "blend"), "x", "assets[1].blend must be one of identified, rows, nearest, got 'x'."),
            (("assets", 0, "source_axes"), "xyz", "assets[0].source_axes must be three letters, one each of"),
            (("assets", 0, "path"), "box.ply", "assets[0]: "),
            (("assets", 0, "path"), "sky.exr", "assets[0]: file name must end in one of .ply, "),
            (("meshes", 1, "path"), "sky.exr", "meshes[1]: mesh must be readable, got"),
            (("meshes", 1, "base_color"), [1, 2, 3], "meshes[1].base_color must lie in [0, 1], got 2"),
            (("meshes", 1, "roughness"), 2, "meshes[1].roughness must be a number in [0, 1], got 2.0."),
            (("meshes", 1, "scale"), 0, "meshes[1].scale must be a number in [1e-06, 1e+06], got 0.0."),
            (("meshes", 1, "smooth"), 1, "meshes[1].smooth must be true or false, got 1."),
            (("meshes", 0, "ground"), False, "meshes[0].ground must be true, got false."),
            (("meshes", 0, "height"), "low", "meshes[0].height must be a finite number, got 'low'."),
            (("meshes", 0, "size"), 0, "meshes[0].size must be a number in [0.001, 1e+06], got 0.0."),
            (("meshes", 0, "center"), [1], "meshes[0].center must be 2 finite numbers, got [1]."),
            (("meshes", 0, "path"), "a.ply", "meshes[0] must have no field but ground, size, height, center,"),
            (("lights", 0, "type"), "lamp", "lights[0].type must be one of directional, point, spot,"),
            (("lights", 0, "radius"), -1, "lights[0]: radius must be a number in"),
            (("lights",), 3, "lights must be a list of lights, got int."),
            (("lights",), "keys.json", "lights: keys.json: lights must be a list of lights, got dict."),
            (("environment", "path"), ..., "environment must have a path or a radiance, got neither."),
            (("environment", "radiance"), [1, 1, 1], "environment must have a path or a radiance, got both."),
            (("environment", "path"), "box.ply", "environment: environment must be an .exr or .hdr file"),
            (("environment", "rotate"), None, ""),
            (("environment", "exposure"), 99, "environment.exposure must be a number in [-64, 64], got 99.0."),
            (("camera", "type"), ..., "camera.type must be one of fixed, orbit, keyframes, file, got null."),
            (("camera",), 3, "camera must be an object, got 3."),
            (("camera", "fov"), 0, "camera.fov must be a number in [0.01, 179], got 0.0."),
            (("camera", "subject"), [], "camera must have no field but type, center, distance, azimuth,"),
            (("camera", "degrees_per_second"), 3, "camera.turns must be left out beside degrees_per_second"),
            (("camera",), {"type": "keyframes"}, "camera.keyframes must be a list of 1 to 1000000 key frames,"),
            (("camera",), KEYS_OF_NO_PLACE, "camera.keyframes[0].position must be 3 finite numbers, got [0, 0]."),
            (("camera",), LOOKS_NOWHERE, "camera.target must differ from eye, got [0.0, 0.0, 0.0] for both."),
            (("camera",), "lights.json", "camera: lights.json: keyframes[0] must have no field but time,"),
            (("camera",), {"type": "file", "path": "keys.json", "prim": "/C"}, "camera.prim must be left out"),
        ],
    )
    def test_one_clear_error(self, folder, place, value, message):
        if not message:  # null is as if it were not there
            assert read(folder, changed(place, value)).environment.rotate == 0.0
            return
        with pytest.raises(AssetFormatError) as caught:
            read(folder, changed(place, value), version=False)
        assert str(caught.value).startswith(f"stage.json: {message}")
        assert str(caught.value).endswith(".")

    @pytest.mark.parametrize(
        ("place", "what"),
        [
            (("assets", 0, "path"), "assets[0].path must be an existing file or folder"),
            (("meshes", 1, "path"), "meshes[1].path must be an existing file"),
            (("environment", "path"), "environment.path must be an existing file"),
            (("lights",), "lights must be an existing file"),
            (("camera",), "camera.path must be an existing file"),
        ],
    )
    def test_missing_files(self, folder, place, what):
        with pytest.raises(MissingFileError) as caught:
            read(folder, changed(place, "none.json"))
        assert str(caught.value) == (
            f"stage.json: {what}, got 'none.json' (looked for {folder / 'none.json'}). Correct the name; relative "
            "ones start where this file is."
        )

    def test_a_later_version(self, folder):
        with pytest.raises(SchemaVersionError, match=r"stage.json: beam-stage must be 1, got 2\. Upgrade"):
            read(folder, changed(("beam-stage",), 2), version=False)

    def test_no_file_and_no_json(self, tmp_path):
        with pytest.raises(MissingFileError, match="stage must be a readable file, got"):
            Stage.read(tmp_path / "none.json")
        for content, message in (
            (b"{", "stage must be JSON in UTF-8, got Expecting"),
            (b"\xff\xfe", "stage must be JSON in UTF-8, got"),
            (b"[1]", r"a.json: must be an object, got \[1\]"),
        ):
            (tmp_path / "a.json").write_bytes(content)
            with pytest.raises(AssetFormatError, match=message):
                Stage.read(tmp_path / "a.json")
