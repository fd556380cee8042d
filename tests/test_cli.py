"""The command line: help without Mitsuba's start, scenes by name, mistakes in a line."""

import runpy
import sys

import pytest

from rgs_mi import cli
from rgs_mi.commands.capture import capture
from rgs_mi.core.errors import UserError
from rgs_mi.core.scene_files import bundled, find_scene, load_scene
from rgs_mi.datasets import load_dataset
from rgs_mi.datasets.path_traced import render_dataset
from rgs_mi.export.relight import load_envmap
from rgs_mi.export.render import render_scene
from rgs_mi.settings.fields import walk
from rgs_mi.settings.settings import Settings

from runs import ROOT


@pytest.fixture
def command(monkeypatch, capsys):
    """Calls ``rgs-mi`` with arguments, Mitsuba may not start: (exit code, stdout, stderr)."""

    def start(name):
        raise AssertionError("Mitsuba starts")

    monkeypatch.setattr("rgs_mi.verbs.fits.set_variant", start)
    monkeypatch.setattr("rgs_mi.verbs.renderings.set_variant", start)
    monkeypatch.setattr("rgs_mi.verbs.suites.set_variant", start)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["rgs-mi", *arguments])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return end.value.code, *capsys.readouterr()

    return call


def test_help_names_every_verb(command):
    code, text, _ = command("--help")
    assert code == 0 and all(f"  {verb}" in text for verb in cli.VERBS) and "RGS_MI_CACHE" in text


@pytest.mark.parametrize("verb", cli.VERBS)
def test_every_verb_has_help_and_a_script(command, monkeypatch, capsys, verb):
    code, text, _ = command(verb, "--help")
    assert code == 0 and text.startswith(f"usage: rgs-mi {verb}")
    monkeypatch.setattr(sys, "argv", ["script", "--help"])
    with pytest.raises(SystemExit):
        runpy.run_path(str(ROOT / "scripts" / f"{verb.replace('-', '_')}.py"), run_name="__main__")
    assert capsys.readouterr().out == text


def test_help_lists_all_settings(command):
    _, text, _ = command("optimize", "--help")
    words = " ".join(text.split())
    for setting in walk(Settings):
        assert f"{setting.key} = {setting.default}" in words and setting.description in words
        assert setting.range in words


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["optimize", "helmt"], "no scene of that name: choose one of helmet, object"),
        (["optimize", "object", "--data", "cat"], "choose one of ball, car"),
        (["optimize", "helmet", "--set", "minuts=3"], "did you mean 'minutes'?"),
        (["optimize", "helmet", "--config", "slow"], "no preset 'slow'"),
        (["render", "helmt"], "no scene of that name"),
        (["render-dataset", "cat"], "choose one of ball, car"),
        (["recovery", "runs/helmet", "cat"], "choose one of ball, car"),
        (["ablate", "--set", "seed=-1"], "'seed' must be an integer"),
        (["benchmark", "suite", "--set", "seed=-1"], "'seed' must be an integer"),
        (["benchmark", "step", "--data", "ball", "--set", "seed=-1"], "'seed' must be an integer"),
    ],
)
def test_mistakes_are_a_line_and_start_nothing(command, arguments, message):
    code, _, error = command(*arguments)
    assert code == 2 and message in error and error.startswith("error: ") and error.count("\n") == 1


def test_names_and_paths(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_scene("helmet", "scenes") == bundled("scenes")["helmet"] != find_scene("helmet", "targets")
    assert find_scene("a/b", "scenes").as_posix() == "a/b" and find_scene("a.xml", "scenes").as_posix() == "a.xml"
    (tmp_path / "helmet").mkdir()  # what lies in the current folder comes first
    assert find_scene("helmet", "targets").as_posix() == "helmet"
    with pytest.raises(UserError, match="choose one of"):
        find_scene("cat", "targets")


@pytest.mark.parametrize(
    "options, message",
    [
        ({"size": -5}, "--size -5: needs 1 to 16384"),
        ({"size": 0}, "--size 0: needs"),
        ({"size": (5, 0)}, "--size 5x0: needs"),
        ({"size": 10**6}, "--size 1000000: needs"),
        ({"spp": -1}, "--spp -1: needs 1 to"),
    ],
)
def test_renderings_of_no_size(options, message):
    with pytest.raises(UserError, match=message):
        render_scene(bundled("scenes")["object"], **options)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"size": -5}, "size is -5: needs at least 1"),
        ({"size": 10**6}, "size is 1000000: needs at least 1 and at most 8192"),
        ({"spp": -1}, "spp is -1"),
        ({"train": 0}, "train is 0"),
        ({"radius": float("nan")}, "radius is nan: needs a positive distance"),
        ({"radius": -1.0}, "radius is -1"),
    ],
)
def test_data_sets_of_no_size(tmp_path, options, message):
    with pytest.raises(UserError, match=message):
        render_dataset(bundled("targets")["ball"], tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["a" * 300, "a/" + "b" * 300 + ".xml", "a\0b", "\n"])
def test_names_that_no_file_system_takes(name):
    for call in (
        lambda: load_scene(find_scene(name, "scenes"), {}),
        lambda: load_dataset(name),
        lambda: load_envmap(name),
        lambda: render_dataset(name, "out"),
        lambda: capture(name, "out"),
    ):
        with pytest.raises(UserError, match="^(no |data folder|'.*does not exist)"):
            call()


@pytest.mark.parametrize("where", ["plugins/evil.so", "named/plugins/evil.dylib"])
def test_code_beside_a_scene_is_not_run(tmp_path, where):
    """Mitsuba would: it looks for the plugin of a type that it does not know there."""
    (tmp_path / where).parent.mkdir(parents=True)
    (tmp_path / where).touch()
    (tmp_path / "scene.xml").write_text('<scene version="3.0.0"><path value="named"/><shape type="evil"/></scene>')
    with pytest.raises(UserError, match=r"evil\.\w+ is native code, which Mitsuba would run for .*scene\.xml: move it"):
        load_scene(tmp_path / "scene.xml", {})
