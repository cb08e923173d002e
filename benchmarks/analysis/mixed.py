"""Mixed models at the size of the study, beside R and beside the fitters of the Python registry.

    python benchmarks/analysis/mixed.py [--r] [--others] [--write]

120 000 answers: 8 scenarios, 100 participants and 150 stimuli in each. Ours are timed on one core,
formula to tables. ``--r`` adds glmmTMB and lme4 (R and its packages must be there; see
mixed_fixtures.py; lme4 takes minutes). ``--others`` builds an environment with GPBoost, mixedlm,
lme-python and interlace-lme and gives each, and statsmodels, LIMIT seconds and 12 GB. "b" is the
largest difference of a fixed effect from ours in units of our standard error, "se" the largest
share by which a standard error differs. ``--write`` keeps benchmarks/results/mixed.json.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import numpy as np
import pandas as pd

from mixed_fixtures import CASES, as_csv, ask_r
from physion.analysis.mixed.fit import fit_linear, fit_logistic
from physion.analysis.mixed.result import MixedFit
from physion.compute.tasks import processor_and_cores
from support.simulated_answers import AnswerDesign, simulate_answers

RESULTS = Path(__file__).parents[1] / "results"
GOAL = 15.0
"""Seconds that the logistic model of the study may take."""

LIMIT = 300
"""Seconds that each of the others gets."""

PINNED = ("gpboost==1.8.0", "mixedlm==1.3.0", "lme-python==0.2.7", "interlace-lme==0.3.2")

START = """
import json, resource, sys, time, warnings
resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
import numpy as np, pandas as pd
warnings.simplefilter("ignore")
data = pd.read_csv(sys.argv[1])
data = data[["correct", "scenario", "participant", "stimulus"]]
formula = "correct ~ scenario + (1|participant) + (1|stimulus)"
began = time.perf_counter()
"""
END = """
print(json.dumps({"seconds": seconds, "b": list(map(float, b)), "se": list(map(float, se)),
                  "sd": list(map(float, sd)), "loglik": float(loglik)}))
"""
SNIPPETS = {
    "gpboost 1.8.0": """
import gpboost
x = pd.get_dummies(data["scenario"], drop_first=True).astype(float)
x.insert(0, "Intercept", 1.0)
model = gpboost.GPModel(group_data=data[["participant", "stimulus"]],
                        likelihood="bernoulli_logit", num_parallel_threads=1)
model.fit(y=data["correct"].values, X=x)
both = np.asarray(model.get_coef(std_err=True, format_pandas=False)).reshape(2, -1)
seconds, (b, se) = time.perf_counter() - began, both
sd = np.sqrt(np.asarray(model.get_cov_pars(format_pandas=False)).ravel()[:2])
loglik = -model.get_current_neg_log_likelihood()
""",
    "mixedlm 1.3.0": """
import mixedlm
fit = mixedlm.glmer(formula, data, family=mixedlm.families.Binomial())
seconds = time.perf_counter() - began
text = str(fit.summary())
rows = [r.split() for r in text.split("Fixed effects:")[1].splitlines()[2:10]]
b, se = [r[1] for r in rows], [r[2] for r in rows]
groups = text.split("Random effects:")[1].splitlines()
sd = [r.split()[3] for r in groups if r.split()[:1] in (["participant"], ["stimulus"])]
loglik = text.split("-2logL")[1].split()[2]
""",
    "lme-python 0.2.7": """
import lme_python, polars
fit = lme_python.glmer(formula, data=polars.from_dicts(data.to_dict("records")),
                       family_name="binomial")
seconds = time.perf_counter() - began
text = str(fit.summary())
rows = [r.split() for r in text.split("Fixed effects:")[1].splitlines()[2:10]]
b, se = [r[1] for r in rows], [r[2] for r in rows]
groups = text.split("Random effects:")[1].splitlines()
sd = [r.split()[3] for r in groups if r.split()[:1] in (["participant"], ["stimulus"])]
loglik = text.split("deviance")[1].split()[2]
""",
    "interlace-lme 0.3.2": """
from interlace import glmer
fit = glmer("correct ~ scenario", data, family="binomial", groups=["participant", "stimulus"])
seconds, b, se, loglik = time.perf_counter() - began, fit.fe_params, fit.fe_bse, fit.llf
sd = np.sqrt([fit.variance_components[g] for g in ("participant", "stimulus")])
""",
    "statsmodels BinomialBayesMixedGLM (variational)": """
from scipy import sparse
from statsmodels.genmod.bayes_mixed_glm import BinomialBayesMixedGLM
x = pd.get_dummies(data["scenario"], drop_first=True).astype(float)
x.insert(0, "Intercept", 1.0)
parts, ident = [], []
for k, g in enumerate(("participant", "stimulus")):
    codes = data[g].astype("category").cat.codes.to_numpy()
    parts.append(sparse.csr_matrix((np.ones(len(codes)), (np.arange(len(codes)), codes))))
    ident += [k] * parts[-1].shape[1]
fit = BinomialBayesMixedGLM(data["correct"], x, sparse.hstack(parts).tocsr(),
                            np.array(ident)).fit_vb()
seconds, b, se, sd = time.perf_counter() - began, fit.fe_mean, fit.fe_sd, np.exp(fit.vcp_mean)
loglik = float("nan")
""",
    "statsmodels MixedLM (linear)": """
