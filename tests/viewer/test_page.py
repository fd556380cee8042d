"""The window in a browser: it draws, turns, relights, serves two at a time, and takes two hundred events without complaint."""

import functools
import http.server
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import rgs_mi
from rgs_mi.core.errors import UserError
from rgs_mi.viewer.exports import Exports
from rgs_mi.viewer.pace import GRIDS
from rgs_mi.viewer.server import Server

import browser
from runs import PATIENCE
from windows import psnr

_WINDOW = {"width": 640, "height": 360}
_VIEW = {"x": 0, "y": 0, "width": 300, "height": 360}  # the picture, beside the panel
_MIDDLE = 155, 250  # of it, clear of what viser says of WebGL
WRITTEN: list[str] = []  # formats


def write(to):
    if to == "usd":
        raise UserError("usd needs a package")
    WRITTEN.append(to)
    return [Path(f"runs/ball/export/{to}/splats.ply")]


EXPORTS = Exports(("splat", "usd"), write)


@pytest.fixture(scope="module")
def served(subject):
    """A server in a thread of its own, which is the one that renders."""
    if not any(map(shutil.which, browser.NAMES)):
        pytest.skip("needs Chromium: apt-get install chromium")
    rgs_mi.set_variant()
    server, closed = Server(subject, "runs/ball", port=0, entered=EXPORTS.offer), threading.Event()
    server.pace.seconds = dict.fromkeys(GRIDS, 9.0) | {GRIDS[0]: 0.01}  # the others are compiled elsewhere
    thread = threading.Thread(target=server.run, args=(closed.is_set,), daemon=True)
    thread.start()
    yield server
    closed.set()
    server.wake.set()
    thread.join()
    server._page.stop()


@pytest.fixture(scope="module")
def tab(served):
    with browser.open_tab(webgl=True) as page:
        page.set_viewport_size(_WINDOW)
        page.goto(served.address)
        settled(served)
        yield page


def wait(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "too slow"
        time.sleep(0.05)


def settled(server, count=1):
    """Wait until all of ``count`` windows are at rest and complete."""
    complete = lambda n, window: window.due() == float("inf") and server._panels[n]._picture.quality is None
    wait(lambda: len(server.windows) == count and all(complete(*item) for item in list(server.windows.items())))


def shot(page, path):
    """What the tab shows beside the panel, [H, W, 3]."""
    page.wait_for_timeout(400)  # the picture is on its way, and is decoded
    page.screenshot(path=path, clip=_VIEW)
    return np.asarray(Image.open(path).convert("RGB"))


def drag(page, dx, dy, steps=6):
    x, y = _MIDDLE
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + dx, y + dy, steps=steps)
    page.mouse.up()


def open_folder(page, name):
    """Open a folder of the panel, once."""
    page.get_by_text(name, exact=True).first.click()
    page.wait_for_timeout(300)


def set_slider(page, label, value):
    """Type a number beside a slider."""
    box = page.locator(f"xpath=//label[text()='{label}']/ancestor::*[.//input[@type='text' or @inputmode]][1]//input").last
    box.fill(str(value))
    box.press("Enter")


def choose(page, label, option):
    """Choose from a list of the panel."""
    page.locator(f"xpath=//label[text()='{label}']/ancestor::*[.//input][1]//input").first.click()
    page.get_by_role("option", name=option, exact=True).first.click()


def test_it_shows_what_is_rendered(served, tab, tmp_path):
    """The last picture comes without loss; only what a browser does to fit it into the window is between."""
    (number,) = served.windows
    sent = served._panels[number]._picture
    shown = shot(tab, tmp_path / "a.png")
    assert sent.quality is None and sent.pixels.shape[:2] == (360, 640)
    expected = sent.pixels[: _VIEW["height"], : _VIEW["width"]]
    assert psnr(shown[200:], expected[200:]) > 40  # below what viser says of WebGL
    assert expected.std() > 20 and tab.errors == []


