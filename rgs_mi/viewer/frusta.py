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
        self._poses = np.array([view.camera.to_world for view in subject.views]).reshape(-1, 4, 4)
        self._distances = np.linalg.norm(self._poses[:, :3, 3] - subject.center, axis=1)

    def show(self, visible: bool) -> None:
        """Show or hide them; they are made the first time."""
        if visible and not self._handles:
            self._handles = [self._make(k, view) for k, view in enumerate(self._subject.views)]
        for handle in self._handles:
            handle.visible = visible
        self._window.overlay("photographs", visible)

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
        apart = np.linalg.norm(self._poses[:, :3, 3] - camera.origin, axis=1)
        cosines = (self._poses[:, :3, :3] * camera.to_world[:3, :3]).sum(1).min(1)
        there = np.flatnonzero((apart < _NEAR * self._distances) & (cosines > 1 - _NEAR))
        return self._subject.views[there[0]].name if len(there) else None