import statsmodels.api as sm
data = pd.read_csv(sys.argv[1]).assign(all=1)
crossed = {"participant": "0 + C(participant)", "stimulus": "0 + C(stimulus)"}
sm.MixedLM.from_formula("log_rt ~ scenario + elements", data, groups="all", re_formula="0",
                        vc_formula=crossed).fit()
seconds, b, se, sd, loglik = time.perf_counter() - began, [], [], [], float("nan")
""",
}


def environment(folder: Path) -> Path:
    """A fresh environment with the other fitters; its interpreter."""
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    command = [str(python), "-m", "pip", "install", "-q", "--only-binary=:all:", *PINNED]
    subprocess.run([*command, "pandas", "pyarrow", "statsmodels"], check=True)
    return python


def ask_other(python: Path, snippet: str, source: Path) -> dict[str, object]:
    """What another fitter gives for the same table, or why not."""
    threads = {"RAYON_NUM_THREADS": "1", "POLARS_MAX_THREADS": "1"}
    try:
        done = subprocess.run(
            [str(python), "-c", START + snippet + END, str(source)],
            env={**os.environ, **threads},
            timeout=LIMIT,
            capture_output=True,
            text=True,
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"not done in {LIMIT} s"}
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        return {"failed": lines[-1] if lines else f"ended with {done.returncode}"}
    found: dict[str, object] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def from_r(name: str, fitter: str, fitted: MixedFit) -> dict[str, object]:
    """R's answer, run now, in the order of our table."""
    numbers = ask_r(name, CASES[name], fitter).query("fitter == @fitter")
    values = numbers.set_index(["quantity", "term"])["value"].astype(float)
    terms = [
        re.sub(r"\[T\.(.*?)\]", r"\1", term).replace("Intercept", "(Intercept)")
        for term in fitted.table["term"]
    ]
    return {
        "seconds": values["seconds", ""],
        "b": values["b"][terms].tolist(),
        "se": values["se"][terms].tolist(),
        "sd": values["sd"][["participant", "stimulus"]].tolist(),
        "loglik": values["loglik", ""],
    }


def timed(kind: str, formula: str, data: pd.DataFrame) -> tuple[float, MixedFit]:
    """Seconds of our fit, from the table to the result, and the fit."""
    began = time.perf_counter()
    fitted = (fit_logistic if kind == "logistic" else fit_linear)(formula, data)
    return time.perf_counter() - began, fitted


def compare(fitted: MixedFit, other: dict[str, object]) -> dict[str, object]:
    """The other's numbers, with how far they are from ours."""
    if "failed" in other or not other["b"]:
        return other
    b, se = np.array(other.pop("b")), np.array(other.pop("se"))
    own = fitted.table
    return {
        **other,
        "b differs by (se)": float(np.abs((b - own["b"]) / own["se"]).max()),
        "se differs by (share)": float(np.abs(se / own["se"] - 1).max()),
    }


def ours() -> dict[str, tuple[float, MixedFit]]:
    """Our fits: the study's design, and designs that are crossed over scenarios."""
    crossed = AnswerDesign(participants=100, crossed=True)
    sparse = AnswerDesign(participants=800, crossed=True, skipped=0.875)
    slopes = "scenario + elements + distractors + occluders + (1|participant) + (1|stimulus)"
    timed("logistic", CASES["nested"].formula, CASES["nested"].data())
    found = {name: timed(CASES[name].kind, CASES[name].formula, CASES[name].data())
             for name in ("big", "times big")}  # fmt: skip
    for label, design in (("100 people, all scenarios", crossed), ("800 people, 1/8 each", sparse)):
        data = simulate_answers(design, seed=1)
        found[f"logistic, {label}"] = timed("logistic", f"correct ~ {slopes}", data)
        found[f"linear, {label}"] = timed("linear", f"log_rt ~ {slopes}", data)
    return found


def main() -> None:
    """Time, compare, print, and write when asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for option in ("--r", "--others", "--write"):
        parser.add_argument(option, action="store_true")
    chosen = parser.parse_args()
    found = ours()
    fitted = found["big"][1]
    rows: dict[str, object] = {
        f"physion: {name}": {
            "seconds": seconds,
            "rows": one.rows,
            "sd": one.random["sd"].tolist(),
            "loglik": one.log_likelihood,
            "converged": one.converged,
        }
        for name, (seconds, one) in found.items()
    }
    if chosen.r:
        for fitter in ("glmmTMB", "lme4"):
            rows[fitter] = compare(fitted, from_r("big", fitter, fitted))
        linear = found["times big"][1]
        rows["lmerTest (times big)"] = compare(linear, from_r("times big", "lme4", linear))
    if chosen.others:
        with tempfile.TemporaryDirectory() as folder:
            python, source = environment(Path(folder) / "others"), Path(folder) / "big.csv"
            source.write_bytes(as_csv(CASES["big"].data()))
            for name, snippet in SNIPPETS.items():
                rows[name] = compare(fitted, ask_other(python, snippet, source))
    for name, row in rows.items():
        print(name, json.dumps(row))
    result = {
        "date": datetime.date.today().isoformat(),
        "command": " ".join(["python benchmarks/analysis/mixed.py", *sys.argv[1:]]),
        "processor": processor_and_cores(),
        "threads": 1,
        "goal_seconds": GOAL,
        "reached": found["big"][0] < GOAL,
        "fits": rows,
    }
    if chosen.write:
        (RESULTS / "mixed.json").write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
