"""Measure how well `seeing-simulation` recovers scenes, and what it answers.

    OMP_NUM_THREADS=1 python benchmarks/models/seeing.py FOLDER [--each 5] [--scenarios drape]
        [--depth-error 0.02 | --no-depth] [--own DATASET] [--known] [--against FILES] [--write]
    OMP_NUM_THREADS=1 python benchmarks/models/seeing.py --priors

Official stimuli that people saw, without a contact in the observed part: the first ``--each`` with
a contact and as many without one, of every one of ``--scenarios`` (the rigid ones), by the hash of
their names. Of each, the observed part is simulated and rendered, scene and state are fitted to
masks and depth, and both the fitted and the true state are simulated with the default noise. One
line per trial is appended to FOLDER/seeing.jsonl; an interrupted run continues there, and --known
prints what it has measured so far, with --version N by an earlier version of the model. Printed
are, by scenario:

1. Accuracy by recorded outcomes (P = 1/2 counts half) with standard error, and area under the curve
   (AUC), of the fitted and the true state; agreement with the true state, and the mean absolute
   change of P.
2. Accuracy of other predictions from the same states: simulation without noise, or with masses and
   friction as the model expects them (also with the fitted velocities; and the fitted state with
   the true ones), DPI-Net, `state-trees` with the readouts that ship, constant
   motion, and the answers for the other fitted trials of the scenario.
3. Differences between the accuracies of these, with standard errors of paired differences, of all
   trials, and without those that were looked at while the fit was written (``LOOKED_AT``).
4. Likeness to people, by `physion.compare`.
5. Errors at the last observed frame, median and 90 % quantile: centre of mass and velocity of the
   agent, centre of the other movable objects; how many have the right shape; and seconds of
   processor time of an answer.
6. What is wrong with trials in which the answer from the fitted state is worse or better than the
   one from the true state, and with the others; and how many answers are right if the velocities,
   or all but velocities, masses and friction, are the true ones.

With --depth-error E, the depth of each object has an error of standard deviation E, the same in
all frames, and each pixel another one; rows are in FOLDER/seeing-E.jsonl. With --no-depth masks and
the camera are all that is seen; rows are in FOLDER/seeing-masks.jsonl.

--own DATASET measures stored testing trials of our own instead, by their labels, without people.
Names of files end in the name of the dataset, and of scenarios that are not all rigid ones.

--against FILE compares with the rows of another run (.jsonl), or with a table of `physion evaluate`
(.csv, of one model), on the same stimuli.

With --write they are written to ``results/seeing.md``, ``seeing-E.md`` or ``seeing-masks.md``.
--priors prints density, friction and restitution of the bodies of our own presets, from which the
constants of the model come.
"""

from __future__ import annotations

import argparse
import datetime
import itertools
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

import physion
from intuition_trials import predicted
from physion.analysis.scores import TWO_PEOPLE
from physion.analysis.tables import read_humans
from physion.clips.batch import LAST_OBSERVED, SCENERY_ID, Batch, Motion
from physion.clips.rendered import MotionRenderer, object_ids
from physion.core.names import RIGID, SCENARIOS, canonical_name
from physion.core.seeds import generator, stable_hash
from physion.core.tables import markdown_table
from physion.data.official import official
from physion.models.baselines.motion import gap_in_constant_motion
from physion.models.build import build_model
from physion.models.noisy_simulation import (
    NoiseLevels,
    ObservedTrial,
    cut_trial,
    simulate_contacts,
)
from physion.models.seeing.scenes import (
    DENSITY,
    FLAT_TARGET,
    FRAMES,
    RAMP,
    RING_DENSITY,
    SURFACE,
    SeenTrial,
)
from physion.models.seeing.simulation import VERSION
from physion.numerics.rotations import rotate_vectors
from physion.physics.engine import make_engine, simulate
from physion.physics.rigid.bodies import body_mass
from physion.physics.trajectory import Contacts, Trajectory
from physion.readout.decisions import Readout
from physion.readout.shipped import find_readouts
from physion.scenes.scene import FRAME_TIME, OBSERVED_FRAMES, Body, Roles, Scene

