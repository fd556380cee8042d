"""Pages in a browser: nothing fails, nothing is fetched, and the controls do what they say."""

import shutil

import numpy as np
import pytest

from rgs_mi import report
from rgs_mi.core.color import srgb_encode
from rgs_mi.fit.curves import Curves
from rgs_mi.report import html

import browser
from pages import metrics

_CLIP = "getComputedStyle(document.querySelector('.compare img + img')).clipPath"
_PIXELS = """() => {
  const canvas = document.querySelector('.exposure canvas')
  return [canvas.width, canvas.height, ...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data]
}"""


@pytest.fixture(scope="module")
def tab():
    with browser.open_tab() as page:
        yield page


def test_a_run_in_a_browser(run, tab):
    """Nothing fails, nothing is fetched, all pictures load, and nothing is wider than the window."""
    tab.goto((run / report.REPORT).as_uri())
    assert tab.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    assert tab.evaluate("document.images.length") > 20 and tab.locator("svg").count() == 4
    for width in (1280, 360):
        tab.set_viewport_size({"width": width, "height": 900})
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
    tab.set_viewport_size({"width": 1280, "height": 900})
    assert tab.errors == [] and tab.requests == [(run / report.REPORT).as_uri()]


def test_controls(run, tab, tmp_path):
    """The line between two pictures follows the pointer and the keys; the environment is shown at the exposure."""
    environment = np.exp(np.random.default_rng(2).normal(size=(8, 16, 3)) * 2)
    environment[0, 0] = 0
    panels = {name: np.full((64, 64, 3), 40 * k, np.uint8) for k, name in enumerate(("photograph", "rendering", "error"))}
    curves = Curves([{"seconds": 1.0, "pixels": 9, "surfels": 5, "ms": 1.0, "psnr": 9.0}])
    report.write(tmp_path, metrics(run), curves, {"r_0": panels}, environment)
    tab.errors.clear()
    tab.goto((tmp_path / report.REPORT).as_uri())

    slider = tab.locator(".compare input")
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    assert "50%" in tab.evaluate(_CLIP)
    tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    tab.mouse.down()
    tab.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2, steps=4)
    tab.mouse.up()
    at = float(slider.input_value())
    assert 20 < at < 30 and f"{at:g}%" in tab.evaluate(_CLIP)
    slider.press("ArrowRight")
    assert f"{at + 0.5:g}%" in tab.evaluate(_CLIP)

    packed = html.rgbe(environment).astype(float)
    stored = packed[:8] * 2.0 ** (packed[8:] - 136)
    for stops in (0, -2.5, 3):
        tab.locator(".exposure input").fill(str(stops))
        assert tab.locator(".exposure output").inner_text() == f"{'+' * (stops > 0)}{stops:.1f} EV"
        width, height, *pixels = tab.evaluate(_PIXELS)
        expected = 255 * srgb_encode(np.clip(stored * 2.0**stops, 0, 1))
        shown = np.reshape(pixels, (height, width, 4))
        assert shown.shape == (8, 16, 4) and (shown[..., 3] == 255).all()
        assert np.abs(shown[..., :3] - expected).max() <= 0.51
    assert tab.errors == []


def test_links_are_never_live(run, tab, tmp_path):
    """A folder that is called like an address of another kind is a folder still."""
    folder = tmp_path / "javascript:document.title='x'?#"
    folder.mkdir()
    for name in ("metrics.json", report.REPORT):
        shutil.copy(run / name, folder)
    report.write_suite(tmp_path / "suite.html", [("odd", folder, None)], "Suite")
    tab.goto((tmp_path / "suite.html").as_uri())
    tab.locator("td a").click()
    assert tab.title() == run.name and tab.url == (folder / report.REPORT).as_uri()
