"""Pages in a headless Chromium, the system's own, which Playwright drives; tests that want one are skipped without it."""

import shutil
from contextlib import contextmanager

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_OPTIONS = (
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
_NO_GPU = ("--disable-gpu",)
_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


@contextmanager
def open_tab(dark: bool = False, webgl: bool = False):
    """An empty `playwright.sync_api.Page`, 1280 by 900. It has two lists more: ``errors``, what its documents complained
    about, and ``requests``, addresses that they asked for, but for data. ``webgl`` draws in software."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright: pip install playwright")
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if not program:
        pytest.skip("needs Chromium: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=program, args=_OPTIONS + (_WEBGL if webgl else _NO_GPU))
        page = chromium.new_page(viewport={"width": 1280, "height": 900}, color_scheme="dark" if dark else "light")
        page.errors, page.requests = [], []
        page.on("pageerror", lambda error: page.errors.append(str(error)))
        page.on("console", lambda message: page.errors.append(message.text) if message.type == "error" else None)
        page.on("request", lambda r: None if r.url.startswith("data:") else page.requests.append(r.url))
        yield page
        chromium.close()