RESULTS = Path(__file__).parents[1] / "results"
SAMPLES = 10
FRAMES_AHEAD = 106
PRIOR_SCENES = 12
LOOKED_AT = {"support": 3}
"""Trials per scenario and outcome that were looked at while the fit was written; 1 of others."""
LOOKED_AT_WITH_ERRORS = 3
"""The same of fits with errors of depth, of every scenario."""
STILL = NoiseLevels(position=0.0, velocity=0.0, mass=0.0)
ROW = dict[str, Any]


def official_scenes() -> list[tuple[Scene, bool]]:
    """Return the scenes that people saw, and their recorded outcomes."""
    seen = set(read_humans(official().humans)["stimulus"])
    trials = [t for t in official().trials if canonical_name(t.scene.name) in seen]
    return [(t.scene, bool(t.outcome.contact)) for t in trials]


def own_scenes(folder: Path) -> list[tuple[Scene, bool]]:
    """Return the scenes of stored testing trials without an observed contact, and their labels."""
    dataset = physion.Dataset(folder)
    rows = dataset.index[(dataset.index["split"] == "testing") & ~dataset.index["observed_contact"]]
    pairs = zip(rows["trial"], rows["contact"].astype(bool), strict=True)
    return [(dataset.trial(trial).scene, contact) for trial, contact in pairs]


def chosen_trials(
    trials: Sequence[tuple[Scene, bool]], each: int, early: Callable[[Scene], bool]
) -> Iterator[tuple[Scene, bool, int]]:
    """Yield scenes, outcomes and numbers, one of every scenario and outcome in turn.

    Scenes for which ``early`` is true are left out.
    """
    groups: dict[tuple[str, bool], list[Scene]] = {}
    for scene, contact in sorted(trials, key=lambda trial: stable_hash("noise", trial[0].name)):
        groups.setdefault((scene.scenario, contact), []).append(scene)
    late = [
        zip(itertools.repeat(contact), (s for s in group if not early(s)), range(each))
        for (_, contact), group in sorted(groups.items())
    ]
    for row in itertools.zip_longest(*late):
        yield from ((s, contact, number) for contact, s, number in filter(None, row))


def measure(scene: Scene, contact: bool, looked_at: bool, given: Mapping[str, Any]) -> ROW:
    """Return what is measured of one trial, with options of the model."""
    engine = make_engine()
    model = build_model("seeing-simulation", samples=SAMPLES, **given)
    motion = Motion(scene, simulate(scene, frames=OBSERVED_FRAMES))
    batch = _batch(motion, model.spec, bool(given), given.get("depth_error", 0.0))
    start = time.process_time()
    seen: SeenTrial = model.see(batch)[0]  # type: ignore[attr-defined]
    answered = float(np.mean(model.imagine(batch, SAMPLES, 0).contact))
    seconds = time.process_time() - start
    true = cut_trial(scene, motion.trajectory)
    expected = guessed(true)

    def answer(trial: Any, levels: NoiseLevels, samples: int) -> float:
        return float(np.mean(simulate_contacts(trial, levels, 1.0, samples, 0, engine)))

    def shared(trials: Iterable[tuple[ObservedTrial, int]]) -> float:
        return sum(n * answer(trial, NoiseLevels(), n) for trial, n in trials) / SAMPLES

    row: ROW = {
        "stimulus": scene.name,
        "version": VERSION,
        "scenario": scene.scenario,
        "contact": contact,
        "looked at": looked_at,
        "seconds": seconds,
        "fitted": answered,
        "true": answer(true, NoiseLevels(), SAMPLES),
        "true, no noise": answer(true, STILL, 1),
        "true, guessed": answer(expected, NoiseLevels(), SAMPLES),
        "note": seen.note,
    }
    others = {"true": motion}
    if seen.trial is not None:
        row["fitted, no noise"] = answer(seen.trial, STILL, 1)
        gap = gap_in_constant_motion(seen.trial.scene, seen.trial.state, FRAMES_AHEAD)
        row["fitted, constant motion"] = float(gap <= 0 or seen.trial.observed_contact)
        row["objects"] = _errors(seen, motion)
        others["fitted"] = fitted_motion(seen)
        fits = seen.shared(SAMPLES)
        if not scene.cloths and not seen.trial.scene.cloths:
            row["fitted, true velocities"] = shared(
                (with_velocities(fit, true), n) for fit, n in fits
            )
            row["true, fitted velocities"] = shared(
                (with_velocities(named(expected, fit), fit), n) for fit, n in fits
            )
    for name, observed in others.items():
        row[f"{name}, DPI-Net"] = _dpi(observed)
        row[f"{name}, state-trees"] = _trees(observed, scene.scenario)
    return row


