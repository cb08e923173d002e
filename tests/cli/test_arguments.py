"""What cannot be read of a command line is one plain line."""

from __future__ import annotations

import pytest

from physion.cli.main import main


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
        ("bench --count", "--count needs a value: INTEGER (physion bench --help explains it)"),
        ("bench --count x", "--count takes INTEGER, not 'x' (physion bench --help explains it)"),
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
    assert main(["generate", "/nowhere", "--min_visible", "-1"]) == 2
    assert "visible fraction" in capsys.readouterr().err
