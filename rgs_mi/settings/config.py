"""Settings from YAML, presets and ``--set a.b=value``.

The models (`settings`) say what a setting may be, and pydantic checks it. Every mistake in a file is one line that names the
file, the key and the remedy.
"""

import difflib
import json
import os
import re
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from ..core.errors import UserError
from ..core.inputs import SETTINGS, read_file
from .fields import expected, fields, section, section_at, walk

T = TypeVar("T")


def load_config(cls: type[T], sources: Iterable[str | Path] = (), overrides: Iterable[str] = ()) -> T:
    """Make an instance of the model ``cls``: its defaults, then each source, then each override; the later wins.

    Args:
      cls:       a frozen pydantic dataclass, all of whose fields have defaults
      sources:   YAML files, and names of presets (no '/' and no '.yaml') that the package ships
      overrides: strings 'a.b=value', where the value is YAML

    Raises: UserError for an unknown preset or key, a wrong type, a number out of range or NaN, malformed YAML, and
      where a model refuses its values.
    """
    config = cls()
    for source in sources:
        text, label = _read(source)
        data = _parse(text, label)
        config = _updated(config, {} if data is None else data, label)
    for override in overrides:
        keys, separator, text = override.partition("=")
        label = f"--set {override if len(override) <= 80 else override[:77] + '...'}"
        if not separator or not keys.strip():
            raise UserError(f"{label}: expected a key and a value, as in --set a.b=1")
        value = _parse(text, label)
        for key in reversed(keys.strip().split(".")):
            value = {key: value}
        config = _updated(config, value, label)
    return config


def to_dict(config: Any) -> dict:
    """Return the settings ``config`` as nested dictionaries, lists, numbers and strings, for JSON."""
    return TypeAdapter(type(config)).dump_python(config, mode="json")


def presets() -> list[str]:
    """Return the names of the presets that the package ships."""
    return sorted(p.name[:-5] for p in _preset_folder().iterdir() if p.name.endswith(".yaml"))


# ---- Sources ----


def _preset_folder():
    return resources.files("rgs_mi.settings") / "presets"


def _read(source):
    """(text, label for messages) of a file or a preset."""
    name = str(source)
    if "/" in name or os.sep in name or name.endswith((".yaml", ".yml")):
        path = Path(name)
    elif name in presets():
        path = _preset_folder() / f"{name}.yaml"
    else:
        raise UserError(
            f"no preset '{name}': choose one of {', '.join(presets()) or '(none)'}, or give a file as FOLDER/NAME.yaml"
        )
    try:
        return (read_file(path, SETTINGS) if isinstance(path, Path) else path.read_bytes()).decode("utf-8"), name
    except OSError as error:
        raise UserError(f"{name}: can't be read ({error.strerror}): check the path") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{name}: is not UTF-8 text at byte {error.start}: save it as UTF-8") from error


class _Loader(yaml.SafeLoader):
    """YAML with the scalars of version 1.2: 1e-3 is a number, 3e4 an integer, and ``off``, 1:30 and 2026-01-01 are strings. A
    key that appears twice is an error, and so is an alias, which could contain itself."""

    yaml_implicit_resolvers = {}

    def compose_node(self, parent, index):
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.MarkedYAMLError(problem=f"the alias *{event.anchor}", problem_mark=event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise yaml.MarkedYAMLError(problem=f"'{key.value}' appears twice", problem_mark=key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_yaml_float(self, node):
        value = super().construct_yaml_float(node)
        return int(value) if value.is_integer() else value


_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)
for _tag, _pattern in {
    "null": r"(?:~|null|Null|NULL|)",
    "bool": r"(?:true|True|TRUE|false|False|FALSE)",
    "int": r"[-+]?(?:0|[1-9][0-9_]*)",
    "float": r"[-+]?(?:(?:[0-9][0-9_]*\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|\.(?:inf|Inf|INF))|\.(?:nan|NaN|NAN)",
}.items():
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern})\Z"), None)


