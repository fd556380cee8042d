"""Settings from YAML: what merges, what is coerced, and what each mistake says."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass

from rgs_mi.core.errors import UserError
from rgs_mi.settings import config, fields, settings
from rgs_mi.settings.config import load_config, presets, to_dict

MODEL = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, config=MODEL)
class Rates:
    position: float = 1.6e-4
    opacity: float = Field(0.05, ge=0, le=1)


@dataclass(frozen=True, config=MODEL)
class Stage:
    scale: float
    views: int = 1


@dataclass(frozen=True, config=MODEL)
class Settings:
    steps: int = Field(100, ge=1)
    name: str = "object"
    mask: bool = True
    specular: Literal["split_sum", "monte_carlo", "off"] = "split_sum"
    size: tuple[int, int] = (800, 600)
    weights: tuple[Annotated[float, Field(ge=0)], ...] = (1.0,)
    cap: int | None = None
    out: Path | None = None
    rates: Rates = Field(default_factory=lambda: Rates(position=0.5))
    stages: tuple[Stage, ...] = ()
    extra: Rates | None = None
    table: dict[str, float] = Field(default_factory=dict)

    def __post_init__(self):
        if self.cap is not None and self.cap < self.steps:
            raise ValueError("cap must not be below steps")


@pytest.fixture
def load(tmp_path):
    def load(*texts, overrides=()):
        paths = []
        for i, text in enumerate(texts):
            paths.append(tmp_path / f"{i}.yaml")
            paths[-1].write_text(text)
        return load_config(Settings, paths, overrides)

    return load


def test_defaults():
    assert load_config(Settings) == Settings()
    with pytest.raises(dataclasses.FrozenInstanceError):
        load_config(Settings).steps = 3


def test_merge(load):
    settings = load(
        "steps: 7\nrates: {opacity: 0.2}\nmask: false",
        "rates:\n  opacity: 0.3\nname: b\n",
        overrides=["steps=9", "size=[3, 4]"],
    )
    assert settings == Settings(steps=9, mask=False, name="b", size=(3, 4), rates=Rates(0.5, 0.3))


def test_empty(load):
    assert load("", "# nothing\n", "rates:\n  # position: 1\n") == Settings()


@pytest.mark.parametrize(
    "text, name, value",
    [
        ("rates: {position: 1e-3}", "rates", Rates(1e-3)),
        ("rates: {position: 1}", "rates", Rates(1.0)),
        ("rates: {position: 1e300}", "rates", Rates(1e300)),
        ("steps: 3e4", "steps", 30000),
        ("name: off", "name", "off"),
        ("name: 1:30", "name", "1:30"),
        ("specular: off", "specular", "off"),
        ("weights: [1, 2.5, 1e-3]", "weights", (1.0, 2.5, 1e-3)),
        ("weights: []", "weights", ()),
        ("cap: 500", "cap", 500),
        ("cap: null", "cap", None),
        ("out: runs/a", "out", Path("runs/a")),
        ("stages: [{scale: 1, views: 2}, {scale: 0.5}]", "stages", (Stage(1.0, 2), Stage(0.5))),
        ("extra: {opacity: 1}", "extra", Rates(opacity=1.0)),
        ("table: {a: 1}", "table", {"a": 1.0}),
    ],
)
def test_values(load, text, name, value):
    settings = load(text)
    assert getattr(settings, name) == value
    assert type(getattr(settings, name)) is type(value)


@pytest.mark.parametrize(
    "text, words",
    [
        ("step: 3", ["unknown key 'step'", "did you mean 'steps'"]),
        ("rates: {positon: 3}", ["'rates.positon'", "'rates.position'"]),
        ("opacity: 3", ["'opacity'", "'rates.opacity'"]),
        ("zzzzzzzzz: 3", ["'zzzzzzzzz'", "there are steps, name"]),
        ("3: 3", ["'3'"]),
        ("steps: many", ["'steps' must be an integer, at least 1; got the string 'many'"]),
        ("steps: 1.5", ["'steps'", "integer", "1.5"]),
        ("steps: true", ["'steps'", "integer", "true"]),
        ("steps:", ["'steps'", "got nothing"]),
        ("steps: 0", ["'steps'", "at least 1", "0"]),
        ("steps: '3'", ["'steps'", "an integer", "the string '3'"]),
        ("mask: 1", ["'mask'", "true or false"]),
        ("mask: yes", ["'mask'", "true or false"]),
        ("name: 3", ["'name'", "a string", "the number 3"]),
        ("specular: split", ["'specular'", "'split_sum', 'monte_carlo'"]),
        ("size: [1, 2, 3]", ["'size'", "list of 2"]),
        ("size: [1, a]", ["'size[1]'", "integer"]),
        ("size: [1]", ["'size' must be a list of 2 integers; got the list [1]"]),
        ("size: 3", ["'size'", "list of 2"]),
        ("weights: [1, -1]", ["'weights[1]'", "at least 0"]),
        ("cap: a", ["'cap'", "an integer or null"]),
        ("cap: 3", ["cap must not be below steps"]),
        ("rates: 3", ["'rates'", "mapping"]),
        ("rates: {opacity: 1.01}", ["'rates.opacity'", "between 0 and 1", "1.01"]),
        ("rates: {position: .nan}", ["'rates.position'", "a number", "NaN"]),
        ("rates: {position: .inf}", ["'rates.position'", "a number", "inf"]),
        (f"rates: {{position: {'9' * 400}}}", ["'rates.position'", "a number", "999..."]),
        ("rates: {opacity: true}", ["'rates.opacity'", "got true"]),
        ("stages: [{views: 1}]", ["'stages[0].scale' is missing"]),
        ("stages: [{scal: 1}]", ["'stages[0].scal'"]),
        ("stages: [{scale: 1, zzzzzzz: 1}]", ["'stages[0].zzzzzzz'", "there are scale, views"]),
        ("stages: [3]", ["'stages[0]' must be a mapping; got the number 3"]),
        ("table: {a: b}", ["'table.a' must be a number; got the string 'b'"]),
        ("extra: {opacity: x}", ["'extra.opacity'", "a number"]),
        ("- a", ["mapping"]),
        ("hello", ["mapping"]),
        ("steps: 3\n  mask: [", ["line 2", "malformed YAML"]),
        ("steps: 3\nname: a\nsteps: 4", ["line 3", "'steps' appears twice"]),
        ("steps: !!int ''", ["malformed"]),
        ("steps: !!python/object:os.system {}", ["malformed"]),
        ("? [a]\n: 3", ["malformed"]),
        ("a: \0", ["malformed"]),
        ("table: {a: !!binary aGk=}", ["malformed"]),
        ("rates: &r {position: 1}\nextra: *r", ["line 2", "malformed YAML", "alias *r"]),
        ("table: &t {a: *t}", ["line 1", "malformed YAML", "alias *t"]),
        ('name: "\\ud800"', ["surrogate"]),
    ],
)
def test_mistakes(load, tmp_path, text, words):
    with pytest.raises(UserError) as info:
        load(text)
    message = str(info.value)
    assert message.startswith(str(tmp_path / "0.yaml")) and "\n" not in message
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    "override, words",
    [
        ("steps", ["--set steps:", "a.b=1"]),
        ("=3", ["a.b=1"]),
        ("rates.opacty=1", ["--set rates.opacty=1", "'rates.opacity'"]),
        ("steps.a=1", ["'steps'", "an integer"]),
        ("size=[1", ["--set size=[1", "malformed"]),
        ("steps=nan", ["'steps'"]),
    ],
)
def test_override_mistakes(override, words):
    with pytest.raises(UserError) as info:
        load_config(Settings, overrides=[override])
    assert all(word in str(info.value) for word in words), str(info.value)


def test_presets(tmp_path, monkeypatch):
    monkeypatch.setattr(config, "_preset_folder", lambda: tmp_path)
    (tmp_path / "fast.yaml").write_text("steps: 5\n")
    (tmp_path / "paper.yaml").write_text("stepz: 5\n")
    assert load_config(Settings, ["fast"]).steps == 5
    with pytest.raises(UserError, match="no preset 'fsat': choose one of fast, paper"):
        load_config(Settings, ["fsat"])
    with pytest.raises(UserError, match="paper: unknown key"):
        load_config(Settings, ["paper"])


def test_files(tmp_path):
    with pytest.raises(UserError, match="missing.yaml: can't be read"):
        load_config(Settings, [tmp_path / "missing.yaml"])
    with pytest.raises(UserError, match="can't be read"):
        load_config(Settings, [tmp_path])
    (tmp_path / "latin.yaml").write_bytes("name: ä".encode("latin-1"))
    with pytest.raises(UserError, match="UTF-8"):
        load_config(Settings, [tmp_path / "latin.yaml"])


def test_to_dict(load):
    settings = load("out: a/b\nstages: [{scale: 1}]")
    data = json.loads(json.dumps(to_dict(settings)))
    assert data["out"] == "a/b" and data["size"] == [800, 600] and data["rates"] == {"position": 0.5, "opacity": 0.05}
    assert data["stages"] == [{"scale": 1.0, "views": 1}]


def test_replaced_values_are_checked():
    assert dataclasses.replace(Settings(), steps=3).steps == 3
    with pytest.raises(ValidationError):
        dataclasses.replace(Settings(), steps=0)


# ---- The settings themselves ----


def test_every_preset_can_be_read_and_kept():
    for name in presets():
        loaded = load_config(settings.Settings, [name])
        saved = json.loads(json.dumps(to_dict(loaded)))
        assert to_dict(loaded) == saved and load_config(settings.Settings, [name]) == loaded


def test_every_setting_says_what_it_means():
    for setting in fields.walk(settings.Settings):
        assert setting.description.endswith((".", ")")) and "\n" not in setting.description, setting.key
        numeric = "number" in setting.kind or "integer" in setting.kind
        assert bool(setting.range) == numeric or setting.key == "box", setting.key


@pytest.mark.parametrize("value", ["[-5,1]", "[1,.inf]", "[1,.nan]", "[1]", "1"])
def test_learning_rates_have_bounds(value):
    names = [setting.key for setting in fields.fields(settings.LearningRates, "learning_rates.")]
    for name in [*names, "weights.consistency"]:
        with pytest.raises(UserError, match=name.replace(".", r"\.")):
            load_config(settings.Settings, overrides=[f"{name}={value}"])


def test_a_period_ends_after_it_begins():
    assert load_config(settings.Settings, overrides=["relit=[0.5,0.5]"]).relit == (0.5, 0.5)
    with pytest.raises(UserError, match=r"--set relit=.*: 'relit': must not end before it begins; got \[0.9, 0.8\]"):
        load_config(settings.Settings, overrides=["relit=[0.9,0.8]"])


def test_the_kinds_in_words():
    known = {setting.key: setting for setting in fields.walk(settings.Settings)}
    assert known["minutes"].kind == "a number or null" and known["minutes"].range == "between 0.01 and 100000"
    assert known["learning_rates.centers"].kind == "a list of 2 numbers"
    assert known["relit"].kind == "a list of 2 numbers" and known["relit"].range == "between 0 and 1"
    assert known["learning_rates.centers"].default == "[0.0005, 1e-05]"
    assert known["stages"].kind == "a list of mappings or null" and known["stages"].default == "null"
