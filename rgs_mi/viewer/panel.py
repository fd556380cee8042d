"""The controls of one window. What they say comes from a page, and is checked before it is believed."""

import io
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from ..core.color import TONES
from .checks import choice, number
from .frusta import Frusta
from .key_frames import KeyFrames
from .look import BACKGROUNDS, OWN
from .maps import MAPS
from .pace import GRIDS
from .passes import point_at
from .window import Picture, Window, seen

if TYPE_CHECKING:
    import viser

    from .server import Server

_PICK = GRIDS[1]  # points along a side of the picture in which a click is looked up


class Panel:
    """The controls of one ``client``, which change its ``window``; what has to be computed is asked of the ``server``."""

    frusta: Frusta

    def __init__(self, client: "viser.ClientHandle", window: Window, server: "Server") -> None:
        self._client, self._window, self._server = client, window, server
        self._gui, subject = client.gui, server.subject
        self._picture: Picture | None = None
        self._status = self._gui.add_markdown("…")
        with self._gui.add_folder("Show"):
            self._choice("map", list(MAPS) if subject.views else [m for m in MAPS if m != "error"], "map")
            self._number("exposure", "exposure", -6, 6, 0.1, 0)
            self._choice("tone", TONES, "tone")
            self._choice("background", BACKGROUNDS if subject.lights else BACKGROUNDS[:2], "background")
        if subject.views:
            self._photographs()
        if subject.lights and subject.still is None:
            self._light(subject.lights.names)
        if subject.still is None:
            self._materials()
        self._keep()

    # ---- Controls ----

    def _number(self, label, field, low, high, step, start, within=None):
        """A slider of the look's ``field``, or of that field of its material ``within``."""
        slider = self._gui.add_slider(label, low, high, step, start)

        @slider.on_update
        async def _(_event) -> None:
            if (value := number(slider.value, low, high)) is None:
                return
            if within is None:
                self._window.change(**{field: value})
            else:
                self._window.change(**{within: replace(getattr(self._window.look, within), **{field: value})})

        return slider

    def _choice(self, label, options, field):
        """A list of what the look's ``field`` can be."""
        dropdown = self._gui.add_dropdown(label, options, initial_value=getattr(self._window.look, field))

        @dropdown.on_update
        async def _(_event) -> None:
            if (value := choice(dropdown.value, options)) is not None:
                self._window.change(**{field: value})

        return dropdown

    def _button(self, label, act):
        button = self._gui.add_button(label)

        @button.on_click
        async def _(_event) -> None:
            act()

        return button

    def _photographs(self):
        names = [view.name for view in self._server.subject.views]
        with self._gui.add_folder("Photographs", expand_by_default=False):
            shown = self._gui.add_checkbox("cameras", False)

            @shown.on_update
            async def _(_event) -> None:
                self.frusta.show(shown.value is True)

            dropdown = self._gui.add_dropdown("look through", names)

            @dropdown.on_update
            async def _(_event) -> None:
                if (name := choice(dropdown.value, names)) is not None:
                    self.frusta.look_through(name)

            self._number("photograph", "wipe", 0, 1, 0.01, 0)

    def _light(self, names):
        with self._gui.add_folder("Light", expand_by_default=False):
            dropdown = self._gui.add_dropdown("environment", names, initial_value=OWN)

            @dropdown.on_update
            async def _(_event) -> None:
                if (name := choice(dropdown.value, names)) is None:
                    return
                ready = lambda: self._window.change(light=name)
                lights = self._server.subject.lights
                assert lights is not None
                self._server.ask(lambda: lights.prepare(name, ready))

            self._number("rotation", "rotate", -180, 180, 1, 0)
            self._number("brighter", "brighten", -4, 4, 0.1, 0)

    def _materials(self):
        def factors(within):
            for label, field in (("roughness ×", "roughness"), ("metallic ×", "metallic"), ("base color ×", "base_color")):
                self._number(label, field, 0, 3, 0.05, 1, within)

        with self._gui.add_folder("Material", expand_by_default=False):
            factors("material")
        with self._gui.add_folder("Region", expand_by_default=False):
            self._picking = self._gui.add_checkbox("pick by a click", False)
            reach = self._server.subject.radius
            radius = self._gui.add_slider("radius", 0.01 * reach, reach, 0.01 * reach, 0.2 * reach)
            self._ball = None

            @self._picking.on_update
            async def _(_event) -> None:
                self._client.scene.remove_click_callback()
                if self._picking.value is True:
                    self._client.scene.on_click()(self._clicked)

            @radius.on_update
            async def _(_event) -> None:
                value, region = number(radius.value, 1e-3 * reach, reach), self._window.look.region
                if value is not None and region is not None:
                    self._region(region[:3], value)

            self._radius = radius
            factors("region_material")
            self._button("forget the region", lambda: self._region(None, 0))

    def _clicked(self, event):
        """Make the region one about the point that was clicked on."""
        x, y = (number(v, 0, 1) for v in event.screen_pos)
        if x is None or y is None:
            return

        def pick():
            look, subject = self._window.look, self._server.subject
            point = point_at(subject, look, seen(subject, look).resized(_PICK, _PICK), x, y)
            radius = number(self._radius.value, 1e-3 * subject.radius, subject.radius)
            if point is not None and radius is not None:
                self._region(tuple(map(float, point)), radius)

        self._server.ask(pick)

    def _region(self, center, radius):
        """Show the ball, and change what is in it; no ``center``: none."""
        if self._ball is not None:
            self._ball.remove()
            self._ball = None
        if center is not None:
            self._ball = self._client.scene.add_icosphere(
                "/region", radius, (240, 150, 40), subdivisions=1, wireframe=True, position=center
            )
        self._window.overlay("region", center is not None)
        self._window.change(region=None if center is None else (*center, radius))

    def _keep(self):
        with self._gui.add_folder("Keep", expand_by_default=False):
            self._button("screenshot", self._screenshot)
            self._command = self._gui.add_text("command", "", multiline=True)
            self._button("update the command", self._tell_command)
        with self._gui.add_folder("Video", expand_by_default=False):
            self._key_frames = KeyFrames(self._client, self._window, self._server)
            self._key_frames.controls(self._gui, self._button)

    def _screenshot(self):
        """Have the picture that is seen downloaded."""
        if self._picture is None:
            return
        memory = io.BytesIO()
        Image.fromarray(self._picture.pixels).save(memory, "PNG")
        self._client.send_file_download("rgs_mi.png", memory.getvalue(), save_immediately=True)

    def _tell_command(self):
        look, subject = self._window.look, self._server.subject
        look = replace(look, camera=seen(subject, look))
        distance = float(np.linalg.norm(look.camera.origin - subject.center))
        lines = [look.command(self._server.name, distance)]
        if keys := self._key_frames.keys:
            lines.append(look.command(self._server.name, distance, keys, self._key_frames.frames))
        self._command.value = "\n".join(lines)

    # ---- Pictures ----

    def show(self, picture: Picture) -> None:
        """Send a picture to the browser."""
        self._picture = picture
        self._client.scene.set_background_image(
            picture.pixels,
            format="png" if picture.quality is None else "jpeg",
            jpeg_quality=picture.quality,
            depth=picture.depth,
        )
        height, width = picture.pixels.shape[:2]
        state = f"{width} × {height}" + ("" if picture.part is None else f", {100 * picture.part:.0f}%")
        if self._status.content != state:
            self._status.content = state