def guessed(trial: ObservedTrial) -> ObservedTrial:
    """Return a trial with masses and surfaces as the model expects them of movable bodies."""
    bodies = [
        body
        if body.kinematic or body.scenery
        else replace(
            body,
            mass=(RING_DENSITY if body.shape == "torus" else DENSITY) * float(np.prod(body.scale)),
            contact=SURFACE,
        )
        for body in trial.scene.bodies
    ]
    return replace(trial, scene=replace(trial.scene, bodies=tuple(bodies)))


def with_velocities(trial: ObservedTrial, source: ObservedTrial) -> ObservedTrial:
    """Return a trial with the velocities that the same objects have in a source.

    Either may be fitted, with numbers as names of the bodies.
    """
    rows = _rows(source.scene)
    velocities = trial.state.velocities.copy()
    spins = trial.state.angular_velocities.copy()
    for number, row in _rows(trial.scene).items():
        if number in rows:
            velocities[row] = source.state.velocities[rows[number]]
            spins[row] = source.state.angular_velocities[rows[number]]
    state = replace(trial.state, velocities=velocities, angular_velocities=spins)
    return replace(trial, state=state)


def named(trial: ObservedTrial, source: ObservedTrial) -> ObservedTrial:
    """Return a trial with the name of another one's scene, which the noise depends on."""
    return replace(trial, scene=replace(trial.scene, name=source.scene.name))


def _rows(scene: Scene) -> dict[int, int]:
    """Return the rows of the bodies by number in masks."""
    if all(body.name.isdigit() for body in scene.bodies):
        return {int(body.name): row for row, body in enumerate(scene.bodies)}
    return {int(number): row for row, number in enumerate(object_ids(scene)[1:])}


def _batch(motion: Motion, spec: Any, every: bool, error: float) -> Batch:
    """Return the observed frames of one motion that the model looks at; depth may have an error.

    ``every``: whether these are all frames that it asks for; else `FRAMES`.
    """
    frames = np.array(spec.context_frames() if every else FRAMES, np.int64)
    name = motion.scene.name
    reader = MotionRenderer(
        {name: motion}, spec.inputs, spec.image_size, spec.objects, {name: "redyellow"}
    )
    arrays: Any = {key: value[None] for key, value in reader.read(name, frames).items()}
    if error:
        arrays["depth"] = with_errors(arrays["ids"], arrays["depth"], error, name)
    return Batch((name,), frames[None], np.ones((1, len(frames)), np.bool_), **arrays)


def with_errors(
    ids: NDArray[np.uint8], depth: NDArray[np.float32], error: float, name: str
) -> NDArray[np.float32]:
    """Return depth with normal relative errors: one of each object, and one of every pixel."""
    rng = generator("errors of depth", name)
    wrong = 1 + error * rng.standard_normal(depth.shape)
    for number in np.unique(ids[ids != SCENERY_ID]):
        wrong[ids == number] *= 1 + error * rng.standard_normal()
    return (depth * wrong).astype(np.float32)


