"""Fit unknown quantities of the official scenes, one at a time, with cross-validation.

    python benchmarks/calibrate.py FOLDER [--only friction_sweeps pipe_inner] [--runs 4] [--write]

Every quantity has a list of values within physical bounds; the present value is among them. A trial
is simulated once as it is and ``--runs`` times with 1 mm of jitter, and gets the logarithm of the
likelihood of everything that its log records:

- outcome: (k + 1/2) / (n + 1) with k of n runs having the recorded outcome;
- first frame with contact, number of frames: mean over the runs of a Laplace density (3 and 10
  frames), mixed with 5 % of a uniform density;
- final position of the target: mean over the runs of exp(-r / s) / (8 pi s^3) with s = 0.1 m,
  mixed with 5 % of a uniform density over 30 m^3.

For the last three, a run without the event counts as density 0 before the mixing. Configurations
are divided into folds; for each fold the value with the largest sum over the *other* folds is
chosen, and its gain over the present value is counted on the fold itself. A change is worth keeping
if this gain is larger than its standard error over configurations. Only trials with a shape that
the quantity concerns are simulated. ``--write`` appends a table to
benchmarks/results/calibration.md.
"""

from __future__ import annotations

import argparse
import datetime
import math
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from physion.physics.jitter import jitter_scene
from physion.physics.labels import label_contact
from physion.physics.rigid import hulls, mass
from physion.physics.rigid.engine import RigidEngine
from physion.physics.rigid.settings import RigidSettings
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import Scene, SurfaceMaterial
from physion.scenes.shapes import primitives
from physion.scenes.tdw.read_logs import ImportedTrial, read_scenes
from physion.seeds import child_generator, trial_seed

RESULTS = Path(__file__).parent / "results" / "calibration.md"
JITTER = 0.001
FRAME_SCALE, LENGTH_SCALE, POSITION_SCALE = 3.0, 10.0, 0.1
UNIFORM = 0.05
FRAMES, VOLUME = 300.0, 30.0
RIGID = ("dominoes", "support", "collide", "contain", "drop", "link", "roll")
Change = Callable[[Any], Callable[[], None]]


@dataclass(frozen=True)
class Quantity:
    """Something unknown: the present value first, then others.

    ``field`` names a field of `RigidSettings`, ``constant`` a constant of the module of shapes;
    ``shapes`` the shapes that it concerns, by default all. ``room`` is the one whose floor height
    is meant.
    """

    name: str
    values: tuple[Any, ...]
    field: str = ""
    constant: str = ""
    room: str = ""
    shapes: tuple[str, ...] = ()
    module: Any = primitives


def material(friction: float) -> SurfaceMaterial:
    """Material of the floor with equal static and dynamic friction."""
    return SurfaceMaterial(friction, friction, 0.0)


QUANTITIES = {
    q.name: q
    for q in (
        Quantity("friction_sweeps", (3, 0), field="friction_sweeps"),
        Quantity("persistent_manifolds", (True, False), field="persistent_manifolds"),
        Quantity(
            "floor_friction",
            tuple(material(value) for value in (0.6, 0.4, 0.8)),
            field="floor",
        ),
        Quantity("floor_height", (0.0043, 0.0, 0.002, 0.004, 0.006), room="bright"),
        Quantity("ball_segments", (16, 12, 14, 20, 24), constant="BALL_SEGMENTS", module=hulls,
                 shapes=("sphere",)),
        Quantity("pipe_inner", (0.389, 0.25, 0.3, 0.33, 0.35, 0.37, 0.42),
                 constant="PIPE_PIECE_INNER", shapes=("pipe",)),
        Quantity("pipe_sectors", (16, 8, 32), constant="PIPE_SECTORS", shapes=("pipe",)),
        Quantity("torus_inner", (0.429, 0.34, 0.355, 0.37, 0.385, 0.40, 0.45),
                 constant="TORUS_PIECE_INNER", shapes=("torus",)),
        Quantity("torus_sectors", (16, 8, 4), constant="TORUS_SECTORS", shapes=("torus",)),
        Quantity("torus_bevel", (0.06, 0.001, 0.03, 0.09, 0.12), constant="TORUS_BEVEL",
                 shapes=("torus",)),
        Quantity("bowl_flat", (0.2, 0.1, 0.15, 0.25, 0.3), constant="BOWL_FLAT", shapes=("bowl",)),
        Quantity("bowl_wall", (0.035, 0.02, 0.028, 0.045, 0.06), constant="BOWL_PIECE_WALL",
                 shapes=("bowl",)),
        Quantity("cylinder_sides", (16, 12, 20, 24, 32), constant="CYLINDER_SIDES", module=hulls,
                 shapes=("cylinder",)),
        Quantity("cone_sides", (22, 16, 32), constant="CONE_SEGMENTS", shapes=("cone",)),
        Quantity("ramp_foot", (1.629, 1.5, 1.58, 1.68), constant="RAMP_FOOT",
                 shapes=("ramp_with_platform_30", "ramp_with_platform_60")),
    )
}  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """A quantity with one of its values; without a quantity everything is as it is."""

    quantity: str | None
    index: int

    def engine(self) -> RigidEngine:
        """Change the shapes of this process as the variant says, and return its engine."""
        for name, module, value in _originals:
            setattr(module, name, value)
        settings = RigidSettings()
        if self.quantity is not None:
            quantity = QUANTITIES[self.quantity]
            value = quantity.values[self.index]
            if quantity.field:
                settings = replace(settings, **{quantity.field: value})
            if quantity.constant:
                setattr(quantity.module, quantity.constant, value)
        for cached in (
            primitives.shape,
            hulls._unit_hulls,
            hulls.collision_hulls,
            mass._body_mass,
            mass._unit_moments,
        ):
            cached.cache_clear()
        return RigidEngine(settings, threads=1)

    def scene(self, scene: Scene) -> Scene:
        """Return the scene with the variant's height of the floor."""
        quantity = None if self.quantity is None else QUANTITIES[self.quantity]
        if quantity is None or not quantity.room or scene.room != quantity.room:
            return scene
        return replace(scene, floor=quantity.values[self.index])


