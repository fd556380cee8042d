"""The page and whose turn it is, without a browser."""

import builtins
import socket
import time
import urllib.error
import urllib.request

import pytest

from rgs_mi.core.errors import UserError
from rgs_mi.viewer import window
from rgs_mi.viewer.checks import choice, number, same_origin
from rgs_mi.viewer.look import Look
from rgs_mi.viewer.server import Server
from rgs_mi.viewer.window import Window

from scenes import orbit_camera
from windows import Panel

CAMERA = orbit_camera(0.7, size=(56, 48))


@pytest.fixture
def server(subject):
    server = Server(subject, "run", port=0)
    server.pace.seconds = {128: 0.01}
    yield server
    server._page.stop()


def enter(server, number, camera=CAMERA):
    """A window without a browser."""
    opened, panel = Window(Look(camera), server.wake.set), Panel()
    server.windows[number], server._panels[number] = opened, panel
    server._turns.append(number)
    return opened, panel


def test_a_port_that_is_taken_is_one_line(server, subject):
    port = server._page.get_port()
    with pytest.raises(UserError, match=f"--port {port}: can't be opened .*: choose another") as error:
        Server(subject, "run", port=port)
    assert "\n" not in str(error.value)
    with pytest.raises(UserError, match="--host nowhere.invalid: no address"):
        Server(subject, "run", host="nowhere.invalid")


def test_it_listens_here_alone(server):
    address = server._page._websock_server
    assert address._host == "localhost" and server.address == f"http://localhost:{server._page.get_port()}"
    assert server._page.request_share_url() is None  # whatever a page asks for
    other = socket.gethostbyname(socket.gethostname())
    if not other.startswith("127."):
        with pytest.raises(OSError):
            socket.create_connection((other, server._page.get_port()), timeout=2).close()


def test_no_file_is_had_but_the_pages(server):
    def get(path):
        try:
            with urllib.request.urlopen(server.address + path) as answer:
                return answer.status
        except urllib.error.HTTPError as error:
            return error.code

    assert get("/") == 200
    assert {
        get(path) for path in ("/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/scene.xml")
    } == {404}


def test_a_missing_package_is_one_line(subject, monkeypatch):
    load = builtins.__import__

    def without(name, *arguments, **options):
        if name == "viser":
            raise ImportError(name)
        return load(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(UserError, match=r"^a window needs viser: pip install 'rgs-mi\[viewer\]'$"):
        Server(subject, "run", port=0)


def test_windows_take_turns(server):
    """Nobody waits for another's sixteen samples."""
    (first, one), (second, two) = enter(server, 1), enter(server, 2, orbit_camera(2, size=(56, 48)))
    for opened in (first, second):
        opened.moved -= 1  # at rest
    for _ in range(10):
        assert server.turn(idle=False)
    assert first.refined.passes == second.refined.passes == 4 and len(one.pictures) == len(two.pictures) == 2
    server.windows.pop(1)  # it vanishes
    for _ in range(13):
        assert server.turn(idle=False)
    assert not server.turn(idle=False) and first.refined.passes == 4 and second.refined.complete


def test_a_first_picture_does_not_wait_until_all_is_compiled(server):
    """Then what moves waits until the smallest size is."""
    server.pace.seconds.clear()
    assert server.turn(idle=False) and not server.pace.seconds  # nobody looks yet
    opened, panel = enter(server, 1)
    assert server.turn(idle=False) and len(panel.pictures) == 1 and not server.pace.seconds
    opened.change(camera=orbit_camera(1, size=(56, 48)))
    while not server.pace.seconds:
        assert server.turn(idle=False) and len(panel.pictures) == 1
    assert server.turn(idle=False) and len(panel.pictures) == 2


def test_the_last_move_counts(server, monkeypatch):
    """A hundred events while a picture is drawn are one picture."""
    monkeypatch.setattr(window, "REST", 100)
    seen, panel = enter(server, 1)
    for k in range(100):
        seen.change(camera=orbit_camera(0.01 * k, size=(56, 48)))
    assert server.turn(idle=False) and not server.turn(idle=False) and len(panel.pictures) == 1
    assert server.wake.is_set()


def test_it_sleeps_until_something_is_due(server):
    opened, panel = enter(server, 1)
    end, turns = time.monotonic() + 20, []
    turn = server.turn
    server.turn = lambda: turns.append(1) or turn(idle=False)
    server.run(until=lambda: opened.refined.complete or time.monotonic() > end)
    assert len(panel.pictures) == 6 and len(turns) < 30  # in motion, and after 1, 5, 9, 13, 17 passes


def test_what_was_asked_for_comes_first(server, monkeypatch):
    """And what can wait comes last."""
    monkeypatch.setattr(window, "REST", 100)
    _, panel = enter(server, 1)
    done = []
    server.ask(lambda: done.append("later"), later=True)
    server.ask(lambda: done.append("now"))
    assert server.turn(idle=False) and done == ["now"] and panel.pictures == []
    assert server.turn(idle=False) and done == ["now"] and len(panel.pictures) == 1
    assert server.turn(idle=False) and done == ["now", "later"]


def test_values_of_pages_are_checked():
    assert number(5, 0, 3) == 3.0 and number(-2.5, -1, 1) == -1.0 and number(1, 0, 3) == 1.0
    assert [number(bad, 0, 1) for bad in (float("nan"), float("inf"), "1", None, [1])] == [None] * 5
    assert choice("a", ("a", "b")) == "a"
    assert [choice(bad, ("a", "b")) for bad in ("c", "../a", None, 1, ["a"])] == [None] * 5


def test_origins():
    assert same_origin("http://localhost:8080", "localhost:8080") and same_origin("https://Lab.org", "lab.org")
    others = ("http://localhost:8081", "http://evil.org:8080", "null", "http://localhost:8080.evil.org", "")
    assert not any(same_origin(other, "localhost:8080") for other in others) and not same_origin("null", None)
