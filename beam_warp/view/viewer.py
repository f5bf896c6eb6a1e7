"""A page in the browser that shows our own frames, with controls for time, light and what is drawn."""

from __future__ import annotations

import json
import logging
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beam_warp.checks import require_number
from beam_warp.errors import BeamError
from beam_warp.image.files import write_exr
from beam_warp.image.tone import TRANSFORMS
from beam_warp.raster.records import RasterOptions
from beam_warp.view.frames import FrameLoop, PagePicture
from beam_warp.view.lamps import Lamps
from beam_warp.view.painter import CloudPainter, Picture
from beam_warp.view.schedule import LONGEST_SIDE, Pace, Schedule
from beam_warp.view.server import DEFAULT_HOST, DEFAULT_PORT, server_url, start_server, stop_server
from beam_warp.view.state import (
    CHOICES,
    DEFERRED,
    GREY_GROUND,
    LIT,
    NO_ENVIRONMENT,
    NO_GROUND,
    SHADOW_GROUND,
    TRACED,
    Playback,
    SubjectBox,
    Viewpoint,
    ViewState,
    number_within,
)
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import lights_to_json

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

MOVING_QUALITY, STILL_QUALITY = 75, 92
"""JPEG qualities; the last picture is a PNG."""

FIELD_OF_VIEW = 35.0
"""Vertical field of view of new pages [degree]."""

ELEVATION = 5.0
"""Elevation above the horizon from which new pages look, from the front [degree]."""

