"""The viewer over the wire: who is let in, what a take and its stills are, and what goes wrong while it is served."""

import base64
import json
import shutil
import socket
import subprocess
import threading
import urllib.error
import urllib.request
import zlib
from contextlib import closing, contextmanager
from dataclasses import replace
from email.message import Message
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.drawn_ball import drawn_ball, judged_ball

from beam_warp import converters
from beam_warp.converters.delivery import writer
from beam_warp.errors import AssetFormatError, DeviceError, InvalidOptionError
from beam_warp.image.files import read_image
from beam_warp.image.tone import display_over
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.stage.meshes import Ground
from beam_warp.view.admission import Doorkeeper
from beam_warp.view.server import MAX_MESSAGE
from beam_warp.view.takes import AHEAD, SEGMENT_FRAMES, MadeAhead
from beam_warp.view.viewer import Viewer, ViewOptions
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import PointLight, lights_to_json
from beam_warp.world.shot import Shot

NODE = shutil.which("node")
WEB = Path(__file__).parents[2] / "engines" / "web"
FRAMES = SEGMENT_FRAMES + 2
LIGHTS = {"white": lambda: EnvironmentMap.constant([1.0, 1.0, 1.0], height=4)}
CAMERA = Camera.orbit((0, 0, 0), 3.0, 30.0, 20.0, width=24, height=20, vertical_fov=25.0)
LAMP = PointLight(position=(1, -2, 2), intensity=(4, 4, 4), radius=0.1)


def ball(frame, count=400):
    return drawn_ball(center=(0.02 * frame, 0, 0), count=count).with_arrays(
        ids=np.arange(count), scales=np.tile([0.06, 0.06, 1e-3], (count, 1))
    )


def moving(frame_count=FRAMES):
    return GaussianSequence.from_clouds([ball(frame) for frame in range(frame_count)], frames_per_second=10.0)


@contextmanager
def served(sequence, **parts):
    viewer = Viewer(sequence, LIGHTS, options=ViewOptions(port=0, device="cpu"), **parts)
    try:
        yield viewer
    finally:
        viewer.close()


@pytest.fixture(scope="module")
def viewer():
    grounds = {"grey": lambda: Ground(size=8.0).mesh(ball(0).positions)}
    with served(moving(), title="<b>ball", grounds=grounds) as found:
        yield found


def ask(viewer, name="", data=None, **headers):
    """Status, content and headers of an answer; a name that begins with a slash stands for the whole path."""
    root = viewer.url.rpartition("/")[0].rpartition("/")[0]
    request = urllib.request.Request(root + name if name.startswith("/") else viewer.url + name, data, headers)
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.read(), answer.headers
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers


def settings_of(viewer):
    return json.loads(ask(viewer)[1].decode().partition('id="settings">')[2].partition("</script>")[0])


def asked(**changes):
    """What the page asks for."""
    place = {
        "position": CAMERA.position.tolist(),
        "worldToCamera": CAMERA.world_to_camera[:3, :3].ravel().tolist(),
        "focal": [CAMERA.focal_x, CAMERA.focal_y],
        "center": [CAMERA.center_x, CAMERA.center_y],
        "width": CAMERA.width,
        "height": CAMERA.height,
    }
    wanted = {"kind": "path traced", "frame": 1, "camera": place, "environment": "white", "rotation": 0.0}
    wanted |= {"lights": lights_to_json([LAMP]), "ground": "none", "samples": 3, "exposure": 0.0}
    return wanted | {"transform": "standard", "background": "#212121"} | changes


def post(viewer, message):
    status, content, _ = ask(viewer, "stills", data=json.dumps(message).encode())
    assert status == 200
    return [json.loads(line) for line in content.splitlines()]


def still(viewer, **changes):
    return post(viewer, asked(**changes))


def pixels(png):
    return np.asarray(Image.open(BytesIO(base64.b64decode(png))))


# ---- Who is let in


def test_the_page_is_behind_its_token_and_tells_nobody(viewer):
    token = viewer.url.split("/")[3]
    assert len(token) >= 32
    status, page, headers = ask(viewer)
    assert status == 200
    assert b"<title>&lt;b&gt;ball</title>" in page
    assert (headers["Referrer-Policy"], headers["X-Frame-Options"]) == ("same-origin", "DENY")
    assert headers["Access-Control-Allow-Origin"] is None
    for path in ("/", f"/{token}", f"/{token[:-1]}/", f"/?token={token}", "/%ff/"):
        status, words, _ = ask(viewer, path)
        assert (status, words[:16]) == (403, b"Open the address"), path
    assert ask(viewer, "nothing")[0] == ask(viewer, "../view/server.py")[0] == 404


