"""`rgs_mi.viewer.show`, in an event loop as a notebook's, and without one."""

import asyncio
import threading

import pytest

from rgs_mi.core.errors import UserError
from rgs_mi.core.scene_files import load_scene
from rgs_mi.viewer import notebook, show
from rgs_mi.viewer.look import Look
from rgs_mi.viewer.server import Server
from rgs_mi.viewer.window import Window

from scenes import orbit_camera
from windows import Panel


def test_it_renders_between_cells(scene_file):
    """In the loop's own thread, and no other."""
    threads = set()

    async def cells():
        shown = show(load_scene(scene_file, {}))
        server, window, panel = shown._server, Window(Look(orbit_camera(0.7, size=(56, 48)))), Panel()
        assert f'src="{shown.address}"' in shown._repr_html_() and shown.address.startswith("http://localhost:")
        server.pace.seconds = {128: 0.01}
        server.windows[1], server._panels[1] = window, panel
        server._turns.append(1)
        work = window.work
        window.work = lambda *arguments: threads.add(threading.current_thread()) or work(*arguments)
        while not window.refined.complete:
            await asyncio.sleep(0.02)
        shown.stop()
        await asyncio.sleep(0)
        return panel.pictures

    assert asyncio.run(asyncio.wait_for(cells(), 100))[-1].quality is None
    assert threads == {threading.main_thread()}


def test_a_script_waits_for_ctrl_c(scene_file, monkeypatch, capsys):
    def run(server):
        raise KeyboardInterrupt

    monkeypatch.setattr(Server, "run", run)
    shown = show(load_scene(scene_file, {}))
    assert capsys.readouterr().out == f"{shown.address} (Ctrl-C closes it)\n"


def test_what_has_no_surfels(monkeypatch):
    import mitsuba as mi

    with pytest.raises(UserError, match="no surfels"):
        notebook.show(mi.load_dict({"type": "scene", "shape": {"type": "sphere"}}))