LABELS = {
    LIT: "lit",
    "radiance": "captured colour",
    "base_color": "base colour",
    "roughness": "roughness",
    "ambient_occlusion": "ambient occlusion",
    "normals": "normals",
    "surface_normals": "normals of the geometry",
    "normal_confidence": "confidence of normals",
    "base_color_error": "standard error of base colour",
    "roughness_error": "standard error of roughness",
    "ambient_occlusion_error": "standard error of ambient occlusion",
    "observability": "observability",
    "depth": "depth",
    "alpha": "alpha",
}
"""What channels are called on the page."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """How a viewer is served.

    Attributes:
        host: Address of this machine to listen at; others reach what is not 127.0.0.1.
        port: Port to listen at; 0 takes any that is free.
        rate: Frames per second to hold while something moves; pictures get as small as that takes.
        longest: No side of a picture is longer [pixel].
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
        raster: How splats are drawn; None for what the asset says.
    """

    host: str = DEFAULT_HOST
    port: int = DEFAULT_PORT
    rate: float = 10.0
    longest: int = LONGEST_SIDE
    device: str | None = None
    raster: RasterOptions | None = None


class Viewer:
    """Serves an asset until it is closed."""

    def __init__(
        self,
        sequence: GaussianSequence,
        environments: Mapping[str, Callable[[], EnvironmentMap]],
        *,
        title: str = "beam view",
        options: ViewOptions | None = None,
    ) -> None:
        """Start serving.

        Args:
            sequence: Gaussians to show; frames are read when they are wanted.
            environments: Functions that read or make a light, by its name; the first one shines at first, and casts
                shadows only on a GPU.
            title: Above the controls.
            options: See `ViewOptions`.

        Raises:
            MissingPackageError: viser is not installed.
            InvalidOptionError: The port is taken, or the address is none of this machine's.
            DeviceError: There is no such device.
            AssetFormatError: The first frame cannot be read.
        """
        options = options or ViewOptions()
        require_number("rate", options.rate, 0.1, 240.0)
        self._server = start_server(options.host, options.port, title)
        try:
            self._painter = CloudPainter(sequence, environments, raster=options.raster, device=options.device)
            first = ViewState(
                environment=next(iter(environments), NO_ENVIRONMENT),
                environment_shadows=self._painter.is_cuda,
                channel=self._painter.channels[0],
                choices={**CHOICES, "channel": self._painter.channels, "environment": (*environments, NO_ENVIRONMENT)},
            )
            traced = Pace(500.0, first_pixels=2.0**22 if self._painter.is_cuda else 2.0**15)
            schedule = Schedule(first, moving=Pace(1000.0 / options.rate), traced=traced, longest=options.longest)
            self._pages: dict[int, _Page] = {}
            self._is_closed = threading.Event()
            self._loop = FrameLoop(self._painter, schedule, self._deliver, self._report)
            self._controls = _Controls(self._server, self._painter, self._loop, sequence, tuple(environments), first)
            _place_camera(self._server, self._painter.subject)
            self._server.on_client_connect(self._enter)
            self._server.on_client_disconnect(self._leave)
            self._ticker = threading.Thread(target=self._tick, name="beam-view-clock", daemon=True)
            self._ticker.start()
        except BaseException:
            stop_server(self._server)
            raise

    @property
    def url(self) -> str:
        """Address for a browser on this machine."""
        return server_url(self._server)

    @property
    def device(self) -> str:
        """Name of the device that draws."""
        return self._painter.device

    @property
    def state(self) -> ViewState:
        """State that is shown."""
        return self._loop.state

    def change(self, **values: Any) -> ViewState:
        """Change the state as the controls do, and the controls with it; see `ViewState.changed`."""
        state = self._loop.change(**values)
        self._controls.follow(state)
        return state

    def wait(self) -> None:
        """Return when the viewer is closed."""
        while not self._is_closed.wait(1.0):
            pass

    def close(self) -> None:
        """Stop serving."""
        if self._is_closed.is_set():
            return
        self._is_closed.set()
        self._ticker.join(timeout=5.0)
        self._loop.close()
        stop_server(self._server)

    async def _enter(self, client: viser.ClientHandle) -> None:
        """Take a new page in."""
        page = _Page(client, self._loop, self._painter)
        self._pages[client.client_id] = page
        client.camera.on_update(page.look)
        self._loop.look(client.client_id, _viewpoint(client.camera))

    async def _leave(self, client: viser.ClientHandle) -> None:
        """Forget a page."""
        self._pages.pop(client.client_id, None)
        self._loop.leave(client.client_id)

    def _deliver(self, client: int, frame: PagePicture) -> None:
        page = self._pages.get(client)
        if page is not None:
            page.show(frame)

    def _report(self, client: int, error: Exception) -> None:
        page = self._pages.get(client)
        if page is not None:
            page.complain(error)

    def _tick(self) -> None:
        """Let time run while it is played."""
        pause = 0.0
        while not self._is_closed.wait(pause):
            try:
                pause = self._controls.tick(time.monotonic())
            except Exception:
                log.exception("time stood still")
                pause = 1.0


class _Page:
    """One page: its status, its legend, its pictures."""

    def __init__(self, client: viser.ClientHandle, loop: FrameLoop, painter: CloudPainter) -> None:
        self._client = client
        self._loop = loop
        self._device = painter.device
        self._status = client.gui.add_markdown("*drawing the first picture …*", order=-1.0)
        self._legend: Any = None

    async def look(self, camera: viser.CameraHandle) -> None:
        """Take note of where the page looks from."""
        self._loop.look(self._client.client_id, _viewpoint(camera))

    def show(self, frame: PagePicture) -> None:
        """Show a picture."""
        picture = frame.picture
        if frame.is_last:
            self._client.scene.set_background_image(picture.pixels, format="png")
        else:
            quality = STILL_QUALITY if picture.samples else MOVING_QUALITY
            self._client.scene.set_background_image(picture.pixels, format="jpeg", jpeg_quality=quality)
        height, width = picture.pixels.shape[:2]
        words = [f"**{frame.milliseconds:.0f} ms**", f"{width} × {height}", f"{picture.gaussian_count:,} Gaussians"]
        if picture.samples:
            words.append(f"{picture.samples} samples")
        self._status.content = " · ".join([*words, self._device])
        self._explain(picture)

    def complain(self, error: Exception) -> None:
        """Say what failed."""
        body = str(error) if isinstance(error, BeamError) else f"{type(error).__name__}: {error}"
        self._client.add_notification("This could not be drawn", body, color="red", auto_close_seconds=15.0)
        self._status.content = "*this could not be drawn*"

    def _explain(self, picture: Picture) -> None:
        """Show what colours mean, where they mean something else than themselves."""
        if picture.legend is None:
            if self._legend is not None:
                self._legend.remove()
                self._legend = None
        elif self._legend is None:
            self._legend = self._client.gui.add_image(picture.legend, format="png", order=-0.5)
        else:
            self._legend.image = picture.legend


class _Controls:
    """What all pages share: sliders, choices, lights, time."""

    def __init__(
        self,
        server: viser.ViserServer,
        painter: CloudPainter,
        loop: FrameLoop,
        sequence: GaussianSequence,
        environments: tuple[str, ...],
        state: ViewState,
    ) -> None:
        self._server = server
        self._loop = loop
        self._painter = painter
        self._frame_count = len(sequence)
        self._playback: Playback | None = None
        self._bound: dict[str, tuple[Any, Callable[[Any], Any]]] = {}
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        server.scene.set_up_direction("+z")
        with server.gui.add_folder("Picture"):
            self._add_picture(server.gui, state)
        if self._frame_count > 1:
            with server.gui.add_folder("Time"):
                self._add_time(server.gui, sequence, state)
        if LIT in painter.channels:
            with server.gui.add_folder("Light"):
                self._add_light(server.gui, environments, state)
            with server.gui.add_folder("Lamps", expand_by_default=False):
                self._lamps = Lamps(server, painter.subject, lambda lights: loop.change(lights=lights))
        with server.gui.add_folder("Save", expand_by_default=False):
            self._add_save(server.gui)

    def tick(self, now: float) -> float:
        """Let time run, and return when to look at the clock again [s]."""
        playback = self._playback
        if playback is None:
            return 0.05
        frame = playback.frame_at(now)
        self._loop.change(frame=frame)
        self._frame.value = frame
        if playback.is_over(now):
            self._playing.value = False
        return min(0.05, 0.5 / playback.frames_per_second)

    def _add_picture(self, gui: viser.GuiApi, state: ViewState) -> None:
        words = {LABELS.get(name, name): name for name in self._painter.channels}
        names = {name: word for word, name in words.items()}
        channels = gui.add_dropdown("Channel", tuple(words), initial_value=names[state.channel])
        self._bind("channel", channels, words.get, names.__getitem__)
        if self._painter.can_trace:
            hint = "Paths are traced once nothing moves"
            self._bind("mode", gui.add_dropdown("Mode", (DEFERRED, TRACED), initial_value=state.mode, hint=hint))
            self._bind("samples", gui.add_number("Samples", state.samples, min=1, step=1))
        self._bind("background", gui.add_rgb("Background", state.background))
        if LIT in self._painter.channels:
            grounds = (NO_GROUND, GREY_GROUND, SHADOW_GROUND)
            self._bind("ground", gui.add_dropdown("Ground", grounds, initial_value=state.ground))
        gui.add_button("Frame subject").on_click(self._frame_subject)

    def _add_time(self, gui: viser.GuiApi, sequence: GaussianSequence, state: ViewState) -> None:
        self._frame = gui.add_slider("Frame", 0, self._frame_count - 1, 1, min(state.frame, self._frame_count - 1))
        self._playing = gui.add_checkbox("Play", False)
        self._rate = gui.add_number("Frames/s", float(sequence.frames_per_second), min=0.1, max=240.0, step=0.1)
        self._loops = gui.add_checkbox("Loop", True)
        self._bind("frame", self._frame)

        @self._frame.on_update
        async def _(event: Any) -> None:
            if event.client is not None and self._playback is not None:  # a hand moved it: time goes on from there
                self._play()

        for control in (self._playing, self._rate, self._loops):

            @control.on_update
            async def _(_: Any) -> None:
                self._play()

    def _play(self) -> None:
        """Let time run from the frame that is shown, or stop it: as the controls say."""
        if not self._playing.value:
            self._playback = None
            return
        first, loops = int(self._frame.value), bool(self._loops.value)
        if not loops and first == self._frame_count - 1:
            first = 0
        rate = number_within(self._rate.value, 24.0, 0.1, 240.0)
        self._playback = Playback(time.monotonic(), first, rate, self._frame_count, loops)

    def _add_light(self, gui: viser.GuiApi, environments: tuple[str, ...], state: ViewState) -> None:
        names = (*environments, NO_ENVIRONMENT)
        self._bind("environment", gui.add_dropdown("Environment", names, initial_value=state.environment))
        hint = "And light from surface to surface; without a GPU, once nothing moves, and it takes seconds"
        shadows = gui.add_checkbox("Environment shadows", state.environment_shadows, hint=hint)
        self._bind("environment_shadows", shadows)
        turn = float(np.clip(state.rotation, -180.0, 180.0))
        self._bind("rotation", gui.add_slider("Rotation [°]", -180.0, 180.0, 1.0, turn))
        stops = float(np.clip(state.exposure, -6.0, 6.0))
        self._bind("exposure", gui.add_slider("Exposure [stops]", -6.0, 6.0, 0.1, stops))
        self._bind("transform", gui.add_dropdown("View transform", TRANSFORMS, initial_value=state.transform))

    def _add_save(self, gui: viser.GuiApi) -> None:
        gui.add_button("Save PNG", hint="As it is shown, in the page's full size").on_click(
            lambda event: self._save(event.client, "beam-view.png", _png)
        )
        gui.add_button("Save EXR", hint="Scene-linear light with alpha, or the channel's numbers").on_click(
            lambda event: self._save(event.client, "beam-view.exr", _exr)
        )
        if LIT in self._painter.channels:
            gui.add_button("Save lights", hint="Placed lights as JSON").on_click(self._save_lights)

    def _save(self, client: viser.ClientHandle | None, name: str, encode: Callable[[Picture], bytes]) -> None:
        if client is not None:
            self._loop.export(
                client.client_id,
                lambda picture: client.send_file_download(name, encode(picture), save_immediately=True),
            )

    def _save_lights(self, event: Any) -> None:
        if event.client is not None:
            content = json.dumps({"lights": lights_to_json(self._loop.state.lights)}, indent=2)
            event.client.send_file_download("lights.json", content.encode(), save_immediately=True)

    def _frame_subject(self, event: Any) -> None:
        """Look at the subject from the front again."""
        if event.client is None:
            return
        camera = _framing(self._painter.subject)
        with event.client.atomic():
            event.client.camera.position = camera.position
            event.client.camera.look_at = self._painter.subject.center
            event.client.camera.up_direction = (0.0, 0.0, 1.0)

    def follow(self, state: ViewState) -> None:
        """Let the controls show a state."""
        for name, (control, shown) in self._bound.items():
            control.value = shown(getattr(state, name))

    def _bind(
        self,
        name: str,
        control: Any,
        meant: Callable[[Any], Any] = lambda value: value,
        shown: Callable[[Any], Any] = lambda value: value,
    ) -> None:
        """Let a control change a part of what is looked at.

        Args:
            name: Field of `ViewState`.
            control: Control of the field.
            meant: Turns a value of the control into one of the field.
            shown: Turns a value of the field into one of the control.
        """
        self._bound[name] = control, shown

        @control.on_update
        async def _(event: Any) -> None:
            if event.client is None:  # `follow`, and not a hand
                return
            kept = shown(getattr(self._loop.change(**{name: meant(event.target.value)}), name))
            if control.value != kept:  # what cannot be is not shown as if it were
                control.value = kept


def _framing(subject: SubjectBox) -> Camera:
    """Return the camera that frames a subject from the front, in a square."""
    corners = np.array(np.meshgrid(*zip(subject.low, subject.high, strict=True))).reshape(3, -1).T
    return Camera.frame_points(corners, elevation=ELEVATION, width=512, height=512, vertical_fov=FIELD_OF_VIEW)


def _place_camera(server: viser.ViserServer, subject: SubjectBox) -> None:
    """Say where new pages look from."""
    camera = _framing(subject)
    server.initial_camera.fov = float(np.radians(FIELD_OF_VIEW))
    server.initial_camera.position = camera.position
    server.initial_camera.look_at = subject.center
    server.initial_camera.near = 1e-3 * subject.extent
    server.initial_camera.far = 1e3 * subject.extent


def _viewpoint(camera: viser.CameraHandle) -> Viewpoint:
    """Return where a page looks from."""
    w, i, j, k = np.asarray(camera.wxyz, np.float64).tolist()
    x, y, z = np.asarray(camera.position, np.float64).tolist()
    return Viewpoint((w, i, j, k), (x, y, z), float(camera.fov), int(camera.image_width), int(camera.image_height))


def _png(picture: Picture) -> bytes:
    from PIL import Image

    content = BytesIO()
    Image.fromarray(picture.pixels).save(content, format="PNG")
    return content.getvalue()


def _exr(picture: Picture) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.exr"
        write_exr(path, picture.layers())
        return path.read_bytes()
