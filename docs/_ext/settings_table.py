"""The directive ``settings``: every setting of a fit with its type, default, range and explanation, from the models."""

import dataclasses
import inspect
import re
import typing
from importlib import import_module

from docutils import nodes
from docutils.parsers.rst import Directive
from plugin_pages import table

_HEADER = ("Setting", "Type", "Default", "Range", "What it says")


def model():
    """The class of all settings, wherever it lives."""
    try:
        return import_module("rgs_mi.settings.settings").Settings
    except ModuleNotFoundError:
        return import_module("rgs_mi.settings").Settings


def walk(cls):
    """(name, annotation, default, low, high, explanation) of each field of a model. All that knows the models' form."""
    if hasattr(cls, "model_fields"):  # pydantic
        for name, field in cls.model_fields.items():
            bound = {k: getattr(m, k) for m in field.metadata for k in ("ge", "le", "gt", "lt") if hasattr(m, k)}
            yield (
                name,
                field.annotation,
                field.get_default(call_default_factory=True),
                bound.get("ge", bound.get("gt")),
                bound.get("le", bound.get("lt")),
                field.description or "",
            )
        return
    hints, source = typing.get_type_hints(cls), inspect.getsource(cls)
    for field in dataclasses.fields(cls):
        factory = field.default_factory
        default = field.default if factory is dataclasses.MISSING else factory()
        yield (
            field.name,
            hints[field.name],
            default,
            field.metadata.get("min"),
            field.metadata.get("max"),
            _comment(source, field.name),
        )


def _comment(source, name):
    """The comment behind a dataclass's field, or else the ones above it."""
    above = []
    for line in map(str.strip, source.splitlines()):
        if line.startswith("#"):
            above.append(line[1:].strip())
            continue
        if re.match(rf"{name}\s*:", line):
            behind = line.partition("  # ")[2]
            return behind or " ".join(above)
        above = []
    return ""


class SettingsTable(Directive):
    """A table of the settings at the top, and one of each section."""

    def run(self):
        return list(_tables(model(), ""))


def _tables(cls, prefix):
    rows, below = [], []
    for name, annotation, default, low, high, text in walk(cls):
        if _is_model(annotation):
            below.append((annotation, f"{prefix}{name}."))
            continue
        rows.append(
            [_code(prefix + name), _code(_type(annotation)), _code(_value(default)), _plain(_range(low, high)), _plain(text)]
        )
    if prefix:
        yield nodes.rubric(text=prefix[:-1])
        yield nodes.paragraph(text=" ".join((inspect.getdoc(cls) or "").split()))
    yield table(_HEADER, rows)
    for annotation, path in below:
        yield from _tables(annotation, path)


def _is_model(annotation):
    return isinstance(annotation, type) and (hasattr(annotation, "model_fields") or dataclasses.is_dataclass(annotation))


def _type(annotation):
    """A type hint as one reads it in YAML."""
    if annotation is type(None):
        return "null"
    if typing.get_origin(annotation) is typing.Literal:
        return " | ".join(map(str, typing.get_args(annotation)))
    if isinstance(annotation, type) and not typing.get_args(annotation):
        return annotation.__name__
    if typing.get_origin(annotation) in (tuple, list):
        items = typing.get_args(annotation)
        return (
            f"list of {_type(items[0])}" if items[-1] is Ellipsis or len(items) == 1 else f"{len(items)} × {_type(items[0])}"
        )
    if typing.get_origin(annotation) is dict:
        return "mapping"
    return " | ".join(_type(a) for a in typing.get_args(annotation)) or str(annotation)


def _value(default):
    """A default as one writes it in YAML."""
    if default is None or isinstance(default, bool):
        return "null" if default is None else str(default).lower()
    if isinstance(default, tuple | list):
        return "[" + ", ".join(map(_value, default)) + "]"
    if dataclasses.is_dataclass(default) or hasattr(type(default), "model_fields"):
        return "{" + ", ".join(f"{name}: {_value(getattr(default, name))}" for name, *_ in walk(type(default))) + "}"
    return f"{default:g}" if isinstance(default, float) else str(default)


def _range(low, high):
    if low is None and high is None:
        return ""
    return (
        f"{_value(low)} to {_value(high)}"
        if None not in (low, high)
        else f"at least {_value(low)}"
        if high is None
        else f"at most {_value(high)}"
    )


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
