"""Measure how well `seeing-simulation` recovers scenes, and what it answers.

    OMP_NUM_THREADS=1 python benchmarks/models/seeing.py FOLDER [--each 5] [--known] [--write]

Official stimuli that people saw, without cloth and without a contact in the observed part: the
first ``--each`` with a contact and as many without one, of every scenario, by the hash of their
names. Of each, the observed part is simulated and rendered, scene and state are fitted to masks and
depth, and both the fitted and the true state are simulated with the default noise. One line a trial
is appended to FOLDER/seeing.jsonl; an interrupted run continues there, and --known prints what it
has measured so far. Printed are, by scenario:

1. Accuracy by recorded outcomes (P = 1/2 counts half) with standard error, and area under the curve
   (AUC), of the fitted state, the true state, and constant motion from the fitted state; and
   agreement with the true state. Answers of other fitted trials of the same scenario are right in
   half of the cases, as there are as many trials with a contact as without one.
2. Errors at the last observed frame: median and 90 % quantile of the centre of mass and of the
   velocity of the agent, centre of the other movable objects, how many have the right shape, and
   seconds per trial.

With --write they are written to ``results/seeing.md``.
"""

from __future__ import annotations

import argparse
import datetime
import itertools
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physion.analysis.tables import read_humans
from physion.clips.batch import LAST_OBSERVED, Batch, Motion
from physion.clips.rendered import MotionRenderer, object_ids
from physion.core.names import canonical_name
from physion.core.seeds import stable_hash
from physion.data.official import official
from physion.models.baselines.motion import gap_in_constant_motion
from physion.models.build import build_model
from physion.models.noisy_simulation import NoiseLevels, cut_trial, simulate_contacts
from physion.models.seeing.scenes import SeenTrial
from physion.models.seeing.simulation import VERSION
from physion.numerics.rotations import rotate_vectors
from physion.physics.engine import make_engine, simulate
from physion.physics.rigid.bodies import body_mass
from physion.scenes.scene import OBSERVED_FRAMES, Body, Scene

RESULTS = Path(__file__).parents[1] / "results" / "seeing.md"
SAMPLES = 10
FRAMES_AHEAD = 106
ROW = dict[str, Any]


def chosen_trials(each: int) -> list[tuple[Scene, bool]]:
    """Return scenes and recorded outcomes, one of every scenario and outcome after the other."""
    seen = set(read_humans(official().humans)["stimulus"])
    trials = [t for t in official().trials if canonical_name(t.scene.name) in seen]
    trials = [t for t in trials if not t.scene.cloths]
    trials.sort(key=lambda t: stable_hash("noise", t.scene.name))
    groups: dict[tuple[str, bool], list[tuple[Scene, bool]]] = {}
    for trial in trials:
        contact = bool(trial.outcome.contact)
        groups.setdefault((trial.scene.scenario, contact), []).append((trial.scene, contact))
    kept = []
    for _, group in sorted(groups.items()):
        unseen = (pair for pair in group if not _touched_early(pair[0]))
        kept.append(list(itertools.islice(unseen, each)))
    return [pair for pairs in itertools.zip_longest(*kept) for pair in pairs if pair is not None]


def _touched_early(scene: Scene) -> bool:
    return cut_trial(scene, simulate(scene, frames=OBSERVED_FRAMES)).observed_contact


def measure(scene: Scene, contact: bool) -> ROW:
    """Return what is measured of one trial."""
    engine, model = make_engine(), build_model("seeing-simulation", samples=SAMPLES)
    motion = Motion(scene, simulate(scene, frames=OBSERVED_FRAMES))
    batch = _batch(motion, model.spec)
    start = time.process_time()
    seen = model.see(batch)[0]  # type: ignore[attr-defined]
    seeing = time.process_time() - start
    rollout = model.imagine(batch, SAMPLES, 0)
    true = cut_trial(scene, motion.trajectory)
    found = simulate_contacts(true, NoiseLevels(), 1.0, SAMPLES, 0, engine)
    row: ROW = {
        "stimulus": scene.name,
        "version": VERSION,
        "scenario": scene.scenario,
        "contact": contact,
        "fitted": float(np.mean(rollout.contact)),
        "true": float(np.mean(found)),
        "seconds": seeing,
        "note": seen.note,
    }
    if seen.trial is not None:
        gap = gap_in_constant_motion(seen.trial.scene, seen.trial.state, FRAMES_AHEAD)
        row["constant motion"] = float(gap <= 0 or seen.trial.observed_contact)
        row["objects"] = _errors(seen, motion)
    return row


def _batch(motion: Motion, spec: Any) -> Batch:
    """Return the observed frames of one motion as the model gets them."""
    frames = np.array(spec.context_frames(), np.int64)
    name = motion.scene.name
    reader = MotionRenderer(
        {name: motion}, spec.inputs, spec.image_size, spec.objects, {name: "redyellow"}
    )
    arrays = {key: value[None] for key, value in reader.read(name, frames).items()}
    valid = np.ones((1, len(frames)), np.bool_)
    return Batch((name,), frames[None], valid, **arrays)


