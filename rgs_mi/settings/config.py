"""Settings: frozen dataclasses filled from YAML, presets and ``--set a.b=value``.

The dataclass is the specification: its defaults, type hints and ``field(metadata={"min": .., "max": ..})`` are all
there is to say about a setting. Every mistake in a file is one line that names the file, the key and the remedy.
"""

import dataclasses
import difflib
import math
import os
import re
import types
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from ..core.errors import UserError

T = TypeVar("T")


def load_config(cls: type[T], sources=(), overrides=()) -> T:
    """An instance of the dataclass ``cls``: its defaults, then each source, then each override; the later wins.

    Args:
      cls:       a dataclass; fields may be bool, int, float, str, Path, Literal, Optional and other unions, tuple,
                 list, dict, or dataclasses of these. Metadata ``min`` and ``max`` bound a field's numbers, inclusively.
      sources:   YAML files, and names of presets (no '/' and no '.yaml') that the package ships
      overrides: strings 'a.b=value', where the value is YAML

    Raises: UserError for an unknown preset or key, a wrong type, a number out of range or NaN, malformed YAML, and
      where a dataclass refuses its values (a ValueError in ``__post_init__``).
    """
    tree = {}
    for source in sources:
        text, label = _read(source)
        data = _parse(text, label)
        _Reader(cls, label).merge(cls, tree, {} if data is None else data, "")
    for override in overrides:
        keys, separator, text = override.partition("=")
        label = f"--set {override}"
        if not separator or not keys.strip():
            raise UserError(f"{label}: expected a key and a value, as in --set a.b=1")
        value = _parse(text, label)
        for key in reversed(keys.strip().split(".")):
            value = {key: value}
        _Reader(cls, label).merge(cls, tree, value, "")
    return _build(cls, tree, ", ".join([*map(str, sources), *(f"--set {o}" for o in overrides)]) or cls.__name__)


def to_dict(config) -> dict:
    """The settings as nested dicts, lists, numbers and strings, for JSON."""
    return {f.name: _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}


def completed(cls, tree: dict) -> dict:
    """What `to_dict` once gave for a ``cls``, and JSON kept, as it would be now: settings that came later have their
    defaults, those that are gone are left out."""

    def fill(tree, defaults):
        return {k: fill(tree.get(k, {}), v) if isinstance(v, dict) and v else tree.get(k, v) for k, v in defaults.items()}

    return fill(tree, to_dict(cls()))


def presets() -> list[str]:
    """Names of the presets that the package ships."""
    return sorted(p.name[:-5] for p in _preset_folder().iterdir() if p.name.endswith(".yaml"))


# ---- Sources ----


def _preset_folder():
    return resources.files(__package__) / "presets"


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
        return path.read_text(encoding="utf-8"), name
    except OSError as error:
        raise UserError(f"{name}: can't be read ({error.strerror}): check the path") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{name}: is not UTF-8 text at byte {error.start}: save it as UTF-8") from error


class _Loader(yaml.SafeLoader):
    """YAML with the scalars of version 1.2: 1e-3 is a number, and ``off``, 1:30 and 2026-01-01 are strings. A key that
    appears twice is an error."""

    yaml_implicit_resolvers = {}

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise yaml.MarkedYAMLError(problem=f"'{key.value}' appears twice", problem_mark=key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


for _tag, _pattern in {
    "null": r"(?:~|null|Null|NULL|)",
    "bool": r"(?:true|True|TRUE|false|False|FALSE)",
    "int": r"[-+]?(?:0|[1-9][0-9_]*)",
    "float": r"[-+]?(?:(?:[0-9][0-9_]*\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|\.(?:inf|Inf|INF))|\.(?:nan|NaN|NAN)",
    "merge": r"<<",
}.items():
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern})\Z"), None)


def _parse(text, label):
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        where = f"{label}, line {error.problem_mark.line + 1}" if error.problem_mark else label
        raise UserError(f"{where}: malformed YAML ({error.problem}): mind indentation, colons and quotes") from error
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{label}: malformed YAML ({reason}): save it as plain text") from error


# ---- Checking ----