HOSTS = {"evil.example": 403, "127.0.0.1.evil.example": 403, "[": 403, "192.0.2.1": 403, "evil@": 403}
HOSTS |= {"localhost:8080": 200, "127.0.0.1:9": 200, "[::1]:8080": 200}


@pytest.mark.parametrize("host", HOSTS)
def test_only_names_of_this_machine_are_answered(viewer, host):
    assert ask(viewer, "manifest.json", Host=host)[0] == HOSTS[host]


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
def test_a_page_of_another_origin_is_refused_even_with_the_token(viewer, origin):
    assert ask(viewer, "manifest.json", Origin=origin)[0] == 403
    assert ask(viewer, "stills", data=b"{}", Origin=origin)[0] == 403
    own = viewer.url.rpartition("/")[0].rpartition("/")[0]
    assert ask(viewer, "manifest.json", Origin=own)[0] == 200


def test_an_open_address_is_reached_by_its_numbers():
    for host, wanted in (("192.0.2.7:8080", ""), ("[2001:db8::1]:8080", ""), ("evil.example", None)):
        headers = Message()
        headers["Host"] = host
        assert Doorkeeper("0.0.0.0", "t").admitted("/t/", headers) == wanted
        assert Doorkeeper("127.0.0.1", "t").admitted("/t/", headers) is None


@pytest.mark.parametrize(
    ("name", "data", "headers", "status"),
    [
        ("stills", b"x" * (MAX_MESSAGE + 1), {}, 413),
        ("stills", b"[" * 100_000, {}, 400),
        ("stills", b"\xff", {}, 400),
        ("stills", b"1", {"Content-Length": "-1"}, 413),
        ("manifest.json", b"{}", {}, 404),
    ],
    ids=["large", "deep", "no text", "no length", "no place for it"],
)
def test_messages_that_are_none(viewer, name, data, headers, status):
    assert ask(viewer, name, data=data, **headers)[0] == status


def test_it_serves_where_it_is_told_or_not_at_all():
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        for options, says in (
            ({"port": port}, rf"port must be free at 127\.0\.0\.1, got {port} .* --port"),
            ({"port": 0, "host": "203.0.113.7"}, "port must be free at 203"),
            ({"port": 0, "host": "no such host"}, "host must be an address"),
            ({"port": 70_000}, "port must be an integer"),
        ):
            with pytest.raises(InvalidOptionError, match=says):
                Viewer(moving(1), LIGHTS, options=ViewOptions(**options))
    with pytest.raises(DeviceError):
        Viewer(moving(1), LIGHTS, options=ViewOptions(port=0, device="cuda:99"))


# ---- The take


def test_segments_made_on_demand_are_those_of_the_container(viewer, tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "SEGMENT_FRAMES", SEGMENT_FRAMES)
    converters.write(moving(), tmp_path / "manifest.json")
    written = json.loads((tmp_path / "manifest.json").read_text())
    live = json.loads(ask(viewer, "manifest.json")[1])
    blocks = zip([live["static"], *live["segments"]], [written["static"], *written["segments"]], strict=True)
    for of_live, of_file in blocks:
        if "described" in of_live:
            of_live |= json.loads(ask(viewer, of_live.pop("described"))[1])
        content = ask(viewer, of_live["file"])[1]
        assert len(content) == of_live["bytes"]
        assert zlib.decompress(content) == zlib.decompress((tmp_path / of_file["file"]).read_bytes())
        for packed in ("bytes", "parts", "sha256", "offset"):
            del of_live[packed], of_file[packed]
    assert live == written
    for name in ("000001.bin", "000000.txt", "999999.json", "take.b4d"):
        assert ask(viewer, name)[0] == 404


@pytest.mark.skipif(NODE is None, reason="there is no node")
def test_a_player_reads_it_over_the_wire(viewer):
    script = f"""
        import {{openLive}} from {json.dumps((WEB / "live.js").as_uri())};
        const take = await openLive({json.dumps(viewer.url + "manifest.json")});
        const {{positions}} = await take.frame({FRAMES - 1});
        console.log(JSON.stringify([take.manifest.count, positions.subarray(0, 400).reduce((a, b) => a + b) / 400]));"""
    done = subprocess.run(
        [NODE, "--input-type=module", "-e", script], capture_output=True, text=True, timeout=60, check=True
    )
    count, middle = json.loads(done.stdout)
    assert count == 400
    assert middle == pytest.approx(ball(FRAMES - 1).positions[:, 0].mean(), abs=0.01)