def fitted_motion(seen: SeenTrial) -> Motion:
    """Return what was seen as a motion of the observed frames, without contacts.

    Objects move evenly between the frames in which they are seen; what is not seen in the last one
    is where the model takes it to be. The movable object that is the first to move counts as the
    one that is pushed. A cloth falls as the model simulates it.
    """
    assert seen.trial is not None
    scene, state = seen.trial.scene, seen.trial.state
    if scene.cloths:
        return Motion(scene, simulate(scene, frames=OBSERVED_FRAMES))
    times = np.arange(OBSERVED_FRAMES)
    poses = []
    for i, track in enumerate(seen.tracks):
        last = track.frames[-1] == LAST_OBSERVED
        frames = [*track.frames[: len(track.frames) - last], LAST_OBSERVED]
        placed = track.placed[: len(frames) - 1]
        places = np.array([*(p.position for p in placed), state.positions[i]])
        quaternion = np.roll(state.rotations[i], -1)
        turns = Rotation.concatenate(
            [*(Rotation.from_matrix(p.rotation) for p in placed), Rotation.from_quat(quaternion)]
        )
        within = np.clip(times, frames[0], LAST_OBSERVED)
        moved = np.column_stack([np.interp(within, frames, axis) for axis in places.T])
        turned = Slerp(frames, turns)(within) if len(frames) > 1 else turns[np.zeros_like(times)]
        poses.append((moved, turned))
    positions = np.stack([moved for moved, _ in poses], axis=1)
    velocities = np.diff(positions, axis=0, prepend=positions[:1]) / FRAME_TIME
    spins = np.zeros_like(velocities)
    for i, (_, turned) in enumerate(poses):
        spins[1:, i] = (turned[1:] * turned[:-1].inv()).as_rotvec() / FRAME_TIME
    velocities[-1], spins[-1] = state.velocities, state.angular_velocities
    rotations = np.stack([np.roll(turned.as_quat(), 1, axis=1) for _, turned in poses], axis=1)
    trajectory = Trajectory(
        positions.astype(np.float32),
        rotations.astype(np.float32),
        velocities.astype(np.float32),
        spins.astype(np.float32),
        np.zeros((OBSERVED_FRAMES, 0, 3), np.float32),
        np.full(OBSERVED_FRAMES, np.nan, np.float32),
        Contacts.empty(),
        False,
        "fitted",
    )
    speeds = np.linalg.norm(velocities, axis=2)
    speeds[:, [body.kinematic for body in scene.bodies]] = 0.0
    first = np.where((speeds > 0.1).any(axis=0), (speeds > 0.1).argmax(axis=0), OBSERVED_FRAMES)
    probe = scene.bodies[int(first.argmin())].name if first.min() < OBSERVED_FRAMES else None
    roles = Roles(scene.roles.agent, scene.roles.patient, probe)
    return Motion(replace(scene, roles=roles), trajectory)


def _state_batch(motion: Motion, spec: Any) -> Batch:
    frames = np.array(spec.context_frames(), np.int64)
    valid = np.ones((1, len(frames)), np.bool_)
    return Batch((motion.scene.name,), frames[None], valid, state=(motion,))


def _dpi(motion: Motion) -> float:
    """Return the answer of DPI-Net, by its distance at the end."""
    model = build_model("dpi")
    return float(model.imagine(_state_batch(motion, model.spec), 1, 0).end[0, 0] <= 0)


def _trees(motion: Motion, scenario: str) -> float:
    """Return the answer of `state-trees`, fitted to 500 own trials of the scenario."""
    model = build_model("state-trees")
    readouts = find_readouts(model)
    readout = None if readouts is None else readouts.find(Readout.OBSERVED, scenario)
    assert readout is not None
    features = model.encode(_state_batch(motion, model.spec))
    return float(readout.fitted.probability(features.reshape(1, -1))[0])


def read_rows(path: Path, version: int | None) -> dict[str, ROW]:
    """Return what is already measured with a version of the model, or any, by stimulus."""
    if not path.exists():
        return {}
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return {row["stimulus"]: row for row in rows if version in (None, row["version"])}


def _errors(seen: SeenTrial, motion: Motion) -> list[ROW]:
    """Return the errors of every movable object that was fitted."""
    assert seen.trial is not None
    scene, true = motion.scene, motion.trajectory.state(LAST_OBSERVED)
    numbers = object_ids(scene)[1:].tolist()
    rows = []
    for index, body in enumerate(scene.bodies):
        name = str(numbers[index])
        fitted = {other.name for other in seen.trial.scene.bodies}  # not as cloth
        if body.scenery or body.kinematic or name not in fitted:
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
            }
        )
    return rows


