"""The printed script completes verbs, sub-verbs, options and values in bash."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from physion.cli.main import main
from support.programs import find_program


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "physion.bash"
    with pytest.MonkeyPatch.context() as patch, path.open("w", encoding="utf-8") as file:
        patch.setattr("sys.stdout", file)
        assert main(["completion", "bash"]) == 0
    return path


def complete(script: Path, line: str) -> set[str]:
    """What bash offers for the last word of a line; a space at its end begins a new word."""
    words = [*line.split(), *([""] if line.endswith(" ") else [])]
    code = (
        'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _tyro_physion; '
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    bash = find_program("bash")
    done = subprocess.run(
        [bash, "-c", code, "bash", script, *words], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("physion gen", {"generate"}),
        ("physion compare pow", {"power"}),
        ("physion experiment sim", {"simulate"}),
        ("physion generate trials --scen", {"--scenario"}),
        ("physion compare --hum", {"--humans"}),
        ("physion generate --split fam", {"familiarization"}),
        ("physion gibberish", set()),
    ],
)
def test_bash_completes(script: Path, line: str, offered: set[str]) -> None:
    assert complete(script, line) == offered


@pytest.mark.parametrize(
    ("shell", "word"), [("zsh", "#compdef physion"), ("fish", "complete --no-files")]
)
def test_other_shells_have_a_script(
    shell: str, word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", shell]) == 0
    out = capsys.readouterr().out
    assert word in out and "generate" in out


def test_other_words_are_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["completion", "sh"])
    assert left.value.code == 2