def test_a_file_is_read_in_ranges_and_may_be_lost(tmp_path):
    path = tmp_path / "ball.b4d"
    converters.write(moving(2), path)
    content = path.read_bytes()
    with served(converters.read(path), file=path) as viewer:
        assert ask(viewer, "take.b4d")[1] == content
        status, part, headers = ask(viewer, "take.b4d", Range="bytes=10-19")
        assert (status, part) == (206, content[10:20])
        assert headers["Content-Range"] == f"bytes 10-19/{len(content)}"
        assert ask(viewer, "take.b4d", Range=f"bytes={len(content) - 3}-{10**15}")[1] == content[-3:]
        assert ask(viewer, "take.b4d", Range=f"bytes={len(content)}-")[0] == 416
        assert ask(viewer, "take.b4d", Range="bytes=9-8")[0] == 416
        assert ask(viewer, "take.b4d", Range="bytes=-5, 7-8")[:2] == (200, content)
        path.unlink()
        status, words, _ = ask(viewer, "take.b4d", Range="bytes=0-9")
        assert status == 500
        assert b"ball.b4d" in words


def test_frames_with_nothing_in_common_are_takes_of_their_own(tmp_path):
    clouds = [ball(0, 300), ball(1, 200)]
    with served(GaussianSequence.from_clouds(clouds, frames_per_second=7.0)) as viewer:
        assert settings_of(viewer)["take"] == {"url": "frames/0.b4d", "frames": 2, "rate": 7.0}
        for frame, cloud in enumerate(clouds):
            (tmp_path / "frame.b4d").write_bytes(ask(viewer, f"frames/{frame}.b4d")[1])
            back = converters.read(tmp_path / "frame.b4d")[0]
            assert len(back) == len(cloud)
            middle = cloud.positions.mean(axis=0)  # of axes rfu; those of the container are rub
            np.testing.assert_allclose(back.positions.mean(axis=0), middle[[0, 2, 1]] * [1, 1, -1], atol=0.01)
        assert ask(viewer, "frames/2.b4d")[0] == 404


def test_an_asset_that_changes_while_it_is_served_says_so_and_may_come_back():
    clouds = {frame: ball(frame) for frame in range(FRAMES)}
    clouds[SEGMENT_FRAMES] = ball(0, count=399)

    def read(frame):
        if frame not in clouds:
            raise AssetFormatError(f"frame {frame} must be readable, got a file that is gone. Put it back.")
        return clouds[frame]

    name = f"{SEGMENT_FRAMES:06d}.json"
    with served(replace(moving(), read_frame=read)) as viewer:
        status, words, _ = ask(viewer, name)
        assert (status, b"399" in words) == (500, True)
        del clouds[SEGMENT_FRAMES]
        assert b"Put it back" in ask(viewer, name)[1]
        clouds[SEGMENT_FRAMES] = ball(SEGMENT_FRAMES)
        assert ask(viewer, name)[0] == 200


def test_the_newest_wish_comes_first_and_the_next_ones_are_foreseen():
    order, gate = [], threading.Event()

    def make(number):
        gate.wait(20.0)
        order.append(number)
        if number == 5:
            raise OSError("no fifth")
        return number

    with closing(MadeAhead(40, make, lambda _: 1)) as made:
        wishes = [threading.Thread(target=made.__getitem__, args=(number,)) for number in (20, 30)]
        for number, wish in zip((20, 30), wishes, strict=True):
            wish.start()
            while number not in made._wanted:
                pass
        gate.set()
        for wish in wishes:
            wish.join(20.0)
        assert order[:3] == [0, 30, 20]  # the first one was begun at once
        assert made[30 + AHEAD] == 30 + AHEAD
        for _ in range(2):
            with pytest.raises(OSError, match="no fifth"):
                made[5]
        assert order.count(5) == 2


def test_lights_are_pictures_that_are_made_when_they_are_chosen(viewer, tmp_path):
    (tmp_path / "light.hdr").write_bytes(ask(viewer, "environments/0.hdr")[1])
    np.testing.assert_allclose(read_image(tmp_path / "light.hdr").rgb(), 1.0, rtol=1e-2)
    assert ask(viewer, "environments/1.hdr")[0] == 404


