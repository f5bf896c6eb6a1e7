"""Pictures of states: those of the renderers, frame by frame as they are wanted, whatever the cloud holds."""

from dataclasses import replace

import numpy as np
import pytest
from support.figure_asset import changed, figure_asset

from beam_warp.demo.lights import sunset
from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import srgb_to_linear
from beam_warp.image.files import display_image
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.view.painter import CloudPainter, FrameCache, TracedPicture, ground_mesh
from beam_warp.view.renderers import displayed
from beam_warp.view.state import ALPHA, DEPTH, LIT, NO_ENVIRONMENT, SubjectBox, ViewState
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.shot import RenderedImage

pytestmark = pytest.mark.usefixtures("coarse_irradiance")

LIGHTS = {"sunset": sunset, "white": lambda: EnvironmentMap.constant([1.0, 1.0, 1.0], height=4)}


@pytest.fixture(scope="module")
def sequence():
    return figure_asset(frame_count=2)


@pytest.fixture(scope="module")
def painter(sequence):
    return CloudPainter(sequence, LIGHTS, device="cpu")


@pytest.fixture(scope="module")
def camera(painter):
    low, high = painter.subject.low, painter.subject.high
    return Camera.frame_points(np.stack([low, high]), azimuth=30.0, elevation=5.0, width=64, height=80)


def test_what_is_lit_is_the_renderers_image(painter, sequence, camera):
    state = ViewState(environment="sunset", exposure=0.5, background=(10, 200, 30))
    picture = painter.draw(state, camera)
    assert picture.pixels.shape == (80, 64, 3)
    assert picture.gaussian_count == len(sequence[0])
    layers = picture.layers()
    rgb = np.stack([layers[name] for name in "RGB"], axis=-1)
    alpha = layers["A"][..., None]
    assert 0.05 < (alpha > 0.99).mean() < 0.8
    # The formula: what is shown is laid over the background in the display's linear light. One level for rounding.
    shown = np.clip(np.divide(rgb, alpha, out=np.zeros_like(rgb), where=alpha > 0) * 2.0**0.5, 0.0, 1.0)
    expected = display_image(alpha * shown + (1.0 - alpha) * srgb_to_linear(np.array([10, 200, 30]) / 255.0))
    assert np.abs(picture.pixels.astype(int) - expected).max() <= 1
    assert (picture.pixels[layers["A"] == 0.0] == (10, 200, 30)).all()


def test_no_light_is_black(painter, camera):
    picture = painter.draw(ViewState(environment=NO_ENVIRONMENT, background=(9, 9, 9)), camera)
    covered = picture.layers()["A"] > 0.999
    assert covered.any()
    assert picture.pixels[covered].max() <= 1


def test_every_channel_is_drawn(painter, camera):
    pictures = {name: painter.draw(ViewState(channel=name), camera) for name in painter.channels if name != LIT}
    covered = pictures[ALPHA].pixels[..., 0] == 255
    for name, picture in pictures.items():
        assert picture.pixels.shape == (80, 64, 3), name
        outside = pictures[ALPHA].pixels[..., 0] == 0
        assert len(np.unique(picture.pixels[outside], axis=0)) <= 1, name  # one background
        assert (picture.pixels[covered] != picture.pixels[outside][0]).any(), name
    assert pictures["roughness"].legend is not None
    assert pictures[DEPTH].legend is not None
    assert pictures["base_color"].legend is None
    assert pictures[DEPTH].layers()["depth"][covered].min() > 0.1


def test_frames_are_read_when_they_are_wanted(sequence, camera):
    read = []

    def reading(frame):
        read.append(frame)
        return sequence[frame % 2]

    painter = CloudPainter(GaussianSequence(50, reading), LIGHTS, device="cpu")
    assert sorted(read) == [0, 24, 49]  # to frame the subject
    painter.draw(ViewState(frame=7, environment="white"), camera)
    painter.draw(ViewState(frame=7, environment="white", rotation=9.0), camera)
    painter.draw(ViewState(frame=10_000, environment="white"), camera)
    assert read[3:] == [7]  # once; and beyond the end is the last one, which is there


