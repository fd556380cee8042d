"""A video through key frames of a window, made in turns with pictures of others."""

from dataclasses import replace

import numpy as np
import pytest

from rgs_mi.core.errors import UserError
from rgs_mi.export import video
from rgs_mi.viewer.key_frames import KeyFrames, made
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
    """What the window shows from there, with the samples of one in a video."""
    refined, look = Refined(2), replace(LOOK, camera=camera)
    while not refined.complete:
        refined.add(subject, look)
    return picture_of(subject, look, camera, refined.means)


def test_made(subject, tmp_path):
    """A frame for each place, from the first key to the last, of what the window shows."""
    pytest.importorskip("imageio_ffmpeg")
    *parts, movie = made(subject, LOOK, KEYS, 5)
    assert len(parts) == 5 * Refined(2).total and parts[-1] == 1 and (np.diff(parts) > 0).all()
    (tmp_path / "video.mp4").write_bytes(movie)
    frames, meta = decoded(tmp_path / "video.mp4")
    assert frames.shape == (5, 48, 64, 3) and meta["codec"] == "h264"
    for frame, key in ((0, 0), (2, 1), (4, 2)):
        assert psnr(frames[frame] / 255, picture(subject, KEYS[key])) > 28  # chroma has half the size
        others = [psnr(frames[frame] / 255, picture(subject, KEYS[other])) for other in {0, 1, 2} - {key}]
        assert max(others) < 25


class Client:
    """Takes what a video sends."""

    client_id = 1

    def __init__(self):
        self.sent = []

    def send_file_download(self, name, content, save_immediately):
        self.sent.append((name, content))


class Text:
    """Takes what a video tells."""

    content = ""


@pytest.fixture
def key_frames(subject):
    """The key frames of a window without a browser."""
    server = Server(subject, "run", port=0)
    server.pace.seconds = {128: 0.01}
    server.windows[1], server._panels[1] = Window(LOOK), Panel()
    key_frames = KeyFrames(Client(), server.windows[1], server)
    key_frames._told, key_frames.frames = Text(), 3
    yield key_frames
    server._page.stop()


def test_a_video_from_a_window(key_frames):
    """It takes turns, comes as a download, and can be made again."""
    pytest.importorskip("imageio_ffmpeg")
    key_frames.start()
    assert key_frames._told.content == "needs two key frames"
    for angle in (0.2, 0.6):
        key_frames._window.change(camera=orbit_camera(angle, size=(64, 48)))
        key_frames.add()
    for count in (1, 2):
        key_frames.start()
        key_frames.start()
        assert key_frames._told.content == "it is being made"
        turns = 0
        while key_frames._running:
            assert key_frames._server.turn(idle=False)
            turns += 1
        assert turns >= 3 * Refined(2).total and key_frames._told.content == "done"
        assert [name for name, _ in key_frames._client.sent] == ["rgs_mi.mp4"] * count


def test_a_video_without_its_window(key_frames):
    """Whose window is closed: nothing is sent, and nothing is left to do."""
    pytest.importorskip("imageio_ffmpeg")
    key_frames.add()
    key_frames.add()
    key_frames.start()
    key_frames._server.windows.clear()
    while key_frames._server.turn(idle=False):
        pass
    assert key_frames._client.sent == [] and not key_frames._running


def test_a_video_that_fails_says_why(key_frames, monkeypatch):
    def full(*_):
        raise UserError("the disk is full: free some space")

    monkeypatch.setattr(video, "write", full)
    monkeypatch.setattr(video, "check", lambda: None)
    key_frames.add()
    key_frames.add()
    key_frames.start()
    while key_frames._running:
        assert key_frames._server.turn(idle=False)
    assert key_frames._told.content == "the disk is full: free some space" and key_frames._client.sent == []