def _center(body: Body, position: Any, rotation: Any) -> Any:
    return position + rotate_vectors(rotation, body_mass(body).center)


# Tables.

NAMES = {
    "true": "true state",
    "true, no noise": "true state, no noise",
    "true, guessed": "true state, masses and friction guessed",
    "true, fitted velocities": "true state, masses and friction guessed, velocities fitted",
    "fitted": "fitted state",
    "fitted, no noise": "fitted state, no noise",
    "fitted, true velocities": "fitted state, true velocities",
    "true, DPI-Net": "DPI-Net, true states",
    "fitted, DPI-Net": "DPI-Net, fitted states",
    "true, state-trees": "state-trees, true states",
    "fitted, state-trees": "state-trees, fitted states",
    "fitted, constant motion": "constant motion, fitted state",
    "exchanged": "fits exchanged",
}
"""Names of the predictions in the tables, by column of the rows."""


def right(p: Any, contact: Any) -> NDArray[np.float64]:
    """Return 1 for right answers, 0 for wrong ones, and 1/2 for P = 1/2 or none."""
    p = np.nan_to_num(np.asarray(p, float), nan=0.5)
    return np.where(p == 0.5, 0.5, (p > 0.5) == np.asarray(contact, bool))


def area(p: Any, contact: Any) -> float:
    """Return the probability that a trial with contact has the higher P, ties half."""
    p, contact = np.asarray(p, float), np.asarray(contact, bool)
    difference = p[contact][:, None] - p[~contact][None, :]
    if not difference.size:
        return float("nan")
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))


PROPERTIES: Mapping[str, Callable[[ROW], bool]] = {
    "masses and friction: if guessed, the true state gives another answer": lambda row: (
        (row["true, guessed"] > 0.5) != (row["true"] > 0.5)
    ),
    "an object has another shape": lambda row: not all(o["shape"] for o in row["objects"]),
    "something was not seen well (a note)": lambda row: row["note"] != "",
    "the agent is more than 1 cm off": lambda row: any(
        o["center"] > 0.01 for o in row["objects"] if o["agent"]
    ),
    "another object is more than 3 cm off": lambda row: any(
        o["center"] > 0.03 for o in row["objects"] if not o["agent"]
    ),
    "a velocity is more than .3 m/s off": lambda row: any(
        o["velocity"] > 0.3 for o in row["objects"]
    ),
}
"""What may be wrong with a fitted trial."""
MENDED = {
    "with the true velocities the answer is right": "fitted, true velocities",
    "with all true but velocities, masses and friction, it is right": "true, fitted velocities",
}
"""Columns of rows in which a part of a fitted trial is replaced by the true one."""


def _properties(table: pd.DataFrame) -> list[ROW]:
    """Return how many trials have each property: where both states are as often right, and else.

    Trials without a fitted state are left out.
    """
    table = table[table["objects"].notna()]
    hits = [right(table[name], table["contact"]) for name in ("fitted", "true")]
    groups = {"worse": hits[0] < hits[1], "better": hits[0] > hits[1], "same": hits[0] == hits[1]}
    properties = dict(PROPERTIES)
    for title, column in MENDED.items():
        if column in table:
            properties[title] = lambda row, column=column: right(row[column], row["contact"]) == 1
    parts = {name: table[chosen].to_dict("records") for name, chosen in groups.items()}
    return [
        {
            "of the trials in which the answer from the fitted state is": name,
            **{f"{kind} ({len(rows)})": sum(map(has, rows)) for kind, rows in parts.items()},
        }
        for name, has in properties.items()
    ]


def _exchanged(table: pd.DataFrame) -> pd.Series:
    """Return for each trial how often the answers for the others of its scenario are right."""
    found = pd.Series(np.nan, table.index)
    for _, part in table.groupby("scenario"):
        for i in part.index:
            others = part.drop(i)
            if len(others):
                same = np.full(len(others), part.loc[i, "contact"])
                found[i] = right(others["fitted"], same).mean()
    return found


