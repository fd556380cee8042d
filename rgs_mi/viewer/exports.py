"""What a window offers to have in other formats."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import UserError
from .checks import choice

if TYPE_CHECKING:
    import viser

    from .server import Server
    from .window import Window

_LAST = 1e6  # among the folders of a panel


class Exports:
    """Offers every window to write what is shown, as it was fitted, in one of ``formats``: ``write(format)`` does it, and returns
    the paths of its files.

    A page chooses a format and nothing else: where files go is not for it to say.
    """

    def __init__(self, formats: Sequence[str], write: Callable[[str], Sequence[Path]]) -> None:
        self._formats, self._write = formats, write
        self._running = False

    def offer(self, server: "Server", client: "viser.ClientHandle", window: "Window") -> None:
        """Add the controls to a window. What is asked for is written when no window waits for a picture."""
        gui = client.gui
        with gui.add_folder("Export", order=_LAST, expand_by_default=False):
            dropdown = gui.add_dropdown("format", list(self._formats))
            button, told = gui.add_button("export"), gui.add_markdown("")

        @button.on_click
        async def _(_event) -> None:
            format = choice(dropdown.value, self._formats)
            if format is None or self._running:
                return
            self._running = True
            told.content = "it is being written; pictures wait until then"

            def job() -> None:
                try:
                    told.content = "  \n".join(f"`{path}`" for path in self._write(format))
                except UserError as error:
                    told.content = str(error)
                finally:
                    self._running = False

            server.ask(job, later=True)
