"""The page, by `viser`, its windows, and whose turn it is."""

import contextlib
import io
import socket
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import UserError
from ..core.runtime import HOST, PORT
from .checks import same_origin
from .frusta import Frusta
from .look import Look, window_camera
from .pace import Pace
from .panel import Panel
from .subject import Subject
from .warm import draw, warm
from .window import Window

if TYPE_CHECKING:
    import viser

_IDLE = 60.0  # seconds that `run` sleeps at most


class Server:
    """Shows a ``subject`` to browsers at ``address``. All that Dr.Jit computes is computed in `turn`, by whoever calls it: one
    thread alone.

    ``name``: of the scene or run, in commands and files. ``port`` 0 is any that is free. ``entered(server, client, window)`` is
    called for every window, and may add controls of its own.
    Raises: UserError where viser is not installed, or the port is taken.
    """

    def __init__(
        self,
        subject: Subject,
        name: str,
        host: str = HOST,
        port: int = PORT,
        entered: "Callable[[Server, viser.ClientHandle, Window], None] | None" = None,
    ) -> None:
        self.subject, self.name, self.pace = subject, name, Pace()
        self.windows: dict[int, Window] = {}
        self._entered = entered
        self.wake = threading.Event()
        self._jobs: deque[Callable[[], None]] = deque()  # that windows have asked for
        self._later: deque[Callable[[], None]] = deque()  # and that can wait
        self._panels: dict[int, Panel] = {}
        self._turns: deque[int] = deque()  # windows, the one that has waited longest first
        self._warming: Iterator[None] | None = None  # what another size needs, begun
        self._turned_away: set[str] = set()  # origins of other sites' pages
        self._page = _open(host, port)
        self.address = f"http://{host}:{self._page.get_port()}"
        self._page.gui.configure_theme(show_share_button=False, show_logo=False)
        self._page.scene.set_up_direction(subject.up)
        self._page.scene.world_axes.visible = False
        self._start_at(subject.cameras[0])
        self._page.on_client_connect(self._enter)
        self._page.on_client_disconnect(self._leave)

    def close(self) -> None:
        """Close the page, and forget all windows."""
        with contextlib.redirect_stdout(io.StringIO()):  # its own farewell
            self._page.stop()
        if self.subject.lights is not None:
            self.subject.lights.close()
        self.windows.clear()

    # ---- Windows come and go ----

    def _start_at(self, camera):
        first, distance = self._page.initial_camera, float(np.linalg.norm(camera.origin - self.subject.center))
        first.up, first.fov = self.subject.up, 2 * np.arctan(0.5 * camera.size[1] / camera.focal[1])
        first.position, first.look_at = camera.origin, camera.origin + distance * camera.to_world[:3, 2]
        first.near, first.far = 1e-3 * distance, 1e3 * distance

    async def _enter(self, client: "viser.ClientHandle") -> None:
        if await self._turn_away(client):
            return
        camera = _camera(client)
        if camera is None:
            return
        window = Window(Look(camera), self.wake.set)
        if self._entered is not None:
            self._entered(self, client, window)
        panel = Panel(client, window, self)
        frusta = Frusta(client, window, self.subject)
        panel.frusta = frusta

        @client.camera.on_update
        async def _(_handle) -> None:
            if (seen := _camera(client)) is not None:
                window.change(camera=seen, through=frusta.through(seen))

        self._panels[client.client_id], self.windows[client.client_id] = panel, window
        self._turns.append(client.client_id)
        self.wake.set()

    async def _turn_away(self, client):
        """Close the socket of a page of another site; whether it is one. What is no browser tells no origin."""
        connection = self._page._websock_server._live_connections[client.client_id]  # viser has no other way to its headers
        headers = connection.request.headers if connection.request else {}
        origin = headers.get("Origin")
        if origin is None or same_origin(origin, headers.get("Host")):
            return False
        if origin not in self._turned_away:  # it asks again and again
            self._turned_away.add(origin)
            print(f"a page of {origin!r} was turned away: open {self.address} itself", file=sys.stderr, flush=True)
        await connection.close(1008, "open the page itself")
        return True

    async def _leave(self, client: "viser.ClientHandle") -> None:
        for known in (self.windows, self._panels):
            known.pop(client.client_id, None)
        with contextlib.suppress(ValueError):
            self._turns.remove(client.client_id)

    # ---- Whose turn it is ----

    def ask(self, job: Callable[[], None], later: bool = False) -> None:
        """Have ``job()`` done by the thread that renders, in its next turn, or ``later``, when no window waits for a picture."""
        (self._later if later else self._jobs).append(job)
        self.wake.set()

    def turn(self, idle: bool = True) -> bool:
        """Do one piece of work: what a window has asked for, or the first picture of one, or compile some of what the smallest
        size needs, or one pass of the window that has waited longest, or what can wait, or, where ``idle`` work is wanted,
        some of what another size needs. Return whether there was any."""
        with warnings.catch_warnings():  # a client may vanish while its picture is drawn
            warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
            return self._turn(idle)

    def _turn(self, idle):
        if self._jobs:
            self._jobs.popleft()()
            return True
        windows = [(number, self.windows.get(number)) for number in list(self._turns)]
        due = [(number, window) for number, window in windows if window is not None and window.due() == 0]
        if not self.pace.seconds:  # of a fit, what is compiled is no part of a picture's time
            due = [(number, window) for number, window in due if window.blank and not self.subject.changing]
            if not due:
                self._warm()
                return True
        if due:
            number, window = due[0]
            with contextlib.suppress(ValueError):  # it may leave meanwhile
                self._turns.remove(number)
                self._turns.append(number)
            self._draw(number, window)
            return True
        if self._later:
            self._later.popleft()()
            return True
        if idle and self.pace.cold is not None:
            self._warm()
            return True
        return False

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Take turns ``until()`` says so, and sleep in between."""
        while not until():
            self.wake.clear()
            if not self.turn():
                due = min((window.due() for window in list(self.windows.values())), default=_IDLE)
                self.wake.wait(min(due, _IDLE))

    def _draw(self, number, window):
        moving = sum(other.moving for other in list(self.windows.values()))
        picture = window.work(self.subject, self.pace, max(moving, 1))
        panel = self._panels.get(number)
        if picture is not None and panel is not None:
            panel.show(picture)

    def _warm(self):
        """Compile some of what the smallest cold grid needs, and measure it after the last."""
        grid = self.pace.cold
        assert grid is not None, "there is one where this is called"
        self._warming = self._warming or warm(self.subject, grid)
        try:
            next(self._warming)
        except StopIteration:
            self._warming = None
            self.pace.measure(grid, lambda grid: draw(self.subject, grid))


def _camera(client):
    """The window's camera, None before it has told, and for numbers that make none."""
    state = client.camera
    try:
        return window_camera(state.wxyz, state.position, state.fov, (state.image_width, state.image_height))
    except (AssertionError, TypeError, ValueError):
        return None


def _open(host, port):
    """viser's server. Raises: UserError as `check` does."""
    check(host, port)
    import viser

    class Page(viser.ViserServer):
        """A page that no one can make public: a message of any window could else ask for a tunnel to the internet."""

        def request_share_url(self, verbose: bool = True) -> None:
            return None

    with contextlib.redirect_stdout(io.StringIO()):  # its own greeting
        page = Page(host=host, port=port, label="rgs_mi", verbose=False)
    if port and page.get_port() != port:  # viser takes the next one, when another was quicker
        page.stop()
        raise _taken(port)
    return page


def check(host: str, port: int) -> None:
    """Check that a page can be opened, before what it shows is loaded. Raises: UserError where viser is not installed, or the
    port is taken."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise UserError("a window needs viser: pip install 'rgs-mi[viewer]'") from error
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except socket.gaierror as error:
        raise UserError(f"--host {host}: no address of this machine ({error.strerror})") from error
    except OSError as error:
        raise _taken(port, error.strerror) from error


def _taken(port, reason=None):
    reason = reason or "Address already in use"
    return UserError(f"--port {port}: can't be opened ({reason}): choose another, or 0 for any that is free")
