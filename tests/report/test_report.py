"""The page of a run and of a suite: figures as in metrics.json, nothing from outside, controls that move in a browser."""

import json
import re
import shutil
import sys
from html import unescape
from html.parser import HTMLParser
from urllib.parse import unquote

import numpy as np
import pytest
import yaml

from rgs_mi import report
from rgs_mi.core.color import srgb_encode
from rgs_mi.core.errors import UserError
from rgs_mi.datasets.types import View
from rgs_mi.evaluation.evaluate import SCORES, Rendering
from rgs_mi.evaluation.metrics import normal_mae_deg
from rgs_mi.evaluation.pictures import NORMAL_RANGE, RAMP, panels, ramp
from rgs_mi.fit.curves import STRETCHES, Curves
from rgs_mi.report import html, plots

import browser
from scenes import orbit_camera

FIGURES = ("surfels", "render_fps", "train_seconds", "iterations", "peak_rss_mb")
SMALL = [
    "iterations=12",
    "initialization.surfels=300",
    "checkpoint_seconds=0",
    "stages=[{until: 0.5, downscale: 2}, {views: 2}]",
    "minutes=null",
]


class Parsed(HTMLParser):
    """``figures``: data-figure -> value, ``words``: as it is shown; ``pictures``: their alt texts; ``addresses``: what a
    browser would load; ``links``; ``pre``: texts."""

    def __init__(self, text):
        super().__init__()
        self.figures, self.words, self.pictures, self.addresses, self.links, self.pre = {}, {}, [], [], [], []
        self._figure = self._in_pre = None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == "data":
            self._figure = attributes["data-figure"]
            value = float(attributes["value"])
            assert self.figures.setdefault(self._figure, value) == value
        elif tag == "img" and "hidden" not in attributes:
            self.pictures.append(attributes["alt"])
        elif tag == "a":
            self.links.append(attributes["href"])
        elif tag == "pre":
            self._in_pre = True
            self.pre.append("")
        self.addresses += [attributes[name] for name in ("src", "srcset", "poster") if name in attributes]
        self.addresses += [attributes["href"]] if tag == "link" else []

    def handle_data(self, data):
        if self._figure:
            self.words[self._figure] = data
        if self._in_pre:
            self.pre[-1] += data

    def handle_endtag(self, tag):
        self._figure = None
        if tag == "pre":
            self._in_pre = None


@pytest.fixture(scope="module")
def run(inputs, tmp_path_factory):
    """The folder of a finished run, with event files."""
    from rgs_mi.commands.optimize import optimize

    folder = tmp_path_factory.mktemp("runs") / "a <ball> & 'more'"
    scene, data = inputs
    return optimize(scene, data=data, out=folder, overrides=SMALL, quiet=True, tensorboard=True)


def metrics(run):
    return json.loads((run / "metrics.json").read_text())


# ---- The page of a run ----


def test_figures_are_those_of_metrics(run):
    """Every number once or more, in full in the data element, and rounded before the reader's eyes."""
    figures, parsed = metrics(run), Parsed((run / report.REPORT).read_text())
    expected = {name: figures[name] for name in (*SCORES, *FIGURES)}
    for view, scores in figures["views"].items():
        expected |= {f"views/{view}/{name}": value for name, value in scores.items()}
    expected = {name: value for name, value in expected.items() if value is not None}
    assert len(expected) > 12
    assert parsed.figures == expected
    assert float(parsed.words["ssim"]) == pytest.approx(figures["ssim"], abs=5.1e-5)
    assert float(parsed.words["views/r_1/psnr"].split()[0]) == pytest.approx(figures["views"]["r_1"]["psnr"], abs=5.1e-3)


def test_nothing_comes_from_outside(run):
    text = (run / report.REPORT).read_text()
    parsed = Parsed(text)
    assert len(parsed.addresses) > 20 and all(address.startswith("data:") for address in parsed.addresses)
    assert not re.search(r"url\((?!#)|@import|fetch\(|https?://", text)
    assert all((run / link).exists() for link in parsed.links)
    assert len(text) < 4e6


def test_pictures_say_what_they_are(run):
    pictures = Parsed((run / report.REPORT).read_text()).pictures
    assert all(pictures) and len(set(pictures)) == len(pictures)
    for kind in (
        "normals",
        "true normals",
        "normal error",
        "error",
        "diffuse",
        "specular",
        "roughness",
        "metallic",
        "base color",
        "depth",
    ):
        assert f"{kind} of view r_1" in pictures


def test_settings_are_yaml_and_marked(run):
    text, figures = (run / report.REPORT).read_text(), metrics(run)
    shown, command = Parsed(text).pre
    assert yaml.safe_load(shown) == figures["settings"]
    assert command == figures["command"]
    marked = [unescape(line).split(":")[0].strip(" -{") for line in re.findall("<mark>(.*?)</mark>", text)]
    assert marked == ["minutes", "iterations", "checkpoint_seconds", "stages", "until", "until", "surfels"]