def _parse(text, label):
    """What the YAML says, of the types that JSON has."""
    try:
        return json.loads(json.dumps(yaml.load(text, _Loader), ensure_ascii=False).encode())
    except yaml.MarkedYAMLError as error:
        where = f"{label}, line {error.problem_mark.line + 1}" if error.problem_mark else label
        raise UserError(f"{where}: malformed YAML ({error.problem}): mind indentation, colons and quotes") from error
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{label}: malformed YAML ({reason}): save it as plain text") from error


# ---- Checking ----

_UNKNOWN = "unexpected_keyword_argument"  # what pydantic calls a key that is not there


def _updated(config: T, data, label) -> T:
    """``config`` with ``data`` over it. As it was valid before, whatever is wrong comes from ``label``."""
    cls = type(config)
    if not isinstance(data, dict):
        raise UserError(f"{label}: the file must be a mapping of keys to values, got {_described(data)}")
    tree = _merged(cls, to_dict(config), data)
    try:
        # strictly as JSON: lists are tuples and strings are paths there, but 'true' and "1" are no numbers
        return TypeAdapter(cls).validate_json(json.dumps(tree), strict=True)
    except ValidationError as error:
        unknown_first = sorted(error.errors(), key=lambda e: e["type"] != _UNKNOWN)
        raise UserError(f"{label}: {_message(cls, unknown_first[0])}") from error


def _merged(cls, tree, data) -> dict:
    """``data`` over ``tree``, section by section of the model ``cls``; nothing as a section is one that is left out."""
    tree = dict(tree)
    for name, value in data.items():
        field = cls.__pydantic_fields__.get(name)
        model = field and section(field.annotation)
        if model and isinstance(value, dict):
            tree[name] = _merged(model, tree.get(name) or {}, value)
        elif not (model is not None and model is field.annotation and value is None):
            tree[name] = value
    return tree


def _message(cls, error: ErrorDetails) -> str:
    """One of pydantic's errors in a line."""
    location, value = error["loc"], error["input"]
    if error["type"] == "json_invalid":
        return "values are nested too deeply: write fewer brackets"
    if error["type"] == "missing" and isinstance(location[-1], int):  # a list that is too short
        location = location[:-1]
    key = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in location).removeprefix(".")
    if error["type"] == _UNKNOWN:
        return f"unknown key '{key}': {_suggestion(cls, key, location)}"
    wanted = "" if error["type"] == "value_error" else expected(cls, location)
    if not location or not wanted:
        reason = str(error.get("ctx", {}).get("error", error["msg"]))
        return f"'{key}': {reason}" if key else reason
    if error["type"] == "missing" and location == error["loc"]:
        return f"'{key}' is missing: it must be {wanted}"
    return f"'{key}' must be {wanted}; got {_described(value)}"


def _suggestion(cls, key, location):
    """A key beside, or else one anywhere, that is spelled alike; or all keys beside."""
    prefix, name = key.removesuffix(str(location[-1])), str(location[-1])
    beside = [setting.key.removeprefix(prefix) for setting in fields(section_at(cls, location[:-1]), prefix)]
    if near := difflib.get_close_matches(name, beside, 1):
        return f"did you mean '{prefix}{near[0]}'?"
    known = [setting.key for setting in (*walk(cls), *fields(cls))]
    if near := [k for k in known if k.endswith(f".{name}")] or difflib.get_close_matches(key, known, 1):
        return f"did you mean '{near[0]}'?"
    return f"there are {', '.join(beside)}"


def _described(value) -> str:
    if value is None:
        return "nothing"
    kinds = {int: "the number ", float: "the number ", str: "the string ", list: "the list ", dict: "the mapping "}
    text = "NaN" if value != value else str(value).lower() if isinstance(value, bool) else repr(value)
    return kinds.get(type(value), "") + (text if len(text) <= 60 else text[:57] + "...")