def tables(rows: Sequence[ROW], own: bool) -> str:
    """Return all tables as Markdown; nobody has seen ``own`` trials."""
    table = pd.DataFrame(list(rows))
    names = [name for name in NAMES if name in table]
    hits = pd.DataFrame({name: right(table[name], table["contact"]) for name in names})
    hits["exchanged"] = _exchanged(table)
    groups = [*table.groupby("scenario").groups.items(), ("all", table.index)]
    answers, others, errors = [], [], []
    for name, chosen in groups:
        part, hit = table.loc[chosen], hits.loc[chosen]
        agrees = right(part["fitted"], part["true"] > 0.5)
        answers.append(
            {
                "scenario": name,
                "trials": len(part),
                **{f"{NAMES[k]} (se)": _mean(hit[k]) for k in ("fitted", "true")},
                "AUC, fitted": f"{area(part['fitted'], part['contact']):.3f}",
                "AUC, true": f"{area(part['true'], part['contact']):.3f}",
                "agreement": f"{agrees.mean():.3f}",
                "change of P": f"{(part['fitted'] - part['true']).abs().mean():.3f}",
            }
        )
        columns = {NAMES[k]: f"{hit[k].mean():.3f}" for k in hits if k not in ("fitted", "true")}
        others.append({"scenario": name, **columns})
        objects = pd.DataFrame(
            [o for listed in part["objects"].dropna() for o in listed],
            columns=["agent", "shape", "center", "velocity"],
        ).astype({"agent": bool})
        agent, rest = objects[objects["agent"]], objects[~objects["agent"]]
        errors.append(
            {
                "scenario": name,
                "agent, centre, cm": _quantiles(100 * agent["center"]),
                "agent, velocity, m/s": _quantiles(agent["velocity"]),
                "others, centre, cm": _quantiles(100 * rest["center"]),
                "shape right": f"{int(objects['shape'].sum())} of {len(objects)}",
                "trials with a note": int((part["note"] != "").sum()),
                **({"seconds": _quantiles(part["seconds"])} if "seconds" in part else {}),
            }
        )
    if len(groups) > 2:
        answers.append(_mean_of_scenarios(table, hits))
    fresh = hits.index[~table["looked at"]]
    chosen = {f"all ({len(hits)})": hits.index}
    if len(fresh) < len(hits):
        chosen[f"not looked at before ({len(fresh)})"] = fresh
    compared = [("fitted", name) for name in hits if name != "fitted"]
    compared += [("true, guessed", "true"), ("fitted, state-trees", "true, state-trees")]
    if "true, fitted velocities" in hits:
        compared += [("true, fitted velocities", "true, guessed")]
        compared += [("fitted, true velocities", "true, guessed")]
    differences = [
        {
            "accuracy of": NAMES[a],
            "minus": NAMES[b],
            **{title: _mean((hits[a] - hits[b])[index]) for title, index in chosen.items()},
        }
        for a, b in compared
    ]
    people = [] if own else [_people(table)]
    parts = [answers, others, differences, *people, errors, _properties(table)]
    return "\n\n".join(_markdown(rows) for rows in parts if rows) + "\n"


def _mean_of_scenarios(table: pd.DataFrame, hits: pd.DataFrame) -> ROW:
    """Return the row of the mean over scenarios, each with the same weight."""
    means = hits[["fitted", "true"]].groupby(table["scenario"])
    errors = means.sem()
    return {
        "scenario": "mean of scenarios",
        "trials": len(table),
        **{
            f"{NAMES[k]} (se)": f"{means.mean()[k].mean():.3f} "
            f"({np.sqrt((errors[k] ** 2).sum()) / len(errors):.3f})"
            for k in ("fitted", "true")
        },
        **dict.fromkeys(("AUC, fitted", "AUC, true", "agreement", "change of P"), "-"),
    }


def _people(table: pd.DataFrame) -> list[ROW]:
    """Return likeness to people over all stimuli, by `physion.compare`."""
    chosen = [name for name in NAMES if name in table]
    given = {
        NAMES[name]: dict(zip(table["stimulus"], table[name].fillna(0.5), strict=True))
        for name in chosen
    }
    scores = physion.compare(given, humans="official").scores
    scores = scores[scores["scenario"] == "pooled"].set_index("model")
    columns = {
        "accuracy": "accuracy",
        "r": "r with people",
        "kappa_from_averages": "kappa with people",
        "r_beyond_outcome": "r beyond the outcome",
    }
    return [
        {
            "predictions": name,
            **{title: _interval(scores.loc[name], key) for key, title in columns.items()},
        }
        for name in [*given, TWO_PEOPLE]
    ]


