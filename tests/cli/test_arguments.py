"""What cannot be read of a command line is one plain line."""

from __future__ import annotations

import pytest

from physion.cli.arguments import take_options
from physion.cli.main import main
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "generate x --scenaro drop",
            "no such option --scenaro: did you mean --scenario? "
            "(physion generate --help lists all)",
        ),
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
        (
            "evaluate mean /nowhere --surprise --option folds=3",
            "takes options of models only",
        ),
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