def _errors(seen: SeenTrial, motion: Motion) -> list[ROW]:
    """Return the errors of every movable object that was fitted."""
    assert seen.trial is not None
    scene, true = motion.scene, motion.trajectory.state(LAST_OBSERVED)
    numbers = object_ids(scene)[1:].tolist()
    rows = []
    for index, body in enumerate(scene.bodies):
        name = str(numbers[index])
        if body.scenery or body.kinematic or name not in seen.trial.scene.names():
            continue
        other = seen.trial.scene.index(name)
        found, state = seen.trial.scene.bodies[other], seen.trial.state
        center = _center(found, state.positions[other], state.rotations[other])
        expected = _center(body, true.positions[index], true.rotations[index])
        rows.append(
            {
                "agent": body.name == scene.roles.agent,
                "shape": found.shape == body.shape,
                "center": float(np.linalg.norm(center - expected)),
                "velocity": float(np.linalg.norm(state.velocities[other] - true.velocities[index])),
                "pair": f"{body.shape} as {found.shape}",
            }
        )
    return rows


def _center(body: Body, position: Any, rotation: Any) -> Any:
    return position + rotate_vectors(rotation, body_mass(body).center)


def read_rows(path: Path) -> dict[str, ROW]:
    """Return what is already measured, by stimulus."""
    if not path.exists():
        return {}
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return {row["stimulus"]: row for row in rows if row["version"] == VERSION}


def accuracy(p: Any, contact: Any) -> float:
    """Return the fraction of right answers; P = 1/2 counts half."""
    p = np.asarray(p, float)
    return float(np.mean(np.where(p == 0.5, 0.5, (p > 0.5) == np.asarray(contact, bool))))


def area(p: Any, contact: Any) -> float:
    """Return the probability that a trial with contact has the higher P, ties half."""
    p, contact = np.asarray(p, float), np.asarray(contact, bool)
    difference = p[contact][:, None] - p[~contact][None, :]
    if not difference.size:
        return float("nan")
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))


def tables(rows: list[ROW]) -> str:
    """Return both tables as Markdown."""
    table = pd.DataFrame(rows)
    parts = [(name, part) for name, part in table.groupby("scenario")] + [("all", table)]
    answers, errors = [], []
    for name, part in parts:
        contact = part["contact"]
        moving = part["constant motion"].fillna(0.5)
        spread = np.sqrt(
            accuracy(part["fitted"], contact) * (1 - accuracy(part["fitted"], contact))
        )
        answers.append(
            {
                "scenario": name,
                "trials": len(part),
                "fitted": f"{accuracy(part['fitted'], contact):.3f}",
                "se": f"{spread / np.sqrt(len(part)):.3f}",
                "AUC": f"{area(part['fitted'], contact):.3f}",
                "true state": f"{accuracy(part['true'], contact):.3f}",
                "AUC, true state": f"{area(part['true'], contact):.3f}",
                "agreement": f"{accuracy(part['fitted'], part['true'] > 0.5):.3f}",
                "change of P": f"{(part['fitted'] - part['true']).abs().mean():.3f}",
                "constant motion": f"{accuracy(moving, contact):.3f}",
            }
        )
        objects = pd.DataFrame([o for listed in part["objects"].dropna() for o in listed])
        agent, others = objects[objects["agent"]], objects[~objects["agent"]]
        errors.append(
            {
                "scenario": name,
                "agent, centre, cm": _quantiles(100 * agent["center"]),
                "agent, velocity, m/s": _quantiles(agent["velocity"]),
                "others, centre, cm": _quantiles(100 * others["center"]),
                "shape right": f"{int(objects['shape'].sum())} of {len(objects)}",
                "seconds, median": f"{part['seconds'].median():.1f}",
                "with a note": int((part["note"] != "").sum()),
            }
        )
    return f"{_markdown(answers)}\n\n{_markdown(errors)}\n"


def _quantiles(values: pd.Series) -> str:
    if not len(values):
        return "-"
    return f"{values.median():.2f} / {values.quantile(0.9):.2f}"


def _markdown(rows: list[ROW]) -> str:
    names = list(rows[0])
    lines = [names, ["---"] * len(names), *([str(row[name]) for name in names] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    """Measure what is missing, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--each", type=int, default=5)
    parser.add_argument("--known", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    path = options.folder / "seeing.jsonl"
    known = read_rows(path)
    rows = list(known.values()) if options.known else []
    for scene, contact in [] if options.known else chosen_trials(options.each):
        if scene.name not in known:
            known[scene.name] = measure(scene, contact)
            with path.open("a") as file:
                file.write(json.dumps(known[scene.name]) + "\n")
            row = known[scene.name]
            print(
                f"{scene.scenario} {scene.name}: contact {contact}, fitted {row['fitted']:.2f}, "
                f"true state {row['true']:.2f}, {row['seconds']:.1f} s; {row['note']}",
                flush=True,
            )
        rows.append(known[scene.name])
    text = tables(rows)
    print(text)
    if options.write:
        today = datetime.date.today().isoformat()
        RESULTS.write_text(
            f"# Seeing by simulation\n\n`python benchmarks/models/seeing.py FOLDER`, {len(rows)} "
            f"trials, {today}, version {VERSION} of the model, {SAMPLES} simulations per trial.\n\n"
            f"{text}"
        )


if __name__ == "__main__":
    main()