def test_the_cache_has_a_size(sequence):
    bytes_each = sum(array.nbytes for array in sequence[0].arrays().values())
    cache = FrameCache(GaussianSequence(9, lambda frame: sequence[frame % 2]), capacity=3 * bytes_each)
    for frame in range(9):
        cache[frame]
    assert len(cache) == 3
    tiny = FrameCache(sequence, capacity=1)
    assert tiny[0] is tiny[0]
    assert len(tiny) == 1


def test_an_asset_without_materials_has_channels(sequence, camera):
    materials = dict.fromkeys(("base_color", "roughness", "ambient_occlusion", "normals"))
    bare = changed(sequence, lambda _, cloud: cloud.with_arrays(**materials))
    painter = CloudPainter(bare, LIGHTS, device="cpu")
    assert painter.channels[0] == "radiance"
    assert LIT not in painter.channels
    assert not painter.can_trace
    assert painter.draw(ViewState(channel="radiance"), camera).pixels.std() > 1.0


@pytest.mark.parametrize("empty_frames", [(0,), (1,), (0, 1)])
def test_empty_frames_are_background(sequence, camera, empty_frames):
    def emptied(frame, cloud):
        return cloud.select(np.zeros(0, int)) if frame in empty_frames else cloud

    painter = CloudPainter(changed(sequence, emptied), LIGHTS, device="cpu")
    for frame in empty_frames:
        for channel in painter.channels:
            state = ViewState(frame=frame, channel=channel, environment="white", background=(1, 2, 3))
            pixels = painter.draw(state, camera).pixels
            assert channel == ALPHA or (pixels == (1, 2, 3)).all(), channel
    assert painter.subject.extent > 0.5


def test_a_frame_that_cannot_be_read_says_so_when_it_is_drawn(sequence, camera):
    def reading(frame):
        if frame == 2:
            raise InvalidOptionError("torn")
        return sequence[frame % 2]

    painter = CloudPainter(GaussianSequence(3, reading), LIGHTS, device="cpu")
    assert painter.draw(ViewState(environment="white"), camera).gaussian_count
    with pytest.raises(InvalidOptionError, match="torn"):
        painter.draw(ViewState(frame=2, environment="white"), camera)


def test_an_unknown_light(painter, camera):
    with pytest.raises(InvalidOptionError, match="environment must be one of sunset, white, got 'moon'"):
        painter.draw(ViewState(environment="moon"), camera)


def test_splats_are_drawn_as_the_asset_says(sequence, camera):
    options = RasterOptions(antialiased=True, low_pass=4.0)
    painter = CloudPainter(replace(sequence, metadata=options.as_metadata()), LIGHTS, device="cpu")
    buffer = rasterize(sequence[0], camera, options=options, device="cpu")
    drawn = painter.draw(ViewState(channel=DEPTH), camera).layers()
    np.testing.assert_array_equal(drawn["A"], buffer.alpha)


def test_traced_pictures_are_what_was_traced():
    class Progress:
        sample_count = 0

        def advance(self, samples):
            self.sample_count += samples

        def image(self):
            return RenderedImage(np.full((2, 3, 3), 0.25, np.float32), np.full((2, 3), 0.5, np.float32))

    traced = TracedPicture(Progress(), ViewState(background=(0, 0, 0)), 7)
    traced.advance(3)
    picture = traced.picture()
    assert (picture.samples, picture.gaussian_count) == (3, 7)
    assert (picture.pixels == display_image(np.full((2, 3, 3), 0.25))).all()  # 0.5 of half coverage over black


def test_an_image_of_nothing_is_background():
    nothing = RenderedImage(np.zeros((2, 3, 3), np.float32), np.zeros((2, 3), np.float32))
    assert (displayed(nothing, "standard", 0.0, (5, 6, 7)) == (5, 6, 7)).all()


def test_the_ground_is_below_the_subject():
    subject = SubjectBox(np.array([-0.5, -0.3, 0.1]), np.array([0.5, 0.3, 2.0]))
    ground = ground_mesh(subject, catches_shadows=True)
    assert ground.catches_shadows.all()
    np.testing.assert_allclose(ground.surface.vertices[:, 2], 0.1, rtol=1e-6)
    a, b, c = ground.surface.vertices[ground.surface.faces[0]]
    assert np.cross(b - a, c - a)[2] > 0.0  # counter-clockwise from above, as its normals say
