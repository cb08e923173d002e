"""Fit unknown quantities of the official scenes, one at a time, with cross-validation.

    python benchmarks/physics/calibrate.py FOLDER [--only friction_sweeps ...] [--runs 4] [--write]

Every quantity has a list of values within physical bounds; the present value is among them. A trial
is simulated once as it is and ``--runs`` times with 1 mm of jitter, and gets the logarithm of the
likelihood of everything that its log records:

- outcome: (k + 1/2) / (n + 1) with k of n runs having the recorded outcome;
- first frame with contact, first frame in which the target is more than 1 cm from its start (where
  the recorded one is that of the target), number of frames: mean over the runs of a Laplace density
  (3, 3 and 10 frames), mixed with 5 % of a uniform density;
- final position of the target: mean over the runs of exp(-r / s) / (8 pi s^3) with s = 0.1 m,
  mixed with 5 % of a uniform density over 30 m^3.

For all but the first, a run without the event counts as density 0 before the mixing. Configurations
are divided into folds; for each fold the value with the largest sum over the *other* folds is
chosen, and its gain over the present value is counted on the fold itself. A change is worth keeping
if this gain is larger than its standard error over configurations. Only trials with a shape that
the quantity concerns are simulated. With trials of one or two configurations, single trials take
the place of configurations, which tells less: they share what is wrong with their configuration.
``--write`` appends a table to benchmarks/results/calibration.md.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from calibration_quantities import QUANTITIES, Quantity
from physion.compute.tasks import processor
from physion.core.names import RIGID
from physion.core.seeds import child_generator, trial_seed
from physion.physics.labels import jitter_scene, label_contact
from physion.physics.rigid import bodies as hulls
from physion.physics.rigid import bodies as mass
from physion.physics.rigid.bodies import RigidSettings
from physion.physics.rigid.engine import RigidEngine
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import Scene, SurfaceMaterial, Vec3
from physion.scenes.shapes import primitives
from physion.scenes.shapes.primitives import Shape
from physion.scenes.tdw.read_logs import ImportedTrial, read_scenes

RESULTS = Path(__file__).parents[1] / "results" / "calibration.md"
JITTER = 0.001
FRAME_SCALE, LENGTH_SCALE, POSITION_SCALE = 3.0, 10.0, 0.1
UNIFORM = 0.05
FRAMES, VOLUME = 300.0, 30.0
MOVED = 0.01
"""Distance in metres from its start at which the official target "has moved"."""
PARTS = ("outcome", "first contact", "first motion", "frames", "final position")
MOTION_RECORDED = ("MultiDominoes", "Collision", "RollingSliding")
"""Controllers that record the first motion of the target. The others replace the target after they
have noted where it is, or count from the origin."""


@dataclass(frozen=True)
class Variant:
    """A quantity with one of its values; without a quantity everything is as it is."""

    quantity: str | None
    index: int

    def engine(self) -> RigidEngine:
        """Change the shapes of this process as the variant says, and return its engine."""
        for name, module, value in _originals:
            setattr(module, name, value)
        for cached in CACHED:
            cached.cache_clear()
        settings = RigidSettings()
        if self.quantity is not None:
            quantity = QUANTITIES[self.quantity]
            value = quantity.values[self.index]
            if quantity.field:
                settings = replace(settings, **{quantity.field: value})
            if quantity.constant:
                setattr(quantity.module, quantity.constant, value)
            if quantity.build is not None:
                replace_shape(quantity.shapes[0], quantity.build(value))
            if quantity.mass is not None:
                replace_mass(quantity.shapes[0], quantity.mass, value)
        return RigidEngine(settings, threads=1)

    def scene(self, scene: Scene) -> Scene:
        """Return the scene with the variant's height of the floor, or its other changes."""
        if self.quantity is None:
            return scene
        quantity, value = QUANTITIES[self.quantity], QUANTITIES[self.quantity].values[self.index]
        if quantity.scene is not None:
            return quantity.scene(scene, value)
        if not quantity.room or scene.room != quantity.room:
            return scene
        return replace(scene, floor=value)


CACHED = (
    primitives.shape,
    hulls._unit_hulls,
    hulls.collision_hulls,
    mass._body_mass,
    mass._unit_moments,
)
"""Functions that remember shapes."""
_originals = [
    (q.constant, q.module, getattr(q.module, q.constant)) for q in QUANTITIES.values() if q.constant
]
_originals += [("shape", hulls, primitives.shape), ("_body_mass", mass, mass._body_mass)]
_trials: list[ImportedTrial] = []
_motions: list[int | None] = []


def replace_shape(name: str, changed: Shape) -> None:
    """Let bodies of the shape ``name`` collide as ``changed``."""
    present = primitives.shape
    setattr(hulls, "shape", lambda asked: changed if asked == name else present(asked))  # noqa: B010


