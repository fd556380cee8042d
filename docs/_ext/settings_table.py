"""The directive ``settings``: every setting of a fit with its values, default, range and explanation, from the models."""

import inspect
import re

from docutils import nodes
from docutils.parsers.rst import Directive
from plugin_pages import table

from rgs_mi.settings.fields import fields
from rgs_mi.settings.settings import Settings

_HEADER = ("Setting", "Value", "Default", "Range", "What it says")


class SettingsTable(Directive):
    """A table of the settings at the top, and one of each section."""

    def run(self):
        return list(_tables(Settings, ""))


def _tables(cls, prefix):
    settings = list(fields(cls, prefix))
    if prefix:
        yield nodes.rubric(text=prefix[:-1])
        yield nodes.paragraph(text=" ".join((inspect.getdoc(cls) or "").split()))
    yield table(
        _HEADER,
        [
            [_code(s.key), _plain(s.kind), _code(s.default), _plain(s.range), _plain(s.description)]
            for s in settings
            if not s.section
        ],
    )
    for setting in settings:
        if setting.section:
            yield from _tables(setting.section, f"{setting.key}.")


def _code(text):
    return [nodes.paragraph("", "", nodes.literal(text=text))]


def _plain(text):
    """A cell of prose, in which backticks set names apart."""
    parts = re.split(r"`+([^`]+)`+", text)
    inline = [nodes.literal(text=part) if i % 2 else nodes.Text(part) for i, part in enumerate(parts) if part]
    return [nodes.paragraph("", "", *inline)]


def setup(app):
    """Register with Sphinx."""
    app.add_directive("settings", SettingsTable)
    return {"parallel_read_safe": True}