def _interval(row: pd.Series, name: str) -> str:
    """Return a score with its 95 % interval."""
    if pd.isna(row[name]):
        return "-"
    return f"{row[name]:.3f} ({row[f'{name}_low']:.3f} to {row[f'{name}_high']:.3f})"


def _mean(values: Any) -> str:
    """Return mean and standard error."""
    values = np.asarray(values, float)
    return f"{values.mean():.3f} ({values.std(ddof=1) / np.sqrt(len(values)):.3f})"


def _quantiles(values: pd.Series) -> str:
    if not len(values):
        return "-"
    return f"{values.median():.2f} / {values.quantile(0.9):.2f}"


def _markdown(rows: Sequence[ROW]) -> str:
    names = list(rows[0])
    return markdown_table(names, [[row[name] for name in names] for row in rows])


def against(rows: Sequence[ROW], paths: Sequence[Path]) -> str:
    """Return paired differences of right answers from rows of any version, or from predictions."""
    lines = []
    for path in paths:
        if path.suffix == ".csv":
            (answers,) = predicted(path).values()
            other = answers.to_dict()
        else:
            other = {
                canonical_name(name): row["fitted"]
                for name, row in read_rows(path, None).items()
                if "early" not in row
            }
        inside = [row for row in rows if canonical_name(row["stimulus"]) in other]
        outside = [row for row in rows if canonical_name(row["stimulus"]) not in other]
        contact = [row["contact"] for row in inside]
        ours = right([row["fitted"] for row in inside], contact)
        theirs = right([other[canonical_name(row["stimulus"])] for row in inside], contact)
        line = {
            "against": path.stem,
            "trials": len(inside),
            "fitted state": _mean(ours),
            "other": _mean(theirs),
            "difference": _mean(ours - theirs),
            "other trials": len(outside),
            "fitted state there": "-",
            "less true state there": "-",
        }
        if len(outside) > 1:
            fitted, true = (
                right([row[name] for row in outside], [row["contact"] for row in outside])
                for name in ("fitted", "true")
            )
            line |= {
                "fitted state there": _mean(fitted),
                "less true state there": _mean(fitted - true),
            }
        lines.append(line)
    return _markdown(lines)


def priors() -> str:
    """Return what our own presets have, as Markdown: medians, and quantiles of the density."""
    scenes = {
        name: [physion.sample_scene(name, seed) for seed in range(PRIOR_SCENES)]
        for name in sorted(RIGID)
    }
    bodies = {name: [body for s in made for body in _movable(s)] for name, made in scenes.items()}
    every = [scene for made in scenes.values() for scene in made]
    bodies["all"] = [body for s in every for body in _movable(s)]
    bodies["flat targets"] = [
        target
        for s in every
        if (target := s.bodies[s.index(s.roles.patient)]).kinematic
        and target.scale[2] < FLAT_TARGET
    ]
    bodies["ramps"] = [b for s in every for b in s.bodies if b.shape.startswith(RAMP)]
    bodies["rings"] = [body for body in bodies["all"] if body.shape == "torus"]
    rows = [{"bodies": name, **_prior_row(chosen)} for name, chosen in bodies.items()]
    used = (
        f"The model takes {DENSITY:g} kg/m3, {RING_DENSITY:g} for rings, friction "
        f"{SURFACE.dynamic_friction:g} and restitution {SURFACE.restitution:g}."
    )
    return f"{_markdown(rows)}\n\n{used}\n"


def _movable(scene: Scene) -> Iterable[Body]:
    return (body for body in scene.bodies if not (body.kinematic or body.scenery))