def test_orbit_map_light(served, tab, tmp_path):
    before = shot(tab, tmp_path / "before.png")
    drag(tab, 100, 20)
    settled(served)
    turned = shot(tab, tmp_path / "turned.png")
    assert psnr(before, turned) < 30

    choose(tab, "map", "normals")
    settled(served)
    normals = shot(tab, tmp_path / "normals.png")
    assert psnr(normals, turned) < 25
    choose(tab, "map", "picture")
    settled(served)
    assert psnr(shot(tab, tmp_path / "again.png"), turned) > 45

    open_folder(tab, "Light")
    set_slider(tab, "rotation", 120)
    settled(served)
    relit = shot(tab, tmp_path / "relit.png")
    assert psnr(relit, turned) < 40
    (window,) = served.windows.values()
    assert window.look.rotate == 120 and window.look.map == "picture" and tab.errors == []


def test_exports(served, tab):
    """What a page asks for is written by the thread that renders, and the page tells where, or why not."""
    open_folder(tab, "Export")
    tab.get_by_role("button", name="export", exact=True).click()
    tab.get_by_text("runs/ball/export/splat/splats.ply").wait_for(timeout=1000 * PATIENCE)
    assert WRITTEN == ["splat"]
    choose(tab, "format", "usd")
    tab.get_by_role("button", name="export", exact=True).click()
    tab.get_by_text("usd needs a package").wait_for(timeout=1000 * PATIENCE)
    assert WRITTEN == ["splat"] and tab.errors == []


def test_two_windows_see_their_own(served, tab, tmp_path):
    with_second = tab.context.browser.new_page(viewport=_WINDOW)
    try:
        with_second.goto(served.address)
        settled(served, 2)
        first = shot(tab, tmp_path / "first.png")
        drag(with_second, -100, 30)
        settled(served, 2)
        assert psnr(shot(with_second, tmp_path / "second.png"), first) < 35
        assert psnr(shot(tab, tmp_path / "still.png"), first) > 45  # the other is where it was
    finally:
        with_second.close()
    wait(lambda: len(served.windows) == 1)  # and is forgotten
    assert len(served._panels) == len(served._turns) == 1


def test_another_sites_page_is_turned_away(served, tab, capsys):
    """Any site that the browser shows could open a socket to this machine, and draw, or export."""
    import viser

    folder = Path(viser.__file__).parent / "client" / "build"
    handler = functools.partial(Quiet, directory=folder)
    with http.server.ThreadingHTTPServer(("localhost", 0), handler) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        origin, before = f"http://localhost:{other.server_address[1]}", dict(served.windows)
        page = tab.context.browser.new_page(viewport=_WINDOW)
        try:
            page.goto(f"{origin}/?websocket={served.address.replace('http', 'ws')}")
            wait(lambda: served._turned_away == {origin})
            page.wait_for_timeout(1500)  # it tries again
        finally:
            page.close()
            other.shutdown()
    assert served.windows == before
    assert capsys.readouterr().err == f"a page of '{origin}' was turned away: open {served.address} itself\n"


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files, and tells nothing."""

    def log_message(self, *_):
        pass


def test_two_hundred_events(served, tab):
    """Any drag, wheel, double click and key: nothing fails, and the window still answers."""
    rng = np.random.default_rng(0)
    (window,) = served.windows.values()
    for _ in range(200):
        kind = rng.integers(5)
        x, y = rng.uniform(20, 290), rng.uniform(180, 350)
        tab.mouse.move(x, y)
        if kind == 0:
            tab.mouse.wheel(0, float(rng.normal() * 80))
        elif kind == 1:
            tab.mouse.dblclick(x, y)
        elif kind == 2:
            tab.keyboard.press(str(rng.choice(["w", "a", "s", "d", "q", "e", "ArrowLeft", "ArrowUp"])))
        else:
            tab.mouse.down(button="left" if kind == 3 else "right")
            tab.mouse.move(x + rng.normal() * 60, y + rng.normal() * 60, steps=2)
            tab.mouse.up(button="left" if kind == 3 else "right")
    settled(served)
    generation = window.generation
    drag(tab, 40, 0)
    wait(lambda: window.generation > generation)
    settled(served)
    assert generation > 50 and tab.errors == []


def test_a_window_vanishes_while_it_is_drawn(served, tab):
    """What is sent to nobody is no warning, which would be an error here."""
    page = tab.context.browser.new_page(viewport=_WINDOW)
    page.goto(served.address)
    settled(served, 2)
    number = max(served.windows)
    window, panel = served.windows[number], served._panels[number]
    page.close()
    wait(lambda: len(served.windows) == 1)
    done = []
    served.ask(lambda: done.append(panel.show(window.work(served.subject, served.pace) or panel._picture)))
    wait(lambda: done)
