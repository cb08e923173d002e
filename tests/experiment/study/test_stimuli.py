"""stimuli.csv: round trip, and refusal of invalid rows with their row number."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from physion.core.errors import BadInputError
from physion.experiment.study.stimuli import COLUMNS, Stimulus, read_stimuli, write_stimuli

NAMES_OF_COLUMNS = [column.name for column in COLUMNS]
NAMES = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,30}", fullmatch=True)
FILES = st.from_regex(r"media/[A-Za-z0-9][A-Za-z0-9_-]{0,20}", fullmatch=True)


@st.composite
def stimuli_lists(draw: st.DrawFn) -> list[Stimulus]:
    names = draw(st.lists(NAMES, min_size=1, max_size=8, unique=True))
    found = []
    for place, name in enumerate(names):
        practice, frames = draw(st.booleans()), draw(st.integers(1, 200))
        file = draw(FILES)
        found.append(
            Stimulus(
                stimulus=name,
                scenario=draw(st.sampled_from(["collide", "my-own.scenario"])),
                phase="familiarization" if practice else "test",
                place=place,
                label=draw(st.booleans()),
                movie=f"{file}.mp4",
                map=f"{file}.png",
                full=f"{file}-whole.mp4" if practice else "",
                frames=frames,
                full_frames=frames + 1 if practice else 0,
                rate=draw(st.floats(1, 240)),
                width=draw(st.integers(16, 4096)),
                height=draw(st.integers(16, 4096)),
                look=draw(st.sampled_from(["free", "redyellow"])),
            )
        )
    return found


@pytest.mark.slow
@given(stimuli_lists())
@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_what_is_written_is_read_back(tmp_path: Path, stimuli: list[Stimulus]) -> None:
    path = tmp_path / "stimuli.csv"
    write_stimuli(path, stimuli)
    assert list(read_stimuli(path)) == stimuli


def test_a_spreadsheet_may_save_it(tmp_path: Path) -> None:
    path = _written(tmp_path)
    text = path.read_text().replace("True", "TRUE").replace("\n", "\r\n")
    path.write_bytes(b"\xef\xbb\xbf" + text.encode() + b",,,,,,,,,,,,,\r\n")
    assert list(read_stimuli(path)) == _stimuli()


def test_columns_may_stand_in_any_order(tmp_path: Path) -> None:
    path = _written(tmp_path)
    rows = list(csv.reader(path.read_text().splitlines()))
    path.write_text("\n".join(",".join(reversed(row)) for row in rows))
    assert list(read_stimuli(path)) == _stimuli()


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a formula for a name": ({"stimulus": "=1+1"}, "stimulus must be letters"),
    "a path for a name": ({"stimulus": "../x"}, "stimulus must be"),
    "an unknown phase": ({"phase": "main"}, "expected familiarization or test"),
    "an unknown look": ({"look": "blue"}, "expected free or redyellow"),
    "a label of another kind": ({"label": "contact"}, "expected True or False"),
    "no label": ({"label": ""}, "expected a value"),
    "a negative place": ({"place": "-1"}, "expected a whole number from 0"),
    "half a frame": ({"frames": "44.5"}, "expected a whole number from 1"),
    "no frame": ({"frames": "0"}, "expected a whole number from 1"),
    "no rate": ({"rate": "nan"}, "expected a number from 1 to 240"),
    "too high a rate": ({"rate": "241"}, "expected a number from 1 to 240"),
    "a rate in words": ({"rate": "slow"}, "expected a number"),
    "a tiny picture": ({"width": "15"}, "expected a whole number from 16"),
    "a movie outside": ({"movie": "media/../secret.json"}, "movie must be the path"),
    "a movie anywhere": ({"movie": "/etc/passwd"}, "movie must be the path"),
    "a movie below": ({"movie": "media/a/b.mp4"}, "movie must be the path"),
    "no map": ({"map": ""}, "expected a value"),
    "a whole movie in the test": ({"full": "media/a.mp4"}, "full must be empty"),
    "its frames in the test": ({"full_frames": "60"}, "full_frames must be 0"),
    "no whole movie to practise on": (
        {"phase": "familiarization", "full_frames": "60"}, "full must be the path"),
    "no later frame to practise on": (
        {"phase": "familiarization", "full": "media/w9.mp4", "full_frames": "45"},
        "more than the 45 observed"),
    "an outcome shown before": ({"movie": "media/w0.mp4"}, "full movie of row 1"),
    "a stimulus practised before": ({"stimulus": "a0"}, "is already in row 1"),
    "a place taken": ({"place": "0", "scenario": "collide"}, "place 0 of test"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_bad_rows_are_named(tmp_path: Path, case: str) -> None:
    change, message = REFUSED[case]
    path = _written(tmp_path)
    rows = list(csv.DictReader(path.read_text().splitlines()))
    rows[3] |= change
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, NAMES_OF_COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    with pytest.raises(BadInputError, match="row 4") as raised:
        read_stimuli(path)
    assert message in str(raised.value) and str(path) in str(raised.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"look", b"lock", "unknown column 'lock'; closest: look"),
        (b",look", b",look,colour", "unknown column 'colour'"),
        (b"width,height", b"width,width", r"unknown column 'width\.1'"),
        (b",map,", b",", "rows have more cells than its header"),
        (b",place,", b",", "rows have more cells"),
        (b"45,0,30.0", b"45,30.0", "row 3 of column 'height' holds 'free'"),
        (b"a2", b'"a2', "is not a CSV table"),
        (b"a2", b"a\xff", "is not a CSV table"),
        (b"a2", b"a\x00", "stimulus must be|not a CSV table"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    path = _written(tmp_path)
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(BadInputError, match=message):
        read_stimuli(path)


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "stimuli.csv"
    path.write_text(",".join(NAMES_OF_COLUMNS))
    with pytest.raises(BadInputError, match="no rows"):
        read_stimuli(path)


@pytest.mark.parametrize(
    ("first", "second"),
    [("s_1", "s-redyellow_1"), ("s_1", "s_1_img"), ("s_1_img.mp4", "s_1.hdf5")],
)
def test_names_that_are_one_to_the_analysis_are_refused(
    tmp_path: Path, first: str, second: str
) -> None:
    names = [first, "other", "a", second]
    rows = [dataclasses.replace(s, stimulus=n) for s, n in zip(_stimuli(), names, strict=True)]
    path = tmp_path / "stimuli.csv"
    write_stimuli(path, rows)
    with pytest.raises(BadInputError, match="one stimulus to the analysis") as raised:
        read_stimuli(path)
    assert first in str(raised.value) and second in str(raised.value)
    rows[3] = dataclasses.replace(rows[3], scenario="drop")
    write_stimuli(path, rows)
    assert list(read_stimuli(path)) == rows


def _stimuli() -> list[Stimulus]:
    """Return two familiarization and two test stimuli."""
    found = []
    for number in range(4):
        practice = number < 2
        found.append(
            Stimulus(
                f"a{number}", "collide", "familiarization" if practice else "test", number % 2,
                number % 2 == 0, f"media/m{number}.mp4", f"media/m{number}.png",
                f"media/w{number}.mp4" if practice else "", 45, 60 if practice else 0, 30.0, 128,
                128, "free",
            )
        )  # fmt: skip
    return found


def _written(folder: Path) -> Path:
    path = folder / "stimuli.csv"
    write_stimuli(path, _stimuli())
    return path