# ---- Stills


def test_a_still_is_the_path_tracers_image_and_comes_step_by_step(viewer, tmp_path):
    lines = still(viewer)
    assert [line["samples"] for line in lines] == sorted({line["samples"] for line in lines})
    assert lines[-1]["samples"] == lines[-1]["of"] == 3
    assert all("exr" not in line for line in lines[:-1])
    shot = Shot(cloud=ball(1), camera=CAMERA, environment=LIGHTS["white"](), lights=(LAMP,))
    image = PathRenderer(PathOptions(samples=3), device="cpu").draw(shot)
    assert image.alpha.mean() > 0.1
    shown = display_over(image.rgb, image.alpha, background=np.full(3, 33 / 255.0))
    np.testing.assert_allclose(pixels(lines[-1]["png"]).astype(int), shown, atol=1)
    (tmp_path / "still.exr").write_bytes(ask(viewer, lines[-1]["exr"])[1])
    kept = read_image(tmp_path / "still.exr")
    np.testing.assert_allclose(kept.alpha, image.alpha, atol=1e-6)
    np.testing.assert_allclose(kept.rgb(), image.rgb, atol=1e-5)
    still(viewer, samples=1)
    assert ask(viewer, lines[-1]["exr"])[0] == 404


def test_a_still_may_stand_on_a_ground_before_its_environment(viewer):
    low = Camera.look_at((0, -3, 1), (0, 0, 0), width=16, height=12, vertical_fov=60.0)
    place = asked()["camera"] | {"position": low.position.tolist(), "focal": [low.focal_x] * 2, "center": [8, 6]}
    place |= {"worldToCamera": low.world_to_camera[:3, :3].ravel().tolist(), "width": 16, "height": 12}
    bare, behind, standing = (
        pixels(still(viewer, camera=place, samples=1, **changes)[-1]["png"])
        for changes in ({}, {"background": "environment"}, {"ground": "grey"})
    )
    assert (bare[[0, -1], 0] == 33).all()
    assert (behind[[0, -1], 0] == 255).all()
    assert (standing[-1, 8] > 60).all()


def test_channels_that_a_container_lacks_are_stills():
    with served(GaussianSequence.from_clouds([judged_ball()])) as viewer:
        kinds = list(settings_of(viewer)["stills"]["kinds"])
        assert kinds == [
            *("base_color_error", "roughness_error", "ambient_occlusion_error", "observability", "surface_normals")
        ]
        for kind in kinds:
            (line,) = still(viewer, kind=kind, frame=0)
            assert pixels(line["png"]).shape == (20, 24, 3)
            assert ("legend" in line) is (kind != "surface_normals")
        assert "must be one of" in still(viewer, frame=0)[0]["error"]


WRONG = {
    "kind": "magic",
    "frame": FRAMES,
    "environment": "nowhere.hdr",
    "rotation": float("nan"),
    "ground": "sea",
    "lights": [{"type": "area"}],
    "samples": 0,
    "exposure": "bright",
    "transform": "filmic",
    "background": "#xyz",
}
WRONG_CAMERA = {"width": 10**9, "position": [0, None, 0], "worldToCamera": [1.0] * 9, "focal": []}


@pytest.mark.parametrize("name", [*WRONG, *WRONG_CAMERA])
def test_a_still_that_cannot_be_is_one_sentence(viewer, name):
    wanted = asked()
    (wanted if name in WRONG else wanted["camera"])[name] = (WRONG | WRONG_CAMERA)[name]
    (line,) = post(viewer, wanted)
    assert set(line) == {"error"}
    assert " must " in line["error"]
    assert "\n" not in line["error"]


@pytest.mark.parametrize("message", [None, [], {}, 3, {"kind": "path traced"}])
def test_a_message_of_nothing_is_one_sentence(viewer, message):
    (line,) = post(viewer, message)
    assert line["error"].startswith("a still must be asked for as the page does")


def test_who_stops_listening_ends_the_work(viewer):
    """The tracer is free for others soon after a page has gone."""
    data = json.dumps(asked(samples=60_000)).encode()
    with urllib.request.urlopen(urllib.request.Request(viewer.url + "stills", data), timeout=60) as answer:
        assert json.loads(answer.readline())["of"] == 60_000
    assert still(viewer, samples=1)[-1]["samples"] == 1