def replace_mass(
    name: str, change: Callable[[Any, mass.MassProperties], mass.MassProperties], value: Any
) -> None:
    """Let bodies of the shape ``name`` have changed mass properties."""
    present = mass._body_mass

    def changed(asked: str, scale: Vec3, kilograms: float) -> mass.MassProperties:
        found = present(asked, scale, kilograms)
        return change(value, found) if asked == name else found

    setattr(mass, "_body_mass", changed)  # noqa: B010


def load(folder: Path) -> None:
    """Read the trials with a recorded outcome, once for each process."""
    if _trials:
        return
    for scenario in RIGID:
        trials, _ = read_scenes(folder, scenario).unique()
        _trials.extend(trials)
    motions = read_first_motions(folder)
    _motions.extend(motions.get(trial.scene.name) for trial in _trials)


def read_first_motions(folder: Path) -> dict[str, int | None]:
    """Return the recorded first frame in which the target has moved, by name of the trial."""
    found = {}
    for path in folder.rglob("metadata.json"):
        for record in json.loads(path.read_text()):
            if record["controller_name"] in MOTION_RECORDED:
                found[record["stimulus_name"]] = record["first_target_move_frame"]
    return found


def concerns(quantity: Quantity, trial: ImportedTrial) -> bool:
    """Return whether the trial has a shape or room that the quantity concerns."""
    if quantity.room:
        return trial.scene.room == quantity.room
    if quantity.configurations not in str(trial.scene.parameters.get("configuration")):
        return False
    shapes = {body.shape for body in trial.scene.bodies if not body.scenery}
    return not quantity.shapes or bool(shapes & set(quantity.shapes))


def laplace(difference: float, scale: float) -> float:
    """Return the density of a difference of frames."""
    return math.exp(-abs(difference) / scale) / (2.0 * scale)


def log_mixture(densities: list[float], uniform: float) -> float:
    """Return the logarithm of the mean density mixed with a uniform one."""
    return math.log((1.0 - UNIFORM) * math.fsum(densities) / len(densities) + UNIFORM * uniform)


def first_motion(scene: Scene, path: Trajectory) -> int | None:
    """Return the first frame in which the target has moved, None if it never does."""
    start = np.array(scene.bodies[scene.index(scene.roles.agent)].position)
    away = np.linalg.norm(path.positions[:, scene.index(scene.roles.agent)] - start, axis=1)
    return int(np.argmax(away > MOVED)) if bool((away > MOVED).any()) else None


def score(
    trial: ImportedTrial, motion: int | None, runs: list[tuple[Scene, Trajectory]]
) -> list[float]:
    """Return the log-likelihoods of a trial, as in `PARTS`, and whether the first run agrees.

    ``motion`` is the recorded first frame of the target's motion.
    """
    outcome = trial.outcome
    hits = 0
    first, moved, length, position = [], [], [], []
    end = None if outcome.final_position is None else np.array(outcome.final_position)
    for scene, path in runs:
        labels = label_contact(scene, path)
        hits += labels.contact == outcome.contact
        if labels.first_frame is not None and outcome.first_frame is not None:
            first.append(laplace(labels.first_frame - outcome.first_frame, FRAME_SCALE))
        else:
            first.append(0.0)
        if motion is not None:
            frame = first_motion(scene, path)
            moved.append(0.0 if frame is None else laplace(frame - motion, FRAME_SCALE))
        length.append(laplace(len(path) - outcome.frames, LENGTH_SCALE))
        if end is not None:
            away = float(np.linalg.norm(path.positions[-1, scene.index(scene.roles.agent)] - end))
            unit = 8.0 * math.pi * POSITION_SCALE**3
            position.append(math.exp(-away / POSITION_SCALE) / unit)
    return [
        math.log((hits + 0.5) / (len(runs) + 1.0)),
        log_mixture(first, 1.0 / FRAMES) if outcome.first_frame is not None else 0.0,
        log_mixture(moved, 1.0 / FRAMES) if moved else 0.0,
        log_mixture(length, 1.0 / FRAMES),
        log_mixture(position, 1.0 / VOLUME) if position else 0.0,
        float(label_contact(*runs[0]).contact == outcome.contact),
    ]


def run_chunk(
    folder: Path, variant: Variant, indices: list[int], repeats: int
) -> list[list[float]]:
    """Return the scores of some trials under a variant."""
    load(folder)
    engine = variant.engine()
    rows = []
    for index in indices:
        trial = _trials[index]
        scene = variant.scene(trial.scene)
        seed = trial_seed("jitter", scene.scenario, scene.name, 0)
        draws = [child_generator(seed, f"repeat {repeat}") for repeat in range(repeats)]
        scenes = [scene, *(jitter_scene(scene, JITTER, draw) for draw in draws)]
        rows.append(score(trial, _motions[index], [(s, engine.simulate(s)) for s in scenes]))
    return rows


