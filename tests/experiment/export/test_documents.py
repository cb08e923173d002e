"""The preregistration of a study and the figure of its trials."""

from __future__ import annotations

import base64
import io
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from physion.cli.main import main
from physion.experiment.export.documents import preregistration, trial_figure, write_documents
from physion.experiment.study.settings import PaymentRule, Timing
from physion.experiment.study.study import load_study, write_settings
from support.experiment.own_questions import OWN_QUESTIONS, OWN_TEXTS
from support.experiment.tiny_study import FULL, OBSERVED, RATE, make_tiny_study, read_number

TEMPLATE = [
    *("Study information", "Title", "Research questions", "Hypotheses"),
    *("Design plan", "Study design", "Manipulated variables", "Evaluation protocol"),
    *("Measured variables", "Sampling plan", "Data collection procedure", "Sampling procedure"),
    *("Analysis plan", "Data exclusion criteria", "Missing data", "Planned analyses"),
    "Exploratory analyses",
]
"""Headings in the order of the template."""


def test_the_plan_follows_the_template_and_the_settings(tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path, test=6, familiarization=4, questions=OWN_QUESTIONS, more_texts=OWN_TEXTS,
        title="Red & yellow", participants=37, exclusions="preregistered-only",
        timing=Timing(fixation_in_familiarization=False, cue_ms=1234, break_every=0),
        payment=PaymentRule(4.0, "EUR", 20), funders="the Abc Foundation",
    )  # fmt: skip
    text = preregistration(study)
    assert re.findall("^##+ (.*)$", text, re.MULTILINE) == TEMPLATE
    for words in (
        "# Preregistration: Red & yellow",
        "| collide | 6 | 3 |",
        "4 familiarization trials",
        "6 test trials in an order of their own, without feedback, without breaks",
        "500 to 1500 ms (not in familiarization)",
        "for 1234 ms",
        "flashing at 2 Hz",
        f"for {OBSERVED / RATE:g} s at {RATE} frames per second",
        "Will the red object touch the yellow object?",
        "4 EUR",
        "paid for by the Abc Foundation",
        "12.00 EUR per hour",
        "when 37 participants have finished each scenario",
        "more than 6 equal answers in a row",  # 2 of 64 sequences of 6 tosses have 6 in a row
        "24 or more answers in a row alternate",
        "30 % or fewer",
        "`confidence`: How sure were you?",
    ):
        assert words in text, words
    assert "no person can have made it" not in text
    other = preregistration(
        replace(study, exclusions="preregistered", payment=PaymentRule(), demographics=False)
    )
    assert "no person can have made it" in other and "age, gender" not in other
    assert "[What do participants receive?]" in other
    assert "paid for" not in preregistration(replace(study, funders=""))


def _pictures(svg: str) -> list[np.ndarray]:
    found = re.findall(r'href="data:image/jpeg;base64,([^"]+)"', svg)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))) for data in found]


def test_the_figure_shows_frames_texts_and_durations(tmp_path: Path) -> None:
    study = make_tiny_study(tmp_path, test=6, familiarization=2, size=192)
    svg = trial_figure(study)
    texts = [element.text or "" for element in ET.fromstring(svg).iter() if element.text]
    words = " ".join(" ".join(texts).split())
    assert "Practice trial, 2 in a session" in words and "Test trial, 6 in a session" in words
    assert "2000 ms, flashing at 2 Hz" in words and "500 to 1500 ms" in words
    assert f"{1000 * OBSERVED / RATE:.0f} ms" in words
    assert f"{1000 * FULL / RATE:.0f} ms, then at will" in words
    assert "Will the red object touch the yellow object?" in words and "YES" in words
    # The last practice trial has no contact.
    assert "does not touch" in words
    pictures = _pictures(svg)
    assert [read_number(picture) for picture in pictures] == [0, 44, 59, 0, 44]
    cued = pictures[0][96, int(0.2 * 192)].astype(int)
    assert cued[0] > 200 and cued[1:].max() < 60  # the agent is red


def test_without_feedback_and_fixation_the_figure_is_shorter(tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path, test=2, familiarization=1, timing=Timing(fixation_in_familiarization=False)
    )
    assert trial_figure(study).count("Fixation") == 1
    shorter = trial_figure(replace(study, familiarization_feedback=False))
    assert len(_pictures(shorter)) == 4 and "Feedback, full movie" not in shorter


def test_the_verb_writes_both_again(tmp_path: Path) -> None:
    study = make_tiny_study(tmp_path, test=2, familiarization=1)
    plan, figure = write_documents(study)
    before = figure.read_text()
    write_settings(replace(study, title="Another title"))
    assert main(["experiment", "describe", str(tmp_path)]) == 0
    assert "Another title" in plan.read_text() and figure.read_text() != before
    assert load_study(tmp_path).digest  # they are no part of the study
