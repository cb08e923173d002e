"""Command line: quick help with examples that work, errors in one line with exit code 2."""

from __future__ import annotations

import importlib.metadata
import os
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import tyro

from physion.cli import doctor
from physion.cli.arguments import take_options
from physion.cli.help import EXAMPLES, VERBS, find_module, module_of
from physion.cli.main import OUTPUT_CLOSED, main
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings

PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"


@pytest.mark.parametrize(
    ("words", "heavy"),
    [
        (["--help"], {"numpy", "torch", "mujoco", "tyro", "numba", "pandas"}),
        (["compare", "--help"], {"numpy", "torch", "scipy", "matplotlib", "pandas"}),
    ],
)
def test_help_imports_nothing_heavy(words: list[str], heavy: set[str]) -> None:
    code = (
        "import sys\nfrom physion.cli.main import main\n"
        f"try: main({words})\nexcept SystemExit: pass\n"
        f"sys.exit(' '.join({heavy} & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert words != ["--help"] or all(verb in done.stdout for verb in VERBS)


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([verb, "--help"])
    assert left.value.code == 0
    text = capsys.readouterr().out
    assert f"physion {verb}" in text
    # Values have names, and defaults that say nothing are left out.
    assert "STR" not in text and "{None}" not in text and "--no-json" not in text
    assert "(default: )" not in text and "(default: None)" not in text


@pytest.mark.parametrize("content", [None, "empty", "file"])
def test_bad_folders_are_one_line(
    tmp_path: Path, content: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "scenes"
    if content == "empty":
        folder.mkdir()
    elif content == "file":
        folder.write_text("not a folder")
    target = tmp_path / "table.json"
    assert main(["replay", str(folder), "--json", str(target)]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and str(folder) in message
    assert not target.exists() and not list(tmp_path.glob(".*part"))


def test_doctor_says_what_is_here(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "mujoco" in out and "H.264" in out and "write access" in out


def test_doctor_checks_every_declared_dependency(monkeypatch: pytest.MonkeyPatch) -> None:
    declared = tomllib.loads(PYPROJECT.read_text())["project"]
    extras = declared["optional-dependencies"]
    # As a wheel's metadata states them.
    lines = declared["dependencies"] + [
        f"{line} ; extra == '{name}'" for name, lines in extras.items() for line in lines
    ]
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: lines)
    found = doctor.requirements()
    assert set(found) == {"", *extras} - {"all"}
    assert {"numpy", "pydantic", "jinja2"} <= set(found[""])
    assert found["mujoco"] == ["mujoco-core"] and "uvicorn" in found["experiment"]
    assert [len(found[name]) for name in found] == [
        len(declared["dependencies"]), *(len(extras[name]) for name in found if name),
    ]  # fmt: skip


def test_doctor_names_the_command_that_installs_playwright(monkeypatch: pytest.MonkeyPatch) -> None:
    version = doctor._version
    monkeypatch.setattr(
        doctor, "_version", lambda name: None if name == "playwright" else version(name)
    )
    (check,) = (check for check in doctor.packages() if check.name == "extra dev")
    assert not check.good and not check.needed
    assert "playwright" in check.value and "-e '.[dev]'" in check.remedy


def test_doctor_refuses_a_folder_that_is_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "--folder", str(tmp_path / "nowhere")]) == 1
    assert "--folder" in capsys.readouterr().out


def test_unknown_scenarios_get_the_closest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (
        ["replay", str(tmp_path), "--scenario", "colide"],
        ["generate", str(tmp_path / "out"), "--scenario", "colide"],
    ):
        assert main(command) == 2
        message = capsys.readouterr().err
        assert message.count("\n") == 1 and "collide" in message
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("command", "buffered"), [("--help", True), ("ls", True), ("ls", False)])
def test_a_closed_output_ends_the_command_quietly(command: str, buffered: bool) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "physion.cli.main", *command.split()],
            env={**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"},
            stdout=writer,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (OUTPUT_CLOSED, "")


@pytest.mark.slow
def test_no_output_is_no_error() -> None:
    code = "import os, sys; os.close(1); os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    done = subprocess.run(
        [sys.executable, "-c", code, "-m", "physion.cli.main", "ls"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


# --- what cannot be read ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("generate x --scenaro drop",
         "no such option --scenaro: did you mean --scenario? (physion generate --help lists all)"),
        (
            # Where a word may stand, a misspelt option is not taken for it.
            "replay --scenaro=drop",
            "no such option --scenaro: did you mean --scenario? (physion replay --help lists all)",
        ),
        ("genrate x", "no such verb genrate: did you mean generate? (physion --help lists all)"),
        (
            "experiment exprot study",
            "no such sub-verb exprot: did you mean export? (physion experiment --help lists all)",
        ),
        ("train gns", "train needs DATASET (physion train --help explains it)"),
        ("verify x y", "verify does not take 'y' (physion verify --help explains it)"),
        ("doctor --count", "--count needs a value: INTEGER (physion doctor --help explains it)"),
        ("doctor --count x", "--count takes INTEGER, not 'x' (physion doctor --help explains it)"),
        ("run --limit two", "--limit takes INTEGER, not 'two' (physion run --help explains it)"),
        (
            "generate x --split tesing",
            "--split takes one of training, readout, testing, familiarization, all, not 'tesing'; "
            "did you mean testing? (physion generate --help explains it)",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line(
    line: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(line.split()) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err) == ("", f"physion: {message}\n")


def test_negative_numbers_and_underscores_are_no_unknown_options(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["verify", "/nowhere", "--again", "-1"]) == 2
    assert "/nowhere" in capsys.readouterr().err
    assert main(["evaluate", "cswm", "/nowhere", "--dry_run"]) == 2
    assert "/nowhere" in capsys.readouterr().err
    assert main(["generate", "/nowhere", "--jitters", "-1"]) == 2
    assert "jitters must be at least 0, not -1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("generate /nowhere --option min_visible=-1", "min_visible must lie in 0..1, not -1"),
        ("generate /nowhere --option robust=0.5 robust=0.6", "--option: robust is given twice"),
        ("generate /nowhere --option compatible=2", "--option compatible must be true or false"),
        ("generate /nowhere --option speed=2", "--option: unknown key 'speed'"),
        ("evaluate mean /nowhere --option folds=1", "folds at least 2"),
        ("evaluate mean /nowhere --option logistic.fold=2", "did you mean 'folds'?"),
        ("train cswm /nowhere --option folds=x", "--option folds must be a whole number"),
        ("generate /nowhere --option width=64", "width has an option of its own: --width"),
        ("generate /nowhere --option robst=.9", "did you mean 'robust'?"),
        ("generate /nowhere --option robust=.9 --option labels=false", "--option is given twice"),
        ("evaluate --option folds=3 mean /nowhere", "--option takes NAME=VALUE, not 'mean'"),
        ("evaluate mean /nowhere --option logistic=3", "takes logistic.NAME=VALUE"),
        ("evaluate mean /nowhere --surprise --option folds=3", "takes options of models only"),
        ("generate /nowhere --robust 0.9", "no such option --robust"),
        ("generate /nowhere --option --json", "--option needs a value: NAME=VALUE"),
        ("generate /nowhere --option", "--option needs a value: NAME=VALUE"),
    ],
)
def test_settings_without_an_option_of_their_own_are_checked(
    line: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(line.split()) == 2
    assert message in capsys.readouterr().err


def test_settings_without_an_option_of_their_own_are_set() -> None:
    given, rest = take_options(
        EvaluationSettings(seeds=2),
        ["folds=3", "logistic.folds=4", "steps=5", "gns:folds=6", "logistic.py:Net:folds=7"],
    )
    assert rest == ["steps=5", "gns:folds=6", "logistic.py:Net:folds=7"]
    assert given == EvaluationSettings(seeds=2, folds=3, logistic=LogisticSettings(folds=4))


# --- examples -----------------------------------------------------------------------------------


def subverbs(verb: str) -> list[str]:
    return [f"{verb} {word}" for word in getattr(module_of(verb), "SUBVERBS", {})]


def test_every_verb_and_subverb_has_examples() -> None:
    assert set(EXAMPLES) == {*VERBS, *(name for verb in VERBS for name in subverbs(verb))}


@pytest.mark.parametrize(
    ("name", "line"), [(name, line) for name, lines in EXAMPLES.items() for line in lines]
)
def test_examples_are_parsed(name: str, line: str) -> None:
    words = shlex.split(line.partition(" > ")[0])
    assert words[0] == "physion"
    module, taken = find_module(words[1:])
    assert name.split() == words[1 : 1 + taken] or name == words[1]
    # Raises SystemExit for an unknown option or a value of a wrong type.
    tyro.cli(module.Options, args=words[1 + taken :])


@pytest.mark.parametrize("words", [["verify"], ["experiment", "simulate"]])
def test_help_ends_with_options_and_shows_examples(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert "Examples:" in lines
    assert set(EXAMPLES[" ".join(words)]) <= set(lines)