def fold_of(configurations: list[str], folds: int) -> list[int]:
    """Return the fold of each trial; trials of one configuration share it."""
    names = sorted(set(configurations))
    return [names.index(name) % folds for name in configurations]


def cross_validate(
    scores: np.ndarray, configurations: list[str], folds: int = 5
) -> tuple[float, float, list[int]]:
    """Return the mean held-out gain of choosing a value, its standard error, and the choices.

    ``scores`` (V, n) are log-likelihoods of the trials under each value, the present one first.
    """
    fold = np.array(fold_of(configurations, folds))
    gain = np.zeros(scores.shape[1])
    chosen = []
    for k in range(min(folds, len(set(configurations)))):
        best = int(np.argmax(scores[:, fold != k].sum(axis=1)))
        chosen.append(best)
        gain[fold == k] = scores[best, fold == k] - scores[0, fold == k]
    names = np.array(configurations)
    sums = np.array([gain[names == name].sum() for name in sorted(set(configurations))])
    error = math.sqrt(len(sums) * float(np.var(sums, ddof=1))) if len(sums) > 1 else math.nan
    return float(gain.mean()), error / len(gain), chosen


def main() -> None:
    """Score all values of the chosen quantities, and print one table for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", choices=sorted(QUANTITIES), default=None)
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    load(options.folder)
    lines = []
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        base: dict[int, list[float]] = {}
        for name in options.only or QUANTITIES:
            quantity = QUANTITIES[name]
            started = time.time()
            indices = [i for i, trial in enumerate(_trials) if concerns(quantity, trial)]
            if not indices:
                lines.append(f"\n### {name}: no trial with such a shape in the folder")
                print(lines[-1], flush=True)
                continue
            configurations = [
                str(_trials[i].scene.parameters.get("configuration")) for i in indices
            ]
            table = []
            for value in range(len(quantity.values)):
                variant = Variant(None, 0) if value == 0 else Variant(name, value)
                todo = [i for i in indices if value or i not in base]
                chunks = [todo[k :: 8 * options.workers] for k in range(8 * options.workers)]
                chunks = [chunk for chunk in chunks if chunk]
                futures = [
                    pool.submit(run_chunk, options.folder, variant, chunk, options.runs)
                    for chunk in chunks
                ]
                found = dict(base) if value == 0 else {}
                for chunk, future in zip(chunks, futures, strict=True):
                    found.update(zip(chunk, future.result(), strict=True))
                if value == 0:
                    base = found
                table.append([found[i] for i in indices])
            rows = np.array(table)
            total = rows[:, :, : len(PARTS)].sum(axis=2)
            groups = configurations
            if len(set(configurations)) < 3:
                groups = [_trials[i].scene.name for i in indices]
            gain, error, chosen = cross_validate(total, groups)
            lines += report(quantity, rows, gain, error, chosen, time.time() - started)
            print("\n".join(lines[-len(quantity.values) - 6 :]), flush=True)
    if options.write:
        cpu = processor()
        head = [
            f"\n## {datetime.date.today()}, {cpu}, `python benchmarks/physics/calibrate.py FOLDER "
            f"{' '.join(sys.argv[2:])}`\n"
        ]
        with RESULTS.open("a") as file:
            file.write("\n".join(head + lines) + "\n")


def shown_value(value: Any) -> Any:
    """Return a value as it stands in a table: for a material its friction."""
    return value.static_friction if isinstance(value, SurfaceMaterial) else value


def report(
    quantity: Quantity,
    rows: np.ndarray,
    gain: float,
    error: float,
    chosen: list[int],
    seconds: float,
) -> list[str]:
    """Return the table of one quantity."""
    lines = [
        f"\n### {quantity.name}: {rows.shape[1]} trials, {seconds:.0f} s",
        "",
        f"| value | agreement | {' | '.join(PARTS)} | sum |",
        "|---|---|" + "---|" * (len(PARTS) + 1),
    ]
    for index, value in enumerate(quantity.values):
        mean = rows[index].mean(axis=0)
        shown = shown_value(value)
        parts = " | ".join(f"{part:.3f}" for part in mean[:-1])
        lines.append(f"| {shown} | {mean[-1]:.3f} | {parts} | {mean[:-1].sum():.3f} |")
    picks = ", ".join(str(shown_value(quantity.values[c])) for c in chosen)
    lines.append("")
    lines.append(
        f"Held-out gain of choosing: {gain:+.4f} nats a trial (standard error {error:.4f}); chosen "
        f"in the folds: {picks}."
    )
    return lines


if __name__ == "__main__":
    main()
