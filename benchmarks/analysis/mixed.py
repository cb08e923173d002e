"""Seconds of the preregistered mixed models of people's answers, on one core.

    python benchmarks/analysis/mixed.py [--people 38] [--stimuli 50]

Made-up answers of 8 scenarios, each with its own people and stimuli: 15,200 answers by default;
120,000, the size of the study, with ``--people 100 --stimuli 150``. R's answers to such models are
in tests/support/fixtures/mixed_r.csv.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from physion.analysis.mixed import fit_linear, fit_logistic
from physion.analysis.people.effects import HYPOTHESES
from support.simulated_answers import AnswerDesign, simulate_answers


def main() -> None:
    """Fit each model and print the processor time that it took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--people", type=int, default=38)
    parser.add_argument("--stimuli", type=int, default=50)
    chosen = parser.parse_args()
    rows = simulate_answers(AnswerDesign(participants=chosen.people, stimuli=chosen.stimuli))
    rows["accuracy"] = rows.groupby("stimulus")["correct"].transform("mean")
    scenarios = "correct ~ scenario + (1|participant) + (1|stimulus)"
    models = [("logistic", scenarios), *((one.family, one.formula) for one in HYPOTHESES.values())]
    total = 0.0
    for family, formula in models:
        began = time.process_time()
        fit = (fit_logistic if family == "logistic" else fit_linear)(formula, rows)
        taken = time.process_time() - began
        total += taken
        print(f"{taken:7.2f} s  {fit.rows} rows  {formula}", flush=True)
    print(f"{total:7.2f} s  all")


if __name__ == "__main__":
    main()
