"""Key frames of one window, and the video through them."""

import tempfile
from collections.abc import Callable, Generator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.camera import Camera
from ..core.color import to_8bit
from ..core.errors import UserError
from ..core.files import write_png
from ..export import video
from ..export.render import smooth_path
from .checks import number
from .look import Look
from .passes import Refined
from .subject import Subject
from .window import picture_of, seen

if TYPE_CHECKING:
    import viser

    from .server import Server
    from .window import Window

_SIDE = 2  # of the grid of samples in a pixel
_SIZE = 800  # pixels along the longer side of a frame, at most
FRAMES = (12, 240)


class KeyFrames:
    """The key frames of one ``window``: ``keys``, cameras of one size, and how many ``frames`` a video through them has."""

    def __init__(self, client: "viser.ClientHandle", window: "Window", server: "Server") -> None:
        self._client, self._window, self._server = client, window, server
        self.keys: list[Camera] = []
        self.frames, self._running = 60, False

    def controls(self, gui: "viser.GuiApi", button: Callable[[str, Callable[[], None]], object]) -> None:
        """Add its controls to a window's ``gui``; ``button(label, act)`` adds one that acts."""
        self._told = gui.add_markdown("no key frames")
        slider = gui.add_slider("frames", *FRAMES, 1, self.frames)

        @slider.on_update
        async def _(_event) -> None:
            self.frames = int(number(slider.value, *FRAMES) or self.frames)

        button("add this view", self.add)
        button("forget all", self.forget)
        button("make the video", self.start)

    def add(self) -> None:
        """Make what the window sees the next key frame."""
        camera = self._window.look.camera
        scale = min(1.0, _SIZE / max(camera.size))
        size = [max(2, 2 * round(n * scale / 2)) for n in (self.keys[0].size if self.keys else camera.size)]
        self.keys.append(camera.resized(*size))
        self._tell(f"{len(self.keys)} key frames")

    def forget(self) -> None:
        """Start again without key frames."""
        self.keys.clear()
        self._tell("no key frames")

    def start(self) -> None:
        """Make the video, a pass a turn, and have it downloaded."""
        if self._running or len(self.keys) < 2:
            self._tell("it is being made" if self._running else "needs two key frames")
            return
        try:
            video.check()
        except UserError as error:
            self._tell(str(error))
            return
        self._running = True
        self._next(made(self._server.subject, self._window.look, list(self.keys), self.frames))

    def _next(self, work):
        """Do one piece of the ``work`` when no window waits, and ask for the next, while its own window is there."""

        def piece():
            part = None
            try:
                part = next(work)
            except UserError as error:
                self._tell(str(error))
            if isinstance(part, float) and self._client.client_id in self._server.windows:
                self._tell(f"{100 * part:.0f}%")
                return self._next(work)
            if isinstance(part, bytes):
                self._client.send_file_download("rgs_mi.mp4", part, save_immediately=True)
                self._tell("done")
            work.close()
            self._running = False

        self._server.ask(piece, later=True)

    def _tell(self, text):
        self._told.content = text


def made(subject: Subject, look: Look, keys: list[Camera], frames: int) -> Generator[float | bytes]:
    """Make a video of ``frames`` on a smooth path through ``keys``, of what ``look`` shows: yield the part that is done after
    each pass, and at last the video."""
    with tempfile.TemporaryDirectory() as folder:
        files = []
        for k, camera in enumerate(smooth_path(keys, frames)):
            refined, view = Refined(_SIDE), replace(look, camera=camera, through=None)
            view = replace(view, camera=seen(subject, view))
            while not refined.complete:
                refined.add(subject, view)
                yield (k + refined.passes / refined.total) / frames
            picture = picture_of(subject, view, view.camera, refined.means)
            files.append(Path(folder) / f"{k:03}.png")
            write_png(files[-1], to_8bit(picture))
        yield video.write(folder, files)[0].read_bytes()
