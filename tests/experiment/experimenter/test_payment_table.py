"""The table of payments: accuracy, flags, bonus, and the CSV file."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.experimenter.payment_table import (
    COLUMNS,
    Performance,
    bonus_of,
    payment_csv,
)
from physion.experiment.experimenter.payments import read_payments
from physion.experiment.experimenter.templating import make_environment
from physion.experiment.study.study import Bonus
from support.experiment.experimenter_client import lab
from support.experiment.store_walk import enter, walk

RULE = Bonus(per_correct=0.25, above=0.5, most=1.0)


@pytest.mark.parametrize(
    ("correct", "expected"), [(0, 0.0), (4, 0.0), (5, 0.25), (7, 0.75), (8, 1.0)]
)
def test_a_bonus_is_for_answers_beyond_guessing(correct: int, expected: float) -> None:
    assert bonus_of(RULE, Performance("finished", 8, correct, ())) == expected


def test_a_bonus_has_a_limit_and_is_for_finished_sessions_alone() -> None:
    best = Performance("finished", 100, 100, ())
    assert bonus_of(RULE, best) == 1.0
    assert bonus_of(Bonus(per_correct=0.25), best) == 12.5
    assert bonus_of(Bonus(), best) == 0.0
    for state in ("left", "withdrawn", "void", "going"):
        assert bonus_of(RULE, Performance(state, 100, 100, ())) == 0.0


def test_the_csv_protects_texts_and_names_what_is_not_known(tmp_path: Path) -> None:
    with lab(tmp_path, scenarios=("drop",), test=2, familiarization=1) as found:
        given = {"source": "prolific", "recruiter": {"STUDY_ID": "s1"}}
        walk(found.store, enter(found.store, "=1+1", **given), "done")
        payments = read_payments(
            found.study, found.secrets, found.store.engine, source="", finished=True, page=None
        )
    (row,) = payments.rows
    known = {row.session: Performance("finished", 2, 1, ("streak", "low_accuracy"))}
    for facts, told in ((known, ["finished", "1", "0.5000", "streak low_accuracy", "0.00"]),
                        ({}, ["", "0", "0.0000", "", "0.00"])):  # fmt: skip
        text = payment_csv(payments.rows, facts, RULE).decode()
        (cells,) = csv.DictReader(io.StringIO(text))
        assert tuple(cells) == COLUMNS
        assert cells["id"] == "'=1+1" and cells["recruiter"] == '{"STUDY_ID": "s1"}'
        names = ("state", "correct", "accuracy", "flags", "bonus")
        assert [cells[name] for name in names] == told


def test_the_page_shows_and_sends_the_table(tmp_path: Path) -> None:
    settings = {"scenarios": ("drop",), "test": 2, "familiarization": 1}
    with lab(tmp_path, bonus=Bonus(per_correct=3.0, above=0.0), **settings) as found:
        walk(found.store, enter(found.store, "Ada"), "done")  # one of two answers is right
        anybody, visitor = found.visitor(), found.experimenter()
        assert anybody.see("/payments.csv").headers["location"] == "/experimenter/login"
        assert "Ada" not in visitor.see("/payments.csv").text  # the password is asked again
        page = visitor.open_payments().text
        assert "50 %" in page and "3.00" in page and "Download as CSV" in page
        sent = visitor.see("/payments.csv?who=all")
        assert sent.headers["content-type"] == "text/csv; charset=utf-8"
        assert sent.headers["content-disposition"].endswith('-payments.csv"')
        (cells,) = csv.DictReader(io.StringIO(sent.text))
        assert (cells["id"], cells["accuracy"], cells["bonus"]) == ("Ada", "0.5000", "3.00")


def test_an_id_cannot_turn_the_page_round() -> None:
    page = make_environment().from_string("{{ text|visible }}")
    assert page.render(text="ab\u202ecd\x00") == "ab\\u202ecd\\u0000"
    assert page.render(text="5f1eada0<é>") == "5f1eada0&lt;é&gt;"