def _prior_row(bodies: Sequence[Body]) -> ROW:
    density = [body.mass / float(np.prod(body.scale)) for body in bodies]
    low, middle, high = np.quantile(density, (0.1, 0.5, 0.9))
    row = {"number": len(bodies), "mass / product of scales, kg/m3": f"{middle:.1f}"}
    row["10 % to 90 %"] = f"{low:.1f} to {high:.1f}"
    for name in ("static_friction", "dynamic_friction", "restitution"):
        values = [getattr(body.contact, name) for body in bodies]
        row[name.replace("_", " ")] = f"{np.median(values):.2f}"
    return row


def main() -> None:
    """Measure what is missing, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--each", type=int, default=5)
    parser.add_argument("--depth-error", type=float, default=0.0)
    parser.add_argument("--no-depth", action="store_true")
    parser.add_argument("--own", type=Path, help="dataset, in place of the official stimuli")
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, default=RIGID)
    parser.add_argument("--known", action="store_true")
    parser.add_argument("--against", type=Path, nargs="*", default=[], help="rows, or predictions")
    parser.add_argument("--version", type=int, default=VERSION)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--priors", action="store_true")
    options = parser.parse_args()
    if options.priors:
        print(priors())
    if options.folder is None:
        return
    options.folder.mkdir(parents=True, exist_ok=True)
    given: dict[str, Any] = {"depth_error": options.depth_error} if options.depth_error else {}
    if options.no_depth:
        given["depth"] = False
    name = f"seeing-{options.depth_error:g}" if options.depth_error else "seeing"
    name = "seeing-masks" if options.no_depth else name
    name += f"-{options.own.name}" if options.own else ""
    path = options.folder / f"{name}.jsonl"
    options.known |= options.version != VERSION
    known = read_rows(path, options.version)

    def keep(row: ROW) -> None:
        known[row["stimulus"]] = row
        with path.open("a") as file:
            file.write(json.dumps(row) + "\n")

    def early(scene: Scene) -> bool:
        if scene.name not in known:
            seen = cut_trial(scene, simulate(scene, frames=OBSERVED_FRAMES))
            if seen.observed_contact:
                keep({"stimulus": scene.name, "version": VERSION, "early": True})
        return "early" in known.get(scene.name, {})

    rows = [row for row in known.values() if "early" not in row] if options.known else []
    rows = [row for row in rows if row["scenario"] in options.scenarios]
    trials: Sequence[tuple[Scene, bool]] = []
    if not options.known:
        trials = own_scenes(options.own) if options.own else official_scenes()
        trials = [trial for trial in trials if trial[0].scenario in options.scenarios]
    for scene, contact, number in chosen_trials(trials, options.each, early):
        if scene.name not in known:
            looked = LOOKED_AT_WITH_ERRORS if given else LOOKED_AT.get(scene.scenario, 1)
            keep(measure(scene, contact, not options.own and number < looked, given))
            row = known[scene.name]
            print(
                f"{scene.scenario} {scene.name}: contact {contact}, fitted {row['fitted']:.2f}, "
                f"true state {row['true']:.2f}; {row['note']}",
                flush=True,
            )
        rows.append(known[scene.name])
    text = tables(rows, bool(options.own))
    if options.against:
        text += f"\n{against(rows, options.against)}"
    print(text)
    if options.write:
        today = datetime.date.today().isoformat()
        error = f" --depth-error {options.depth_error:g}" if options.depth_error else ""
        error += " --no-depth" * options.no_depth + " --own DATASET" * bool(options.own)
        error += f" --each {options.each}"
        error += f" --version {options.version}" * (options.version != VERSION)
        if options.against:
            error += " --known --write --against " + " ".join(p.name for p in options.against)
        if set(options.scenarios) != set(RIGID):
            name += "-" + "-".join(options.scenarios)
            error += " --scenarios " + " ".join(options.scenarios)
        (RESULTS / f"{name}.md").write_text(
            f"# Seeing by simulation\n\n`python benchmarks/models/seeing.py FOLDER{error}`, "
            f"{len(rows)} trials, {today}, version {options.version} of the model, {SAMPLES} "
            f"simulations per trial.\n\n"
            f"{text}\n\n{priors()}"
        )


if __name__ == "__main__":
    main()