def test_names_are_escaped(run):
    assert "<ball>" not in (run / report.REPORT).read_text()


def test_nothing_held_out(run, tmp_path):
    """Then no figure of quality is made up, and the page says why."""
    figures = metrics(run) | dict.fromkeys(SCORES) | {"views": {}, "test_views": 0}
    report.write(tmp_path, figures, Curves(), {}, np.ones((4, 8, 3)))
    text = (tmp_path / report.REPORT).read_text()
    assert "Nothing was held out" in text and not set(Parsed(text).figures) & set(SCORES)
    assert "Nothing was held out" not in (run / report.REPORT).read_text()


def test_a_stopped_fit_says_so(run, tmp_path):
    report.write(tmp_path, metrics(run) | {"finished": False}, Curves(), {}, np.ones((4, 8, 3)))
    assert "stopped before its end" in (tmp_path / report.REPORT).read_text()
    assert "stopped before its end" not in (run / report.REPORT).read_text()


# ---- Curves ----


def test_curves_of_a_run(run):
    lines = (run / "curves.csv").read_text().splitlines()
    rows = [dict(zip(lines[0].split(","), line.split(","))) for line in lines[1:]]
    assert [int(row["step"]) for row in rows] == list(range(1, 13))
    assert [row["pixels"] for row in rows] == ["16"] * 6 + ["32"] * 6
    assert {"loss.photometric", "loss.mask", "loss.consistency", "loss.normal", "loss.minimum_variation"} <= set(rows[0])
    assert all(float(row["ms"]) > 0 and float(row["psnr"]) > 0 and int(row["surfels"]) > 0 for row in rows)
    assert float(rows[-1]["seconds"]) == pytest.approx(metrics(run)["train_seconds"])


def test_curves_average_stretches():
    curves, steps = Curves(), 10 * STRETCHES
    complete = [
        curves.add(k / steps, {"step": k}, {"psnr": float(k), "ms": float("nan") if k % 2 else 1.0}) for k in range(steps)
    ]
    assert len(curves.rows) == sum(complete) == STRETCHES and curves.rows[-1]["step"] == steps - 10
    assert curves.rows[2] == {"step": 20, "psnr": np.mean(range(11, 21)), "ms": 1.0}


def test_curves_survive_a_checkpoint(inputs):
    """And with a longer budget, which makes the progress go back, more rows follow."""
    from rgs_mi.commands.optimize import start
    from rgs_mi.fit.scene import FitScene
    from rgs_mi.fit.trainer import Fit

    scene = FitScene.load(*inputs)
    settings = scene.settings(None, SMALL)
    dataset = scene.dataset(quiet=True)
    fit = start(scene, dataset, settings)
    fit.step()
    arrays, meta = fit.state()
    again = Fit.resume(dataset, scene.settings(None, [*SMALL, "iterations=600"]), arrays, json.loads(json.dumps(meta)))
    assert again.step() and [row["step"] for row in again.curves.rows] == [1, 2]
    assert [row["step"] for row in fit.curves.rows] == [1]
    del meta["curves"]  # as version 0.1.0 wrote them
    assert Fit.resume(dataset, settings, arrays, meta).curves.rows == []


def test_plots():
    """Decades from below, what has no logarithm left out; the same SVG each time, without names of its own."""
    series = {"a": ([0, 1, 2], [1, 10, float("nan")]), "b <": ([0, 2], [0.1, 0.0])}
    (axes,) = plots.draw(series, "x", "y", {"bound": 5}, {"mark": 1}, 0.0, True).axes
    assert [line.get_xydata().tolist() for line in axes.lines[:2]] == [[[0, 1], [1, 10]], [[0, 0.1]]]
    assert axes.get_yscale() == "log" and axes.get_xlim()[0] == 0 and axes.get_ylim()[0] <= 0.1
    text = plots.curves(series, "x", "y <", {"bound": 5}, {"mark": 1}, log=True)
    assert text == plots.curves(series, "x", "y <", {"bound": 5}, {"mark": 1}, log=True)
    assert "b &lt;" in text and 'aria-label="y &lt; over x"' in text and "nan" not in text
    assert all(word in text for word in ("bound", "mark", ">0.1<", ">10<")) and not re.search(r' id="[\w.]+_\d', text)


@pytest.mark.parametrize("series", [{"constant": ([1, 2], [0, 0])}, {"nothing": ([], [])}, {}])
@pytest.mark.parametrize("log", [False, True])
def test_plots_of_little(series, log):
    assert plots.curves(series, "x", "y", log=log).startswith("<svg")


# ---- Pictures ----


