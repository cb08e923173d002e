"""Protection of free text in CSV against spreadsheet formulas, and its reversal."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from physion.core.tables import Column, read_csv
from physion.experiment.export.descriptions import guard_cell, restore_cell
from physion.experiment.export.export_study import TableWriter
from physion.experiment.study.stimuli import LOOKS, NAME

FORMULA = tuple("=+-@＝＋－＠")
TEXTS = st.text(
    st.sampled_from("=+-@'\"\t\r\n; ,x|\\\x0b\x00\xa0＝＋－＠＇") | st.characters(codec="utf-8"),
    max_size=30,
)


@given(TEXTS)
@example("=1+1")
@example("\t=1")
@example("'=1")
@example(";;=1")
@example("\n'\n\"=")
def test_guarded_text_comes_back(text: str) -> None:
    assert restore_cell(guard_cell(text)) == text


@given(TEXTS)
@example(' "=cmd|x')
@example("a;=1\n+2\t-3")
def test_no_part_that_could_be_a_cell_begins_a_formula(text: str) -> None:
    guarded = guard_cell(text)
    assert not guarded.startswith(("\t", "\r", "\n"))
    for part in re.split(r"[;\t\r\n]", guarded):
        seen = re.sub(r"^[\s\"\x00-\x1f\x7f\ufeff]+", "", part)
        assert not seen.startswith(FORMULA)


@given(st.from_regex(re.compile(NAME, re.ASCII), fullmatch=True))
def test_names_stay_as_they_are(name: str) -> None:
    assert guard_cell(name) == name


def test_ids_choices_and_times_stay_as_they_are() -> None:
    ids = ("0f" * 16, "e" * 32, "2026-11-21T13:27:20.953Z", "true", '{"trial": -3}', "Mozilla/5.0")
    for text in (*ids, "yes-no", "no-yes", "familiarization", "keyboard", "female", *LOOKS):
        assert guard_cell(text) == text


def test_what_people_write_is_hardly_touched() -> None:
    assert (
        guard_cell("I was unsure - it was hard; but fun!") == "I was unsure - it was hard; but fun!"
    )
    assert guard_cell("- too long\n- too dark") == "'- too long\n'- too dark"
    assert guard_cell('=HYPERLINK("http://x","y")') == '\'=HYPERLINK("http://x","y")'


COLUMNS = (Column("session", "text", "Session"), Column("feedback", "text", "Free text"))


@given(st.lists(TEXTS, min_size=1, max_size=5))
@example(['=1+1;=2\r\n=3,"=4"', ""])
def test_files_are_safe_whatever_divides_cells(
    tmp_path_factory: pytest.TempPathFactory, texts: list[str]
) -> None:
    folder = tmp_path_factory.mktemp("files")
    names = [f"{number:032x}" for number in range(len(texts))]
    table = pa.table({"session": names, "feedback": texts})
    with TableWriter(folder, "sessions", COLUMNS) as files:
        files.write(table)
    content = files.csv.read_bytes().decode()
    rows = list(csv.reader(io.StringIO(content, newline=""), strict=True))
    assert [restore_cell(row[1]) for row in rows[1:]] == texts
    assert [row[0] for row in rows[1:]] == names
    for divider in ",;\t":
        for row in csv.reader(io.StringIO(content, newline=""), delimiter=divider):
            for cell in row:
                seen = re.sub(r"^[\s\"\x00-\x1f\x7f\ufeff]+", "", cell)
                assert not seen.startswith(FORMULA), (divider, cell)
    frame = pd.read_parquet(folder / "sessions.parquet")
    assert list(frame["feedback"]) == texts


def test_the_analysis_reads_texts_with_line_ends_and_quotes(tmp_path: Path) -> None:
    texts = ['one\ntwo\r\nthree\rfour, "five"', "", "ümlaut 🙂 \u2028"]
    with TableWriter(tmp_path, "sessions", COLUMNS) as files:
        files.write(pa.table({"session": ["a", "b", "c"], "feedback": texts}))
    table = read_csv(files.csv, ("session", "feedback"))
    assert list(table["feedback"]) == texts
