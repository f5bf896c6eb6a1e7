"""The player page as a file: it holds everything that it needs, appears whole or not at all, and no text breaks it."""

import base64
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from support.drawn_ball import relightable
from support.small_stages import cloud

from beam_warp import converters
from beam_warp.cli.convert import main
from beam_warp.converters.player import ENVIRONMENT_ROWS, MODULES, SERVED, modules
from beam_warp.image.files import read_image, write_exr
from beam_warp.image.hdr import radiance_hdr
from beam_warp.stage.discs import SPREAD, discs_of
from beam_warp.stage.meshes import Ground
from beam_warp.world.gaussians import GaussianSequence

pytestmark = pytest.mark.usefixtures("coarse_irradiance", "trusted_files")

CORNERS = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 2.0)])


class Elements(HTMLParser):
    """Elements of a page by their id or type, with their text, and every address that a browser would load."""

    def __init__(self, text):
        super().__init__()
        self.texts, self.addresses, self._open = {}, [], None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self._open = given.get("id") or given.get("type") or tag
        self.addresses += [given[name] for name in ("src", "href") if name in given]

    def handle_data(self, data):
        self.texts[self._open] = self.texts.get(self._open, "") + data


@pytest.fixture
def take(tmp_path):
    clouds = [relightable(CORNERS + 0.1 * frame, scales=np.full((8, 3), 0.1)) for frame in range(3)]
    converters.write(GaussianSequence.from_clouds(clouds, frames_per_second=10.0), tmp_path / "take.b4d")
    return tmp_path / "take.b4d"


@pytest.fixture
def light(tmp_path):
    write_exr(tmp_path / "<!--<b>.exr", {name: np.full((256, 512), 2.0, np.float32) for name in "RGB"})
    return tmp_path / "<!--<b>.exr"


def publish(*words):
    return main([str(word) for word in (*words, "--player", "--quiet")])


def page_of(path):
    elements = Elements(path.read_text(encoding="utf-8"))
    return elements, json.loads(elements.texts["settings"])


def test_a_page_holds_all_that_it_needs(take, light, tmp_path):
    assert publish(take, tmp_path / "page.html", "--environment", light) == 0
    elements, settings = page_of(tmp_path / "page.html")
    assert elements.addresses == ["data:,"]
    assert base64.b64decode(re.sub(r"\s", "", elements.texts["take"]), validate=True) == take.read_bytes()
    names = [each["name"] for each in settings["environments"]]
    assert names == ["<!--<b>", "studio (built in)", "sunset (built in)", "stage (built in)"]
    (tmp_path / "back.hdr").write_bytes(base64.b64decode(settings["environments"][0]["hdr"]))
    back = read_image(tmp_path / "back.hdr").rgb()
    assert back.shape == (ENVIRONMENT_ROWS, 2 * ENVIRONMENT_ROWS, 3)
    np.testing.assert_array_equal(back, 2.0)
    assert settings["take"] == {"element": "take"}
    assert settings["title"] == elements.texts["title"].strip() == "take"


def test_every_module_is_there_and_found_by_name(take, tmp_path):
    publish(take, tmp_path / "page.html")
    imports = json.loads(page_of(tmp_path / "page.html")[0].texts["importmap"])["imports"]
    texts = {name: base64.b64decode(address.partition(",")[2]).decode() for name, address in imports.items()}
    wanted = [re.findall(r'^import .*?"([^"]+)";', text, re.MULTILINE) for text in texts.values()]
    assert {name for names in wanted for name in names} <= set(texts)
    assert {f"{MODULES}/{name}" for name in ("player.js", "b4d.js", "relight.js")} <= set(texts)
    assert set(modules()) == {name.removeprefix(f"{MODULES}/") for name in texts}
    assert set(modules(SERVED)) - set(modules()) == {"live.js", "stills.js"}, "what only a server's page needs"