def test_normal_error_has_the_angle():
    """The mean over the picture's degrees is the figure of metrics.json."""
    rng = np.random.default_rng(0)
    truth, normal = rng.normal(size=(2, 20, 20, 3)) + [4, 0, 0]
    truth /= np.linalg.norm(truth, axis=-1, keepdims=True)
    truth[:5] = 0  # unknown
    angles = (np.arange(0, 256) / 255, ramp(np.arange(0, 256) / 255) * 255)
    assert np.abs(np.diff(angles[1].mean(-1))).max() < 2  # no steps
    assert (np.diff(angles[1] @ [0.2126, 0.7152, 0.0722]) < 0).all()  # the larger the darker
    view = View("v", orbit_camera(0, size=(20, 20)), np.full((20, 20, 4), 255, np.uint8), False, truth, None)
    maps = {
        name: np.zeros((20, 20, 1 if name in ("roughness", "metallic", "depth") else 3))
        for name in ("color", "diffuse", "specular", "base_color", "roughness", "metallic", "depth")
    } | {"sh_normal": normal}
    shown = panels(view, Rendering(np.ones((20, 20, 3)), np.ones((20, 20, 1)), maps), 1.0)["normal error"]
    assert (shown[:5] == 255).all()
    nearest = np.abs(shown[5:, :, None].astype(float) - angles[1]).sum(-1).argmin(-1) / 255 * NORMAL_RANGE
    small = nearest < NORMAL_RANGE  # beyond, the ramp ends
    assert small.sum() > 100
    known = np.zeros((20, 20))
    known[5:][small] = 1
    assert nearest[small].mean() == pytest.approx(normal_mae_deg(normal, truth, known), abs=0.1)


def test_rgbe():
    rng = np.random.default_rng(1)
    radiance = np.exp(rng.normal(size=(8, 16, 3)) * 4)
    radiance[0, 0], radiance[0, 1] = 0, [-1, np.nan, 1e3]
    packed = html.rgbe(radiance).astype(float)
    light = packed[:8] * 2.0 ** (packed[8:] - 136)
    error = np.abs(light - np.maximum(np.nan_to_num(radiance), 0)) / np.maximum(radiance.max(-1, keepdims=True), 1e-9)
    assert np.nan_to_num(error).max() < 1 / 127 and (light[0, 0] == 0).all()
    assert light[0, 1, 2] == pytest.approx(1e3, rel=0.01)


def test_the_ramp_ends_as_it_says():
    assert (ramp(np.array([0.0, 1.0, 7.0])) == RAMP[[0, -1, -1]]).all()


# ---- The page of a suite ----


def test_suite(run, tmp_path):
    damaged, outside = tmp_path / "damaged", tmp_path / "suite" / "suite.html"
    damaged.mkdir()
    (damaged / "metrics.json").write_text('{"psnr": 3')
    runs = [
        ("ball", run, None),
        ("again", run, None),
        ("gone", None, "it <failed>"),
        ("damaged", damaged, None),
        ("nothing", None, None),
    ]
    report.write_suite(outside, runs, "Suite")
    text = outside.read_text()
    parsed, figures = Parsed(text), metrics(run)
    assert parsed.figures["ball/psnr"] == parsed.figures["mean/psnr"] == figures["psnr"]
    assert [(outside.parent / unquote(link)).resolve() for link in parsed.links] == [(run / report.REPORT).resolve()] * 2
    assert [alt.split()[0] for alt in parsed.pictures] == ["photograph", "rendering"] * 2
    assert "it &lt;failed&gt;" in text and "2 of 5" in text and str(damaged / "metrics.json") in text
    assert text.count('<tr class="bad">') == 3
    report.write_suite(outside, [], "Nothing")


# ---- TensorBoard ----


def test_event_files(run):
    from tensorboardX.proto.event_pb2 import Event

    (path,) = (run / "tensorboard").glob("events.out.tfevents.*")
    data, events = path.read_bytes(), []
    while data:
        length = int.from_bytes(data[:8], "little")
        events.append(Event.FromString(data[12 : 12 + length]))
        data = data[16 + length :]
    scalars = {(event.step, value.tag): value.simple_value for event in events for value in event.summary.value}
    lines = (run / "curves.csv").read_text().splitlines()
    names = lines[0].split(",")
    for line in lines[1:]:
        row = dict(zip(names, map(float, line.split(","))))
        assert all(
            scalars.pop((row["step"], name.replace(".", "/"))) == pytest.approx(value)
            for name, value in row.items()
            if name != "step"
        )
    assert not scalars


def test_tensorboard_is_missing(inputs, tmp_path, monkeypatch):
    from rgs_mi.commands.optimize import optimize

    monkeypatch.setitem(sys.modules, "tensorboardX.event_file_writer", None)
    with pytest.raises(UserError, match="pip install tensorboardX"):
        optimize(inputs[0], data=inputs[1], out=tmp_path / "run", overrides=SMALL, quiet=True, tensorboard=True)
    assert not (tmp_path / "run").exists()


# ---- In a browser ----

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
