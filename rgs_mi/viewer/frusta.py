"""The photographs' cameras as frusta; a click on one takes its place."""

from typing import TYPE_CHECKING

import numpy as np

from ..core.camera import Camera
from .look import quaternion
from .subject import Subject

if TYPE_CHECKING:
    import viser

    from .window import Window

_SIZE = 0.08  # of a frustum, in parts of the object's radius
_NEAR = 1e-3  # how much a camera that is the same differs, in parts of its distance and in cosines


class Frusta:
    """The frusta of one ``client``, hidden at first, and the photograph whose place its camera has taken."""

    def __init__(self, client: "viser.ClientHandle", window: "Window", subject: Subject) -> None:
        self._client, self._window, self._subject = client, window, subject
        self._handles = []

    def show(self, visible: bool) -> None:
        """Show or hide them; they are made the first time."""
        if visible and not self._handles:
            self._handles = [self._make(k, view) for k, view in enumerate(self._subject.views)]
        for handle in self._handles:
            handle.visible = visible
        self._window.with_depth = visible
        self._window.redraw()

    def _make(self, k, view):
        camera = view.camera
        handle = self._client.scene.add_camera_frustum(
            f"/photographs/{k}",
            fov=2 * np.arctan(0.5 * camera.size[1] / camera.focal[1]),
            aspect=camera.size[0] / camera.size[1] * camera.focal[1] / camera.focal[0],
            scale=_SIZE * self._subject.radius,
            color=(90, 90, 200),
            wxyz=quaternion(camera.to_world),
            position=camera.origin,
        )

        @handle.on_click
        async def _(_event) -> None:
            self.look_through(view.name)

        return handle

    def look_through(self, name: str) -> None:
        """Take the place of the photograph ``name``."""
        view = next((view for view in self._subject.views if view.name == name), None)
        if view is None:
            return
        camera, own = view.camera, self._client.camera
        distance = np.linalg.norm(camera.origin - self._subject.center)
        with self._client.atomic():
            own.position = camera.origin
            own.up_direction = -camera.to_world[:3, 1]
            own.look_at = camera.origin + distance * camera.to_world[:3, 2]
            own.fov = 2 * np.arctan(0.5 * camera.size[1] / camera.focal[1])

    def through(self, camera: Camera) -> str | None:
        """Return the name of the photograph in whose place ``camera`` stands, or None."""
        for view in self._subject.views:
            own, distance = view.camera, np.linalg.norm(view.camera.origin - self._subject.center)
            there = np.linalg.norm(camera.origin - own.origin) < _NEAR * distance
            if there and (camera.to_world[:3, :3] * own.to_world[:3, :3]).sum(0).min() > 1 - _NEAR:
                return view.name
        return None
