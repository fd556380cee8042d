"""The page of a run and of a suite: figures as in metrics.json, nothing from outside, names that do no harm."""

import re
from html import unescape
from urllib.parse import unquote

import numpy as np
import pytest
import yaml

from rgs_mi import report
from rgs_mi.evaluation.evaluate import SCORES
from rgs_mi.fit.curves import Curves
from rgs_mi.report import figures, html, tables

from pages import Parsed, metrics

FIGURES = ("surfels", "render_fps", "train_seconds", "iterations", "peak_rss_mb")


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
    assert marked == [
        "minutes",
        "iterations",
        "rfilter",
        "mask_rim",
        "light",
        "checkpoint_seconds",
        "stages",
        "until",
        "until",
        "surfels",
        "max_surfels",
    ]


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


# ---- Figures and addresses ----


def test_figures_in_words():
    text = figures.text
    assert text("psnr", 30.868) == "30.87" and text("psnr", 30.868, unit=True) == "30.87 dB"
    assert text("normal_mae_deg", -2.5, signed=True) == "-2.50°" and text("lpips", 0.05, signed=True) == "+0.0500"
    assert text("surfels", 1.4e6) == "1 400 000" and text("train_seconds", 200, unit=True) == "3.3 min"
    assert text("ssim", 0.9756, paper=True) == "0.976" and text("ssim", None) == ""
    assert [figures.heading(name) for name in ("psnr", "ssim", "normal_mae_deg", "peak_rss_mb")] == [
        "PSNR, dB",
        "SSIM",
        "normal error",
        "memory, MB",
    ]


@pytest.mark.parametrize("path", ["javascript:alert(1)", "a b/#c?d", "//host/x", "../x"])
def test_addresses_are_of_files(path):
    address = html.href(path)
    assert address.startswith("./") and not set(address) & set(":?# ") and unquote(address) == f"./{path}"


def test_cells_are_no_formulas():
    """Words that a spreadsheet would calculate with are words; numbers with a sign are numbers."""
    row = {"scene": "=1+1", "error": "@x", "note": "-a", "sum": "+0.5", "psnr": -1.5, "none": None}
    assert tables.csv_text([row]) == "scene,error,note,sum,psnr,none\n'=1+1,'@x,'-a,+0.5,-1.5,\n"
    assert tables.csv_text([], ["a", "b"]) == "a,b\n"
