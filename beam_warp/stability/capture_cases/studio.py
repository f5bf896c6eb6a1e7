"""The source of stress captures: a given capture to change, or the demo figure, path traced when it is asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from beam_warp.capture.capture import Capture
from beam_warp.demo.capture import DANCE_SECONDS, FRAMES_PER_SECOND, demo_figure_for, dome_cameras, write_capture
from beam_warp.demo.figure import Figure
from beam_warp.demo.lights import studio
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.mesh import MaterialMesh

BRIEF_FRAMES = 2
"""Frames of a case in which a camera is at fault: a key frame and a tracked one."""


@dataclass(eq=False)
class StressStudio:
    """The source of captures for cases: a given one, or the demo figure, path traced when it is first asked for.

    Attributes:
        folder: An existing folder; every capture is written to a folder in it.
        given: The capture to change; None takes the demo's.
        frame_count: Frames of a path-traced capture.
        camera_count: Training cameras of a path-traced capture.
        size: Side of path-traced images [pixel].
        samples: Paths per pixel.
        device: Warp device.
    """

    folder: Path
    given: Capture | None = None
    frame_count: int = 4
    camera_count: int = 12
    size: int = 128
    samples: int = 16
    device: str | None = None
    _written: dict[str, Capture] = field(default_factory=dict, init=False)
    _figure: Figure | None = field(default=None, init=False)

    @property
    def figure(self) -> Figure:
        """The demo figure, meshed once."""
        if self._figure is None:
            self._figure = demo_figure_for(self.size)
        return self._figure

    def dancing(self) -> list[MaterialMesh]:
        """Return the figure in every frame of its dance."""
        period = FRAMES_PER_SECOND * DANCE_SECONDS
        return [self.figure.at(frame / period) for frame in range(self.frame_count)]

    def base(self) -> Capture:
        """Return the capture that cases change."""
        return self.given or self.traced("as it is", self.dancing)

    def brief(self) -> Capture:
        """Return the first frames of that capture, for cases in which a camera is at fault."""
        base = self.base()
        return replace(base, records=base.select(frames=base.frames[:BRIEF_FRAMES]))

    def traced(
        self, name: str, make: Callable[[], Sequence[MaterialMesh]], light: EnvironmentMap | None = None
    ) -> Capture:
        """Return a capture of meshes, one a frame, path traced when first asked for; without a light, in the studio."""
        if name not in self._written:
            meshes = make()
            cameras = dome_cameras([mesh.vertices for mesh in meshes], self.camera_count, 2, self.size, self.size)
            self._written[name] = write_capture(
                self.folder / name.replace(" ", "_"),
                meshes,
                cameras,
                light or studio(),
                samples=self.samples,
                device=self.device,
            )
        return self._written[name]
