"""The data sets and formulas that our mixed models and R's are compared on.

``benchmarks/analysis/mixed_fixtures.py`` writes these data for R and keeps R's numbers in
``fixtures/mixed_r.csv``; the tests make the same data again and check that they are the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from support.official import official_folder
from support.simulated_answers import AnswerDesign, simulate_answers

STORED = Path(__file__).parent / "fixtures" / "mixed_r.csv"

PEOPLE = "(1|participant) + (1|stimulus)"


@dataclass(frozen=True)
class Case:
    """One model of one data set; ``kind`` is logistic or linear."""

    kind: str
    formula: str
    data: Callable[[], pd.DataFrame]


def nested() -> pd.DataFrame:
    """8 scenarios of 20 participants and 30 stimuli of their own."""
    return simulate_answers(AnswerDesign(participants=20, stimuli=30), seed=1)


def crossed() -> pd.DataFrame:
    """40 participants who see 20 stimuli of each scenario, 15 % of the trials missing."""
    design = AnswerDesign(participants=40, stimuli=20, crossed=True, skipped=0.15)
    return simulate_answers(design, seed=2)


def big() -> pd.DataFrame:
    """The published size: 120 000 answers."""
    return simulate_answers(AnswerDesign(), seed=0)


def alike() -> pd.DataFrame:
    """Participants who do not differ: their variance is estimated as zero."""
    design = AnswerDesign(participants=12, stimuli=16, participant_sd=0, crossed=True)
    return simulate_answers(design, seed=6)


def models() -> pd.DataFrame:
    """Models' answers by readout and training, as in the published comparison."""
    draw = np.random.default_rng(5)
    scenario, training, readout, model, stimulus = np.indices((8, 3, 4, 5, 12)).reshape(5, -1)
    ability = np.array([0.0, 0.02, 0.05, 0.11, 0.16])[model]
    share = (
        0.55
        + ability
        + draw.normal(0, 0.05, 8)[scenario]
        + draw.normal(0, 0.03, 3)[training]
        + draw.normal(0, 0.05, 4)[readout]
    )
    return pd.DataFrame(
        {
            "model_correct": (draw.random(len(share)) < share).astype(int),
            "scenario": np.char.add("sc", scenario.astype(str)),
            "training": np.array(["all", "all_but_this", "same"])[training],
            "readout": np.array(["A", "B", "C", "D"])[readout],
            "model": np.array(["SVG", "OP3", "RPIN", "DEIT", "DPI"])[model],
            "difficulty": draw.normal(0, 1, len(share)).round(3) + 0.2 * (stimulus % 3),
        }
    )


def published() -> pd.DataFrame:
    """The published table of models' accuracies, where the official data is."""
    folder = official_folder()
    if folder is None:
        raise FileNotFoundError("the official data is absent: set PHYSION_OFFICIAL to its folder")
    table = pd.read_csv(folder / "results" / "model_human_accuracies.csv")
    names = {"Readout Type": "readout", "Dynamics Training Dataset Type": "training"}
    table = table.rename(columns={**names, "Model": "model"})
    return table[["model_correct", "model", "scenario", "readout", "training"]]


CASES = {
    "nested": Case("logistic", f"correct ~ scenario + {PEOPLE}", nested),
    "crossed": Case(
        "logistic", f"correct ~ scenario + elements + distractors + occluders + {PEOPLE}", crossed
    ),
    "one group": Case("logistic", "correct ~ distractors + (1|participant)", crossed),
    "three groups": Case("logistic", f"correct ~ elements + {PEOPLE} + (1|scenario)", crossed),
    "alike": Case("logistic", f"correct ~ occluders + {PEOPLE}", alike),
    "big": Case("logistic", f"correct ~ scenario + {PEOPLE}", big),
    "times nested": Case("linear", f"log_rt ~ scenario + elements + {PEOPLE}", nested),
    "times crossed": Case("linear", f"log_rt ~ scenario * occluders + {PEOPLE}", crossed),
    "times alike": Case("linear", f"log_rt ~ occluders + {PEOPLE}", alike),
    "models": Case("linear", "model_correct ~ model + (1|scenario) + (1|training)", models),
    "readouts": Case(
        "linear",
        "model_correct ~ model + difficulty + (1|scenario) + (1|readout) + (1|training)",
        models,
    ),
    "inside": Case("linear", "model_correct ~ difficulty + (1|scenario/readout)", models),
    "published readouts": Case(
        "linear", "model_correct ~ readout + (1|scenario) + (1|training)", published
    ),
    "published models": Case(
        "linear",
        "model_correct ~ model + (1|scenario) + (1|readout) + (1|training)",
        published,
    ),
    "times big": Case("linear", f"log_rt ~ scenario + elements + {PEOPLE}", big),
}


def as_csv(data: pd.DataFrame) -> bytes:
    """What R reads: every number with 12 digits."""
    return data.to_csv(index=False, float_format="%.12g", lineterminator="\n").encode()


def digest(data: pd.DataFrame) -> str:
    """By which stored numbers are known to be about these data."""
    return hashlib.sha256(as_csv(data)).hexdigest()[:16]
