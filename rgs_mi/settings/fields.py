"""What the models of settings say, in words: for messages, ``--help`` and the documentation."""

import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

_NAMES = {
    bool: ("true or false", "true or false"),
    int: ("an integer", "integers"),
    float: ("a number", "numbers"),
    str: ("a string", "strings"),
    Path: ("a path", "paths"),
    Any: ("a value", "values"),
}


@dataclass(frozen=True)
class Setting:
    """A setting: its dotted ``key``, ``kind`` and ``range`` of its values, ``default`` as YAML writes it, and what it means;
    ``section`` is its class where it holds settings itself."""

    key: str
    kind: str
    range: str
    default: str
    description: str
    section: type | None


def fields(cls: Any, prefix: str = "") -> Iterator[Setting]:
    """Yield the settings of the model ``cls`` itself, their keys after ``prefix``."""
    for name, field in cls.__pydantic_fields__.items():
        low, high = _bounds(field.annotation, field.metadata)
        yield Setting(
            prefix + name,
            kind(field.annotation),
            _range(low, high),
            in_yaml(field.get_default(call_default_factory=True)),
            field.description or "",
            section(field.annotation),
        )


def walk(cls: Any, prefix: str = "") -> Iterator[Setting]:
    """Yield all settings of the model ``cls`` and of its sections, which are left out themselves."""
    for setting in fields(cls, prefix):
        if setting.section:
            yield from walk(setting.section, f"{setting.key}.")
        else:
            yield setting


def section(annotation: Any) -> type | None:
    """Return the model that ``annotation`` is, or is optionally; None where it is none."""
    return next((a for a in (annotation, *_alternatives(annotation)) if isinstance(a, type) and is_dataclass(a)), None)


def expected(cls: Any, location: Sequence[str | int]) -> str:
    """Return in words what must stand at ``location``, keys and indices, in the model ``cls``; '' where there is nothing."""
    found = _at(cls, location)
    return ", ".join(filter(None, (kind(found[0]), _range(*_bounds(*found))))) if found else ""


def section_at(cls: Any, location: Sequence[str | int]) -> type | None:
    """Return the model at ``location`` in the model ``cls``; None where something else stands."""
    found = _at(cls, location)
    return section(found[0]) if found else None


def _at(annotation, location, metadata=()):
    """The annotation and the metadata of what stands at ``location``, or None."""
    if not location:
        return annotation, metadata
    step, *rest = location
    if model := section(annotation):
        field = model.__pydantic_fields__.get(step)
        return field and _at(field.annotation, rest, field.metadata)
    annotation = next(filter(get_args, _alternatives(annotation)), annotation)
    items = get_args(annotation)
    if get_origin(annotation) is dict:
        return _at(items[1], rest)
    if get_origin(annotation) is not tuple:
        return None
    return _at(items[0 if Ellipsis in items else step], rest)


def kind(annotation: Any) -> str:
    """Return a type hint in words."""
    annotation, items = _bare(annotation), get_args(_bare(annotation))
    if annotation is types.NoneType:
        return "null"
    if get_origin(annotation) is Literal:
        return "one of " + ", ".join(map(repr, items))
    if _alternatives(annotation):
        return " or ".join(map(kind, items))
    if section(annotation) or get_origin(annotation) is dict:
        return "a mapping"
    if get_origin(annotation) is tuple:
        number = "" if Ellipsis in items else f"{len(items)} "
        return f"a list of {number}{_NAMES.get(_bare(items[0]), ('', 'mappings'))[1]}"
    return _NAMES[annotation][0]


def in_yaml(value: Any) -> str:
    """Return a value as one writes it in YAML."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(in_yaml, value)) + "]"
    if isinstance(value, dict) or is_dataclass(value):
        items = value if isinstance(value, dict) else vars(value)
        return "{" + ", ".join(f"{k}: {in_yaml(v)}" for k, v in items.items() if not k.startswith("_")) + "}"
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _bare(annotation):
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _alternatives(annotation):
    return get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else ()


def _bounds(annotation, metadata):
    """(lowest, highest) of the numbers of a field, each None where there is none."""
    if get_origin(annotation) is Annotated:
        metadata = [*metadata, *getattr(get_args(annotation)[1], "metadata", ())]
    found = {name: getattr(m, name) for m in metadata for name in ("ge", "le") if hasattr(m, name)}
    for item in () if found else get_args(annotation):
        if (bounds := _bounds(item, ())) != (None, None):
            return bounds
    return found.get("ge"), found.get("le")


def _range(low, high) -> str:
    if low is None and high is None:
        return ""
    if None not in (low, high):
        return f"between {in_yaml(low)} and {in_yaml(high)}"
    return f"at most {in_yaml(high)}" if low is None else f"at least {in_yaml(low)}"
