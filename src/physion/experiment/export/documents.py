"""Documents of a study, filled from its settings, texts and movies.

- ``preregistration.md``: a plan in the order of the template of the Open Science Framework for
  experimental studies, as the original study used it. What only the lab can say is marked.
- ``trial.svg``: what a participant sees in a practice and in a test trial, with the durations of
  the settings, the words of the texts and frames of one of the movies.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from physion.analysis.people.exclusions import RULE_SETS, streak_limit
from physion.core.files import write_atomic
from physion.core.html import environment
from physion.core.version import MADE_WITH
from physion.experiment.protocol import PAGES, STAGES, label
from physion.experiment.store.sessions import stages_of
from physion.experiment.study.stimuli import Stimulus
from physion.experiment.study.study import Study
from physion.trials.video import read_frames

PREREGISTRATION, FIGURE = "preregistration.md", "trial.svg"
SIDE = 176
"""Longer side of a picture in the figure, in pixels."""
LETTERS = 27
"""Letters in a line below a picture."""


def write_documents(study: Study) -> tuple[Path, Path]:
    """Write both documents into the study's folder, over earlier ones; return their paths."""
    plan, figure = study.folder / PREREGISTRATION, study.folder / FIGURE
    write_atomic(plan, preregistration(study).encode())
    write_atomic(figure, trial_figure(study).encode())
    return plan, figure


def preregistration(study: Study) -> str:
    """Return the preregistration of a study as Markdown."""
    texts = study.texts[study.languages[0]]
    counts = {
        scenario: [stimulus.label for stimulus in study.phase(scenario, "test")]
        for scenario in study.scenarios
    }
    rules = RULE_SETS[study.exclusions]
    total = max(len(labels) for labels in counts.values())
    plain = environment("physion.experiment.export").overlay(autoescape=False)
    return plain.get_template(PREREGISTRATION).render(
        study=study,
        texts=texts,
        counts=[(name, len(labels), sum(labels)) for name, labels in counts.items()],
        practice=max(len(study.phase(name, "familiarization")) for name in study.scenarios),
        total=total,
        rate=_common([s.rate for s in study.stimuli]),
        seconds=_common([s.frames / s.rate for s in study.stimuli]),
        rules=rules,
        streak=None
        if rules.streak_percentile is None
        else streak_limit(total, rules.streak_percentile),
        questions=[
            (question, texts[f"question.{question.name}.text"].strip())
            for question in study.questions
        ],
        made_with=MADE_WITH,
    )


def _common(values: Sequence[float]) -> str:
    """Return a number that all values are, or their range, as text."""
    low, high = min(values), max(values)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


@dataclass(frozen=True)
class TrialPanel:
    """One picture of the figure: what is drawn, its duration, and lines of text below it."""

    title: str
    duration: str
    picture: str = ""
    text: tuple[str, ...] = ()
    buttons: tuple[str, str] | None = None
    cross: bool = False


def trial_figure(study: Study) -> str:
    """Return the figure of the trial structure as SVG; its movie is the example of the
    instructions, the last practice trial of the first scenario."""
    texts = study.texts[study.languages[0]]
    shown = study.phase(study.scenarios[0], "familiarization")[-1]
    observed = read_frames(study.folder / shown.movie)
    whole = read_frames(study.folder / shown.full) if shown.full else observed
    timing, seconds = study.timing, len(observed) / shown.rate
    low, high = timing.fixation_ms
    cross = TrialPanel(
        "Fixation", f"{low} ms" if low == high else f"{low} to {high} ms", cross=True
    )
    flashes = f", flashing at {timing.flash_hz:g} Hz" if timing.flash_hz else ""
    cue = TrialPanel(
        "Cue on the first frame",
        f"{timing.cue_ms} ms{flashes}",
        _encoded(_cued(study, shown, observed[0])),
    )
    movie = TrialPanel("Movie, then hidden", f"{1000 * seconds:.0f} ms", _encoded(observed[-1]))
    prompt = TrialPanel(
        "Prediction",
        "until the answer",
        text=tuple(wrap(texts["trial.prompt"], LETTERS)),
        buttons=(texts["trial.yes"], texts["trial.no"]),
    )
    said = texts["practice.contact" if shown.label else "practice.no_contact"]
    feedback = TrialPanel(
        "Feedback, full movie",
        f"{1000 * len(whole) / shown.rate:.0f} ms, then at will",
        _encoded(whole[-1]),
        text=(*wrap(texts["practice.correct"], LETTERS), *wrap(said, LETTERS)),
    )
    practice = [cross] if timing.fixation_in_familiarization else []
    practice += [cue, movie, prompt]
    practice += [feedback] if study.familiarization_feedback else []
    number = len(study.phase(study.scenarios[0], "familiarization"))
    tests = len(study.phase(study.scenarios[0], "test"))
    rows = [
        (f"Practice trial, {number} in a session", practice),
        (f"Test trial, {tests} in a session", [cross, cue, movie, prompt]),
    ]
    return (
        environment("physion.experiment.export")
        .get_template(FIGURE)
        .render(
            title=texts.get("study.title", study.title),
            stages=[_stage(stage) for stage in stages_of(study)],
            rows=rows,
            columns=max(len(panels) for _, panels in rows),
            side=SIDE,
            lines=max(len(panel.text) for _, panels in rows for panel in panels),
        )
    )


def _stage(stage: str) -> str:
    """Return the name of a stage in the sequence of a session."""
    names = {"familiarization": "Practice", "test": "Test", "done": "Result", "ready": "Start page"}
    assert stage in STAGES
    return names.get(stage) or (PAGES[stage].label if stage in PAGES else label(stage))


def _cued(study: Study, shown: Stimulus, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a frame with the map over it, as while the cue is on."""
    with Image.open(study.folder / shown.map) as picture:
        mark = picture.convert("RGBA").resize((frame.shape[1], frame.shape[0]))
    base = Image.fromarray(frame).convert("RGBA")
    return np.asarray(Image.alpha_composite(base, mark).convert("RGB"))


def _encoded(frame: NDArray[np.uint8]) -> str:
    """Return a frame as a data URL of a small JPEG."""
    picture = Image.fromarray(frame)
    picture.thumbnail((2 * SIDE, 2 * SIDE))
    buffer = io.BytesIO()
    picture.save(buffer, "jpeg", quality=85)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
