"""Lights that are dragged about in a viewer: a handle in the scene, and a folder of controls, for each."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from beam_warp.view.state import LightKind, SubjectBox
from beam_warp.world.lights import Light

if TYPE_CHECKING:
    import viser

MOST_LAMPS = 16
"""Each one costs a shadow map."""

KINDS: tuple[LightKind, ...] = ("point", "spot", "directional")


class Lamps:
    """The lights that were added, shared by all pages."""

    def __init__(
        self, server: viser.ViserServer, subject: SubjectBox, changed: Callable[[tuple[Light, ...]], Any]
    ) -> None:
        """Make the controls, without any light.

        Args:
            server: Server that shows controls and handles; controls go into the container that is open.
            subject: Box that lights are placed around.
            changed: Takes the lights whenever one changes.
        """
        self._server = server
        self._subject = subject
        self._changed = changed
        self._lock = threading.RLock()
        self._lamps: dict[int, _Lamp] = {}
        self._count = 0
        self._kind = server.gui.add_dropdown("New light", KINDS)
        self._add = server.gui.add_button("Add light", hint="Drag its handle in the picture")

        @self._add.on_click
        def _(_: Any) -> None:
            self.add(self._kind.value)

        self._folder = server.gui.add_folder("Placed lights", visible=False)

    def add(self, kind: LightKind) -> int | None:
        """Add a light, and return its number; None if there are too many, or the kind is none."""
        with self._lock:
            if len(self._lamps) >= MOST_LAMPS or kind not in KINDS:
                return None
            self._count += 1
            number = self._count
            with self._folder:
                self._lamps[number] = _Lamp(self._server, number, self._subject, kind, self.tell, self.remove)
            self._folder.visible = True
            self.tell()
            return number

    def remove(self, number: int) -> None:
        """Take a light away."""
        with self._lock:
            lamp = self._lamps.pop(number, None)
            if lamp is None:
                return
            lamp.close()
            self._folder.visible = bool(self._lamps)
            self._add.disabled = False
            self.tell()

    def tell(self) -> None:
        """Hand the lights over."""
        with self._lock:
            self._add.disabled = len(self._lamps) >= MOST_LAMPS
            self._changed(tuple(lamp.placed.light() for lamp in self._lamps.values()))


class _Lamp:
    """One light: what it is, and what shows it."""

    def __init__(
        self,
        server: viser.ViserServer,
        number: int,
        subject: SubjectBox,
        kind: LightKind,
        changed: Callable[[], None],
        remove: Callable[[int], None],
    ) -> None:
        self.placed = subject.new_light(kind)
        self._changed = changed
        gui, scene, size = server.gui, server.scene, 0.15 * subject.extent
        self._handle = scene.add_transform_controls(
            f"/lamps/{number}",
            scale=size,
            disable_rotations=kind == "point",
            disable_axes=kind == "directional",
            disable_sliders=kind == "directional",
            depth_test=False,
            position=self.placed.position,
            wxyz=self.placed.wxyz,
        )
        self._ball = scene.add_icosphere(
            f"/lamps/{number}/ball",
            radius=0.12 * size,
            color=self.placed.color,
            subdivisions=2,
            cast_shadow=False,
            receive_shadow=False,
        )
        if kind != "point":
            ray = size * np.array(
                [[[0, 0, 0], [0, 0, -2.0]], [[0, 0, -2.0], [0.15, 0, -1.7]], [[0, 0, -2.0], [-0.15, 0, -1.7]]]
            )
            scene.add_line_segments(
                f"/lamps/{number}/ray", ray.astype(np.float32), (255, 210, 90), thickness=0.04 * size
            )

        @self._handle.on_update
        async def _(_: Any) -> None:
            x, y, z = self._handle.position
            self.change(position=(x, y, z), wxyz=tuple(self._handle.wxyz))

        power = "Irradiance [W/m²]" if kind == "directional" else "Intensity [W/sr]"
        extent = "Angular size [°]" if kind == "directional" else "Radius [m]"
        with gui.add_folder(f"{kind.capitalize()} {number}") as self._folder:
            color = gui.add_rgb("Colour", self.placed.color)
            strength = gui.add_number(power, self.placed.power, min=0.0, max=1e6, step=0.1)
            width = gui.add_number(extent, self.placed.size, min=0.0, max=90.0, step=0.01, hint="0 casts sharp shadows")
            if kind == "spot":
                cone = gui.add_number("Cone [°]", self.placed.cone, min=1.0, max=89.0, step=1.0)
                cone.on_update(lambda event: self.change(cone=event.target.value))
            shadows = gui.add_checkbox("Casts shadows", True)
            gone = gui.add_button("Remove", color="red")
        color.on_update(lambda event: self._paint(event.target.value))
        strength.on_update(lambda event: self.change(power=event.target.value))
        width.on_update(lambda event: self.change(size=event.target.value))
        shadows.on_update(lambda event: self.change(casts_shadows=bool(event.target.value)))
        gone.on_click(lambda _: remove(number))

    def change(self, **values: Any) -> None:
        """Take new values."""
        self.placed = self.placed.changed(**values)
        self._changed()

    def close(self) -> None:
        """Take it off every page."""
        self._handle.remove()
        self._folder.remove()

    def _paint(self, color: Any) -> None:
        self.change(color=color)
        self._ball.color = self.placed.color
