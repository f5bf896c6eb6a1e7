"""The player page of an asset, served with its take, its lights, and stills on demand."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beam_warp.converters.player import hdr_bytes, page_text
from beam_warp.errors import BeamError
from beam_warp.view.kinds import NONE, kinds_of
from beam_warp.view.server import DEFAULT_HOST, DEFAULT_PORT, Content, PageServer
from beam_warp.view.takes import FileTake, FrameTakes, SegmentedTake
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.shot import ShotMesh

if TYPE_CHECKING:
    from beam_warp.view.stills import Stills

DEFAULT_SAMPLES = 64
"""Paths a pixel of a still, until the page says otherwise."""

LONGEST_SIDE = 2048
"""Stills are not made larger than this, whatever the page [pixel]."""

Meshes = Mapping[str, Callable[[], ShotMesh | None]]


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """How a viewer is served.

    Attributes:
        host: Address of this machine to listen at; others reach what is not 127.0.0.1.
        port: Port to listen at; 0 takes any that is free.
        longest: No side of a still is longer [pixel].
        device: Warp device of stills; None takes the first CUDA device, or the CPU where there is none.
    """

    host: str = DEFAULT_HOST
    port: int = DEFAULT_PORT
    longest: int = LONGEST_SIDE
    device: str | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Staging:
    """What a take of a stage lacks.

    Attributes:
        view: What the page shows first, as `beam_warp.converters.player.write_player` takes it.
        cloud: Returns the Gaussians of a frame without those that stand for meshes, in the world's axes.
        mesh: The meshes; None if there are none.
    """

    view: Mapping[str, Any]
    cloud: Callable[[int], GaussianCloud]
    mesh: ShotMesh | None


class Viewer:
    """Serves an asset until it is closed. Pages draw themselves; nothing is shared between them."""

    def __init__(
        self,
        sequence: GaussianSequence,
        environments: Mapping[str, Callable[[], EnvironmentMap]],
        *,
        title: str = "beam view",
        file: Path | None = None,
        staging: Staging | None = None,
        grounds: Meshes | None = None,
        options: ViewOptions | None = None,
    ) -> None:
        """Start serving.

        Args:
            sequence: Gaussians to show; frames are read when they are wanted.
            environments: Functions that read or make a light, by its name; the first one shines at first.
            title: What the page is called.
            file: The sequence as a ``.b4d`` file, if it is one: pages read ranges of it.
            staging: What a stage has besides, if the sequence is a stage's.
            grounds: What stills of an asset may show it on, by name, besides nothing.
            options: See `ViewOptions`.

        Raises:
            InvalidOptionError: The port is taken, or the address is none of this machine's.
            DeviceError: There is no such device.
            AssetFormatError: The first frame cannot be read.
        """
        self._options = options or ViewOptions()
        self._device = threading.Lock()
        self._environments = dict(environments)
        self._staging, self._grounds = staging, grounds or {}
        if staging is not None:  # its frames are made by the device
            sequence = replace(sequence, read_frame=self._alone(sequence.read_frame))
        self._sequence = sequence
        if self._options.device is not None:
            from beam_warp.device.arrays import resolve_device

            resolve_device(self._options.device)
        self._server = PageServer(self._options.host, self._options.port, self._found, self._draw)
        try:
            self._kinds = kinds_of(sequence[0])
            is_one = len(sequence) == 1 or sequence.topology == "constant"
            self._take = FileTake(file) if file else SegmentedTake(sequence) if is_one else FrameTakes(sequence)
            self._page = page_text(title, self._settings(title)).encode()
        except BaseException:
            self._server.server_close()
            raise
        self._thread = threading.Thread(target=self._server.serve_forever, name="beam-view", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address for a browser on this machine; it holds the token."""
        return self._server.url

    def wait(self) -> None:
        """Return when the viewer is closed."""
        while self._thread.is_alive():
            self._thread.join(1.0)

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._take.close()

    @property
    def _meshes(self) -> Meshes:
        if (staging := self._staging) is not None:
            return {"stage": lambda: staging.mesh}
        return {NONE: lambda: None, **self._grounds}

    def _settings(self, title: str) -> dict[str, Any]:
        """Return what the page is told."""
        names = enumerate(self._environments)
        return {
            "title": title,
            "take": self._take.settings,
            "environments": [{"name": name, "url": f"environments/{number}.hdr"} for number, name in names],
            "view": {} if self._staging is None else dict(self._staging.view),
            "stills": {
                "kinds": self._kinds,
                "grounds": list(self._meshes),
                "samples": DEFAULT_SAMPLES,
                "longest": self._options.longest,
            },
        }

    def _found(self, name: str) -> Content | None:
        """Return what is at an address behind the token."""
        if name == "":
            return Content(self._page, "text/html; charset=utf-8")
        if name.startswith("stills/"):
            content = self._stills.exr(name) if "_stills" in self.__dict__ else None
            return None if content is None else Content(content)
        lights = {f"environments/{number}.hdr": make for number, make in enumerate(self._environments.values())}
        return Content(hdr_bytes(lights[name]())) if name in lights else self._take.find(name)

    @cached_property
    def _stills(self) -> Stills:
        """What draws stills; it waits for Warp, so that pages need not."""
        from beam_warp.raster.records import RasterOptions
        from beam_warp.view.stills import Stills, Subject

        cloud = self._staging.cloud if self._staging else lambda frame: change_axes(self._sequence[frame], WORLD_AXES)
        subject = Subject(
            frame_count=len(self._sequence),
            cloud=cloud,
            environments=self._environments,
            meshes=self._meshes,
            kinds=tuple(self._kinds),
            raster=RasterOptions.from_metadata(self._sequence.metadata),
        )
        return Stills(subject, longest=self._options.longest, device=self._options.device, lock=self._device)

    def _draw(self, asked: Any) -> Generator[dict[str, Any]]:
        try:
            with self._device:
                stills = self._stills
        except BeamError as error:
            yield {"error": str(error)}
        else:
            yield from stills.draw(asked)

    def _alone(self, read: Callable[[int], GaussianCloud]) -> Callable[[int], GaussianCloud]:
        def guarded(frame: int) -> GaussianCloud:
            with self._device:
                return read(frame)

        return guarded