class _Reader:
    """Checks the values of one source; ``label`` names it in messages, ``root`` is where suggestions come from."""

    def __init__(self, root, label):
        self.root, self.label = root, label

    def merge(self, cls, tree, data, path):
        """Check ``data`` against the dataclass and put it into the nested dict ``tree``."""
        if not isinstance(data, dict):
            raise self._wrong_type(path, "a mapping of keys to values", data)
        hints = get_type_hints(cls)
        fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
        for name, value in data.items():
            key = f"{path}.{name}" if path else str(name)
            if name not in fields:
                raise UserError(f"{self.label}: unknown key '{key}': {self._suggestion(key, path, fields)}")
            hint, nested = hints[name], _dataclass_in(hints[name])
            if nested and isinstance(value, dict):
                if not isinstance(tree.get(name), dict):
                    tree[name] = {}
                self.merge(nested, tree[name], value, key)
            elif nested is hint and value is None:
                pass  # a section whose keys are all commented out
            else:
                tree[name] = self._coerce(value, hint, key)
                self._check_range(tree[name], fields[name].metadata, key)

    def _coerce(self, value, hint, key):
        origin, arguments = get_origin(hint), get_args(hint)
        if hint is Any:
            return value
        if origin in (Union, types.UnionType):
            return self._coerce_union(value, hint, arguments, key)
        if origin is Literal:
            if any(value == a and type(value) is type(a) for a in arguments):
                return value
        elif dataclasses.is_dataclass(hint):
            tree = {}
            self.merge(hint, tree, value, key)
            return _build(hint, tree, f"{self.label}: {key}")
        elif hint is None or hint is types.NoneType:
            if value is None:
                return None
        elif hint is float and type(value) in (int, float):
            if value != value:
                raise UserError(f"{self.label}: '{key}' is NaN: give a number")
            return float(str(value))  # unlike float(value) this makes an integer beyond 1e308 infinite
        elif hint is int and type(value) is float and value.is_integer():  # 3e4
            return int(value)
        elif hint in (bool, int, str) and type(value) is hint:
            return value
        elif hint is Path and isinstance(value, str):
            return Path(value)
        elif (origin or hint) in (tuple, list) and isinstance(value, list):
            return self._coerce_sequence(value, origin or hint, arguments, hint, key)
        elif (origin or hint) is dict and isinstance(value, dict):
            of_key, of_value = arguments or (Any, Any)
            return {self._coerce(k, of_key, key): self._coerce(v, of_value, f"{key}.{k}") for k, v in value.items()}
        raise self._wrong_type(key, _describe(hint), value)

    def _coerce_union(self, value, hint, choices, key):
        exact = [c for c in choices if c is type(value)]  # 1 stays an int where float | int asks for either
        nested = [c for c in choices if dataclasses.is_dataclass(c)] if isinstance(value, dict) else []
        if nested:
            return self._coerce(value, nested[0], key)
        for choice in exact + list(choices):
            try:
                return self._coerce(value, choice, key)
            except UserError:
                continue
        raise self._wrong_type(key, _describe(hint), value)

    def _coerce_sequence(self, value, kind, arguments, hint, key):
        if kind is tuple and arguments and arguments[-1] is not Ellipsis:
            if len(value) != len(arguments):
                raise self._wrong_type(key, _describe(hint), value)
        else:
            arguments = (arguments[0] if arguments else Any,) * len(value)
        return kind(self._coerce(v, a, f"{key}[{i}]") for i, (v, a) in enumerate(zip(value, arguments)))

    def _check_range(self, value, metadata, key):
        if isinstance(value, tuple | list):
            for i, item in enumerate(value):
                self._check_range(item, metadata, f"{key}[{i}]")
        elif type(value) in (int, float):
            low, high = metadata.get("min", -math.inf), metadata.get("max", math.inf)
            if not low <= value <= high:
                allowed = (
                    f"at least {low}"
                    if high == math.inf
                    else f"at most {high}"
                    if low == -math.inf
                    else f"between {low} and {high}"
                )
                raise UserError(f"{self.label}: '{key}' is {value}: it must be {allowed}")

    def _wrong_type(self, key, expected, value):
        where = f"'{key}'" if key else "the file"
        return UserError(f"{self.label}: {where} must be {expected}, got {_describe_value(value)}")

    def _suggestion(self, key, path, fields):
        near = difflib.get_close_matches(key, _all_keys(self.root, ""), 1)
        if near:
            return f"did you mean '{near[0]}'?"
        return f"{f'{path!r}' if path else 'the top level'} has {', '.join(fields)}"


def _dataclass_in(hint):
    """The dataclass that ``hint`` is, or is optionally; else None."""
    if dataclasses.is_dataclass(hint):
        return hint
    if get_origin(hint) in (Union, types.UnionType):
        return next((a for a in get_args(hint) if dataclasses.is_dataclass(a)), None)
    return None


def _all_keys(cls, path):
    """Dotted paths of every setting below the dataclass."""
    hints = get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if field.init:
            key = f"{path}{field.name}"
            yield key
            if nested := _dataclass_in(hints[field.name]):
                yield from _all_keys(nested, f"{key}.")


def _build(cls, tree, label, base=None):
    """The dataclass from checked values; what the tree lacks is as in ``base``, or else the default."""
    hints = get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls)}
    values = {}
    for name, value in tree.items():
        nested = _dataclass_in(hints[name])
        if nested and isinstance(value, dict):
            below = _default(fields[name]) if base is None else getattr(base, name)
            value = _build(nested, value, label, below)
        values[name] = value
    try:
        return cls(**values) if base is None else dataclasses.replace(base, **values)
    except (TypeError, ValueError) as error:  # a field without a default, or what __post_init__ refuses
        raise UserError(f"{label}: {error}") from error


def _default(field):
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def _describe(hint):
    """A type hint in words."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return "one of " + ", ".join(map(repr, arguments))
    if origin in (Union, types.UnionType):
        return " or ".join(map(_describe, arguments))
    if origin is tuple and Ellipsis not in arguments:
        return f"a list of {len(arguments)} ({', '.join(map(_describe, arguments))})"
    if (origin or hint) in (tuple, list):
        return f"a list of {_describe(arguments[0])}" if arguments else "a list"
    if dataclasses.is_dataclass(hint) or (origin or hint) is dict:
        return "a mapping of keys to values"
    names = {bool: "true or false", int: "an integer", float: "a number", str: "a string", Path: "a path"}
    return names.get(hint, "null" if hint is types.NoneType else str(hint))


def _describe_value(value):
    if value is None:
        return "nothing"
    kinds = {int: "the number ", float: "the number ", str: "the string ", list: "the list ", dict: "the mapping "}
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return kinds.get(type(value), "") + (text if len(text) <= 60 else text[:57] + "...")


def _plain(value):
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return str(value) if isinstance(value, Path) else value