def test_a_take_lies_beside_its_page(take, tmp_path):
    assert publish(take, tmp_path / "out" / "page.html", "--beside") == 0
    elements, settings = page_of(tmp_path / "out" / "page.html")
    assert settings["take"] == {"url": "page.b4d"}
    assert "take" not in elements.texts
    assert (tmp_path / "out" / "page.b4d").read_bytes() == take.read_bytes()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["page.htm"], r"output's name must end in \.html for --player, got page\.htm"),
        (["page.html", "--environment", "nowhere.hdr"], r"environment must be a file or a folder, got nowhere\.hdr"),
        (["no/page.html", "--sh-degree", "9"], "must"),
    ],
)
def test_mistakes_are_one_line_and_leave_no_page(take, tmp_path, monkeypatch, capsys, words, says):
    monkeypatch.chdir(tmp_path)
    converters.write(converters.read(take), tmp_path / "take.usda")
    before = sorted(tmp_path.rglob("*"))
    assert publish("take.usda", *words) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.search(says, line)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_damaged_take_leaves_the_old_page(take, tmp_path, capsys):
    (tmp_path / "page.html").write_text("old")
    take.write_bytes(take.read_bytes()[:200])
    assert publish(take, tmp_path / "page.html") == 2
    assert "take.b4d" in capsys.readouterr().err
    assert (tmp_path / "page.html").read_text() == "old"


def test_pictures_of_light_are_as_exact_as_they_say(tmp_path):
    light = (
        np.random.default_rng(5).gamma(0.3, size=(16, 32, 3)).astype(np.float32)
        * 10.0 ** np.arange(-8, 8)[:, None, None]
    )
    light[0, 0] = 0.0
    (tmp_path / "light.hdr").write_bytes(radiance_hdr(light))
    back = read_image(tmp_path / "light.hdr").rgb()
    assert (np.abs(back - light) <= light.max(axis=2, keepdims=True) / 256.0).all()


def test_a_ground_becomes_discs_that_cover_it():
    mesh = Ground(size=4.0, height=0.5, base_color=(0.1, 0.2, 0.3)).mesh(np.zeros((1, 3)))
    discs = discs_of(mesh, count=800)
    assert len(discs) == 800
    np.testing.assert_allclose(discs.positions.mean(axis=0), [0.0, 0.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(discs.normals, np.tile([0.0, 0.0, 1.0], (800, 1)), atol=1e-6)
    np.testing.assert_allclose(discs.base_color, np.tile([0.1, 0.2, 0.3], (800, 1)), rtol=1e-6)
    x, y = np.meshgrid(np.linspace(-1.9, 1.9, 60), np.linspace(-1.9, 1.9, 60))
    away = np.hypot(x[..., None] - discs.positions[:, 0], y[..., None] - discs.positions[:, 1]).min(axis=-1)
    assert away.max() < discs.scales[0, 0] == pytest.approx(SPREAD * 4.0 / 20.0)


def test_a_stage_becomes_one_take_with_its_light_lamps_and_camera(tmp_path):
    converters.write(
        GaussianSequence.from_clouds([cloud(CORNERS), cloud(CORNERS + 0.2)], frames_per_second=4.0), tmp_path / "a.usda"
    )
    (tmp_path / "set.json").write_text(
        json.dumps(
            {
                "beam-stage": 1,
                "assets": ["a.usda", {"path": "a.usda", "translate": [3, 0, 0]}],
                "meshes": [{"ground": True, "size": 4}],
                "lights": [{"type": "point", "position": [0, -2, 3], "intensity": [5, 4, 3]}],
                "environment": {"radiance": [1, 1, 1], "rotate": 270, "degrees_per_second": 8},
                "camera": {"type": "fixed", "position": [0, -8, 1], "target": [0, 0, 1], "fov": 40},
            }
        )
    )
    assert publish(tmp_path / "set.json", tmp_path / "page.html", "--beside") == 0
    view = page_of(tmp_path / "page.html")[1]["view"]
    take = converters.read(tmp_path / "page.b4d")
    assert (len(take), take.frames_per_second, take.topology) == (2, 4.0, "constant")
    assert len(take[0]) == 16 + len(discs_of(Ground(size=4.0).mesh(CORNERS)))
    assert view["state"] == {"environment": "set (stage)", "rotation": -90.0}
    assert view["degreesPerSecond"] == 8.0
    assert view["box"][1][0] - view["box"][0][0] == pytest.approx(4.2, abs=0.3)  # two of them, without the ground
    assert view["lights"][0]["intensity"] == [5.0, 4.0, 3.0]
    pose = view["cameras"][1]
    assert pose["fov"] == pytest.approx(40.0)
    np.testing.assert_allclose(pose["position"], [0.0, -8.0, 1.0])
    np.testing.assert_allclose(pose["worldToCamera"], [1, 0, 0, 0, 0, -1, 0, 1, 0], atol=1e-12)