_originals = [
    (q.constant, q.module, getattr(q.module, q.constant)) for q in QUANTITIES.values() if q.constant
]
_trials: list[ImportedTrial] = []


def load(folder: Path) -> None:
    """Read the trials with a recorded outcome, once for each process."""
    if _trials:
        return
    for scenario in RIGID:
        trials, _ = read_scenes(folder, scenario).unique()
        _trials.extend(trials)


def concerns(quantity: Quantity, trial: ImportedTrial) -> bool:
    """Return whether the trial has a shape or room that the quantity concerns."""
    if quantity.room:
        return trial.scene.room == quantity.room
    shapes = {body.shape for body in trial.scene.bodies if not body.scenery}
    return not quantity.shapes or bool(shapes & set(quantity.shapes))


def laplace(difference: float, scale: float) -> float:
    """Return the density of a difference of frames."""
    return math.exp(-abs(difference) / scale) / (2.0 * scale)


def log_mixture(densities: list[float], uniform: float) -> float:
    """Return the logarithm of the mean density mixed with a uniform one."""
    return math.log((1.0 - UNIFORM) * math.fsum(densities) / len(densities) + UNIFORM * uniform)


def score(trial: ImportedTrial, runs: list[tuple[Scene, Trajectory]]) -> list[float]:
    """Return the log-likelihoods of a trial: outcome, first contact, frames, final position."""
    outcome = trial.outcome
    hits = 0
    first, length, position = [], [], []
    end = None if outcome.final_position is None else np.array(outcome.final_position)
    for scene, path in runs:
        labels = label_contact(scene, path)
        hits += labels.contact == outcome.contact
        if labels.first_frame is not None and outcome.first_frame is not None:
            first.append(laplace(labels.first_frame - outcome.first_frame, FRAME_SCALE))
        else:
            first.append(0.0)
        length.append(laplace(len(path) - outcome.frames, LENGTH_SCALE))
        if end is not None:
            away = float(np.linalg.norm(path.positions[-1, scene.index(scene.roles.agent)] - end))
            unit = 8.0 * math.pi * POSITION_SCALE**3
            position.append(math.exp(-away / POSITION_SCALE) / unit)
    return [
        math.log((hits + 0.5) / (len(runs) + 1.0)),
        log_mixture(first, 1.0 / FRAMES) if outcome.first_frame is not None else 0.0,
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
        rows.append(score(trial, [(s, engine.simulate(s)) for s in scenes]))
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
            total = rows[:, :, :4].sum(axis=2)
            gain, error, chosen = cross_validate(total, configurations)
            lines += report(quantity, rows, gain, error, chosen, time.time() - started)
            print("\n".join(lines[-len(quantity.values) - 6 :]), flush=True)
    if options.write:
        cpu = platform.processor() or platform.machine()
        head = [
            f"\n## {datetime.date.today()}, {cpu}, `python benchmarks/calibrate.py FOLDER "
            f"--runs {options.runs}`\n"
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
        "| value | agreement | outcome | first contact | frames | final position | sum |",
        "|---|---|---|---|---|---|---|",
    ]
    for index, value in enumerate(quantity.values):
        mean = rows[index].mean(axis=0)
        shown = shown_value(value)
        parts = " | ".join(f"{part:.3f}" for part in mean[:4])
        lines.append(f"| {shown} | {mean[4]:.3f} | {parts} | {mean[:4].sum():.3f} |")
    picks = ", ".join(str(shown_value(quantity.values[c])) for c in chosen)
    lines.append("")
    lines.append(
        f"Held-out gain of choosing: {gain:+.4f} nats a trial (standard error {error:.4f}); chosen "
        f"in the folds: {picks}."
    )
    return lines


if __name__ == "__main__":
    main()
