"""A film through key frames of a window, made in turns with pictures of others."""

from dataclasses import replace

import numpy as np
import pytest

from rgs_mi.core.errors import UserError
from rgs_mi.export import video
from rgs_mi.viewer.film import Film, made
from rgs_mi.viewer.look import Look
from rgs_mi.viewer.passes import Refined
from rgs_mi.viewer.server import Server
from rgs_mi.viewer.window import Window, picture_of

from readers import decoded
from scenes import orbit_camera
from windows import Panel, psnr

KEYS = [orbit_camera(angle, size=(64, 48)) for angle in (0.2, 0.9, 1.4)]
LOOK = Look(KEYS[0], map="normals", rotate=40)


def picture(subject, camera):
    """What the window shows from there, with the samples of a film."""
    refined, look = Refined(2), replace(LOOK, camera=camera)
    while not refined.complete:
        refined.add(subject, look)
    return picture_of(subject, look, camera, refined.means)


def test_made(subject, tmp_path):
    """A frame for each place, from the first key to the last, of what the window shows."""
    pytest.importorskip("imageio_ffmpeg")
    *parts, film = made(subject, LOOK, KEYS, 5)
    assert len(parts) == 5 * Refined(2).total and parts[-1] == 1 and (np.diff(parts) > 0).all()
    (tmp_path / "film.mp4").write_bytes(film)
    frames, meta = decoded(tmp_path / "film.mp4")
    assert frames.shape == (5, 48, 64, 3) and meta["codec"] == "h264"
    for frame, key in ((0, 0), (2, 1), (4, 2)):
        assert psnr(frames[frame] / 255, picture(subject, KEYS[key])) > 28  # chroma has half the size
        others = [psnr(frames[frame] / 255, picture(subject, KEYS[other])) for other in {0, 1, 2} - {key}]
        assert max(others) < 25


class Client:
    """Takes what a film sends."""

    client_id = 1

    def __init__(self):
        self.sent = []

    def send_file_download(self, name, content, save_immediately):
        self.sent.append((name, content))


class Text:
    """Takes what a film tells."""

    content = ""


@pytest.fixture
def film(subject):
    """The film of a window without a browser."""
    server = Server(subject, "run", port=0)
    server.pace.seconds = {128: 0.01}
    server.windows[1], server._panels[1] = Window(LOOK), Panel()
    film = Film(Client(), server.windows[1], server)
    film._told, film.frames = Text(), 3
    yield film
    server._page.stop()


def test_a_film_from_a_window(film):
    """It takes turns, comes as a download, and can be made again."""
    pytest.importorskip("imageio_ffmpeg")
    film.start()
    assert film._told.content == "needs two key frames"
    for angle in (0.2, 0.6):
        film._window.change(camera=orbit_camera(angle, size=(64, 48)))
        film.add()
    for count in (1, 2):
        film.start()
        film.start()
        assert film._told.content == "it is being made"
        turns = 0
        while film._running:
            assert film._server.turn(idle=False)
            turns += 1
        assert turns >= 3 * Refined(2).total and film._told.content == "done"
        assert [name for name, _ in film._client.sent] == ["rgs_mi.mp4"] * count


def test_a_film_without_its_window(film):
    """Whose window is closed: nothing is sent, and nothing is left to do."""
    pytest.importorskip("imageio_ffmpeg")
    film.add()
    film.add()
    film.start()
    film._server.windows.clear()
    while film._server.turn(idle=False):
        pass
    assert film._client.sent == [] and not film._running


def test_a_film_that_fails_says_why(film, monkeypatch):
    def full(*_):
        raise UserError("the disk is full: free some space")

    monkeypatch.setattr(video, "write", full)
    monkeypatch.setattr(video, "check", lambda: None)
    film.add()
    film.add()
    film.start()
    while film._running:
        assert film._server.turn(idle=False)
    assert film._told.content == "the disk is full: free some space" and film._client.sent == []
