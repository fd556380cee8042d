"""`show`: a window on a scene that Python has loaded, in a notebook or a script."""

import asyncio
import html
from collections.abc import Iterable
from pathlib import Path

import mitsuba as mi

from ..core.runtime import HOST
from ..datasets.types import View
from .server import Server
from .subject import Subject

_BREATH = 0.005  # seconds in which other work of the same loop is done, from one pass to the next
_HEIGHT = 600  # pixels of the frame in a notebook


class Shown:
    """A window that is open: a notebook shows it as a frame. ``address``: of its page."""

    def __init__(self, server: Server) -> None:
        self._server, self.address = server, server.address
        self._task: asyncio.Task | None = None

    def start(self) -> None:
        """Render in the running event loop, between its other work: in the thread in which cells run, since Dr.Jit is for one
        thread at a time."""
        self._task = asyncio.get_running_loop().create_task(self._render())

    async def _render(self):
        while True:
            worked = self._server.turn()
            await asyncio.sleep(_BREATH if worked else 10 * _BREATH)

    def stop(self) -> None:
        """Close the window."""
        if self._task is not None:
            self._task.cancel()
        self._server.close()

    def _repr_html_(self):
        return f'<iframe src="{html.escape(self.address)}" width="100%" height="{_HEIGHT}" frameborder="0"></iframe>'


def show(
    scene: "mi.Scene",
    views: Iterable[View] = (),
    envmaps: Iterable[str | Path] = (),
    name: str = "scene.xml",
    host: str = HOST,
    port: int = 0,
) -> Shown:
    """Open a window on a loaded ``scene`` that has surfels.

    In a notebook it returns at once, and pictures are rendered while no cell runs. Elsewhere, where no event loop does, it says
    where the page is, and returns when someone presses Ctrl-C. Scenes with another integrator than 'rgs_deferred', such as
    'rgs_path', are shown by that in motion, and at rest rendered by their own.

    Args:
      views:   photographs of it, as of `load_dataset`
      envmaps: images, latitude-longitude, that the window offers as lights, beside those of the suite
      name:    of its file, in the commands that the window writes
      host, port: where the page is; port 0 is any that is free

    Raises: UserError where viser is not installed, the port is taken, or the scene has no surfels.
    """
    subject = Subject.of(scene, envmaps)
    subject.compare_with(views)
    shown = Shown(Server(subject, name, host, port))
    try:
        shown.start()
    except RuntimeError:  # no loop runs
        print(f"{shown.address} (Ctrl-C closes it)", flush=True)
        try:
            shown._server.run()
        except KeyboardInterrupt:
            shown.stop()
    return shown
