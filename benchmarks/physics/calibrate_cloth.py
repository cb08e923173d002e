"""Calibrate cloth on the official Drape trials, cross-validated by configuration.

    python benchmarks/physics/calibrate_cloth.py SCENES --workers 2 [--gaps FILE]

Each candidate changes one quantity of the cloth within its physical bounds. All trials are
simulated with each. A trial's score is its smallest gap between cloth and patient; that the trial
was recorded as contact has the probability

    p = e / 2 + (1 - e) / (1 + exp((gap - t) / s)),

with the threshold t, the width s and the fraction e (`UNTOLD`) of trials whose outcome does not
depend on the gap. Every configuration is held out once. t and s are those with the largest
likelihood on the other configurations; in the last line the candidate is chosen so too. A held-out
trial is predicted as contact if gap < t. Printed: agreement and mean log likelihood of held-out
trials, and the area under the curve of the gap. benchmarks/results/calibration_cloth.md says what
was kept.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.physics.cloth.simulate import ClothSettings, settle_solids, simulate_cloth
from physion.physics.cloth.solver import CLOTH_CONTACT_GAP
from physion.physics.replay import area_under_curve
from physion.scenes.scene import Scene
from physion.scenes.tdw.read_logs import ImportedTrial, read_scenes

Floats = NDArray[np.float64]
Truth = NDArray[np.bool_]
Names = NDArray[np.str_]
FRAMES = 151
UNTOLD = 0.1
"""Fraction e of trials whose outcome does not depend on the gap."""
THRESHOLDS = np.arange(-0.012, 0.002, 0.0001)
WIDTHS = (0.0003, 0.0005, 0.001, 0.002, 0.004)


@dataclass(frozen=True)
class Candidate:
    """One way to simulate: what it changes in the settings and in the sheets, and why it may be."""

    name: str
    why: str
    settings: dict[str, Any] = field(default_factory=dict)
    cloth: dict[str, Any] = field(default_factory=dict)
    apart: bool = True


BEFORE = {"particle_friction": 0.5}
"""What the settings were before this calibration; candidates change one more thing."""
KEPT = "particle friction 1"
CANDIDATES = (
    Candidate("before", "particle friction 0.5"),
    Candidate("solids do not part", "each only lowered to the floor (before)", apart=False),
    Candidate("particle friction 0.25", "0.5 was read, not sent", {"particle_friction": 0.25}),
    Candidate("particle friction 1", "as sent for shapes", {"particle_friction": 1.0}),
    Candidate("damping 0.5", "1 was read, not sent", {"damping": 0.5}),
    Candidate("iterations 6", "8 was read, not sent", {"iterations": 6}),
    Candidate("iterations 10", "8 was read, not sent", {"iterations": 10}),
    Candidate("rest distance 0.122", "0.65 of the radius", {"rest_distance": 0.122}),
    Candidate("floor gap 0.0125", "half of the collision distance", {"floor_gap": 0.0125}),
    Candidate("41 vertices a side", "the sheet's mesh is not known", cloth={"resolution": 41}),
    Candidate("46 vertices a side", "the sheet's mesh is not known", cloth={"resolution": 46}),
    Candidate("56 vertices a side", "the sheet's mesh is not known", cloth={"resolution": 56}),
    Candidate("no bending springs", "they may be fewer", cloth={"bend": 0.0}),
    Candidate("stretch 1", "full stiffness", cloth={"stretch": 1.0}),
)


def settled(scene: Scene, settings: ClothSettings, apart: bool) -> Scene:
    """The scene with settled bodies; unless ``apart``, each settles as if it were alone."""
    if apart:
        return settle_solids(scene, settings)
    role = scene.roles.patient
    bodies = []
    for body in scene.bodies:
        alone = replace(scene, bodies=(replace(body, name=role),))
        bodies.append(replace(settle_solids(alone, settings).bodies[0], name=body.name))
    return replace(scene, bodies=tuple(bodies))


def smallest_gap(trial: ImportedTrial, candidate: Candidate) -> float:
    """Smallest gap in metres between cloth and patient in one trial."""
    settings = ClothSettings(**{**BEFORE, **candidate.settings})
    sheets = tuple(replace(cloth, **candidate.cloth) for cloth in trial.scene.cloths)
    scene = settled(replace(trial.scene, cloths=sheets), settings, candidate.apart)
    positions = np.tile([body.position for body in scene.bodies], (FRAMES, 1, 1))
    rotations = np.tile([body.rotation for body in scene.bodies], (FRAMES, 1, 1))
    return float(simulate_cloth(scene, positions, rotations, settings).distance.min())


def log_likelihood(gaps: Floats, recorded: Truth, threshold: float, width: float) -> float:
    """Sum of the logarithms of the probabilities of the recorded outcomes."""
    sigma = 1 / (1 + np.exp(np.clip((gaps - threshold) / width, -50, 50)))
    contact = UNTOLD / 2 + (1 - UNTOLD) * sigma
    return math.fsum(np.log(np.where(recorded, contact, 1 - contact)))


def fit(gaps: Floats, recorded: Truth) -> tuple[float, float, float]:
    """Log likelihood, threshold and width, those with the largest likelihood."""
    return max(
        (log_likelihood(gaps, recorded, t, s), float(t), s) for t in THRESHOLDS for s in WIDTHS
    )


@dataclass(frozen=True)
class Row:
    """Line of the table: held-out agreement and mean log likelihood, AUC, thresholds fitted."""

    name: str
    agreement: float
    likelihood: float
    auc: float
    thresholds: tuple[float, float]


def cross_validate(
    name: str, found: dict[str, Floats], recorded: Truth, group: Names, allowed: Sequence[str]
) -> Row:
    """Hold out each configuration once; choose among ``allowed`` candidates on the others."""
    agrees, likelihood, thresholds = [], [], []
    gaps_used = np.empty(len(recorded))
    for held in np.unique(group):
        out = group == held
        fits = {each: fit(found[each][~out], recorded[~out]) for each in allowed}
        best = max(allowed, key=lambda each: fits[each][0])
        _, threshold, width = fits[best]
        gaps = found[best][out]
        # Gaps are compared over configurations relative to the threshold fitted without them.
        gaps_used[out] = gaps - threshold
        agrees += ((gaps < threshold) == recorded[out]).tolist()
        likelihood.append(log_likelihood(gaps, recorded[out], threshold, width))
        thresholds.append(threshold)
    total = math.fsum(likelihood) / len(recorded)
    auc = area_under_curve(-gaps_used if len(allowed) > 1 else -found[allowed[0]], recorded)
    return Row(name, float(np.mean(agrees)), total, auc, (min(thresholds), max(thresholds)))


def table(found: dict[str, Floats], recorded: Truth, group: Names) -> str:
    """The table of all candidates, and what follows for the threshold."""
    names = [candidate.name for candidate in CANDIDATES if candidate.name in found]
    rows = [cross_validate(name, found, recorded, group, (name,)) for name in names]
    rows.append(cross_validate("chosen on the others", found, recorded, group, names))
    why = {candidate.name: candidate.why for candidate in CANDIDATES}
    lines = [
        "| candidate | why possible | agreement, held out | log likelihood, held out | AUC | "
        "thresholds, mm |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        low, high = (1000 * t for t in row.thresholds)
        lines.append(
            f"| {row.name} | {why.get(row.name, 'largest likelihood')} | {row.agreement:.3f} | "
            f"{row.likelihood:.3f} | {row.auc:.3f} | {low:.1f} to {high:.1f} |"
        )
    gaps = found[KEPT]
    _, threshold, width = fit(gaps, recorded)
    rate = float(np.mean(recorded))
    lines += [
        "",
        f"{len(recorded)} trials of {len(np.unique(group))} configurations, base rate "
        f"{max(rate, 1 - rate):.3f}. {KEPT}, all trials: the likelihood is largest at a "
        f"threshold of {1000 * threshold:.1f} mm (width {1000 * width:.1f} mm), agreement "
        f"{np.mean((gaps < threshold) == recorded):.3f}; with the package's "
        f"{1000 * CLOTH_CONTACT_GAP:.1f} mm "
        f"{np.mean((gaps < CLOTH_CONTACT_GAP) == recorded):.3f}.",
    ]
    return "\n".join(lines)


def main() -> None:
    """Simulate all trials with all candidates, cross-validate, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--gaps", type=Path, help="JSON file of gaps, read and completed")
    options = parser.parse_args()
    trials = read_scenes(options.scenes, "drape").unique()[0]
    recorded = np.array([trial.outcome.contact for trial in trials])
    group = np.array([trial.scene.name.rpartition("_")[0] for trial in trials])
    kept = options.gaps is not None and options.gaps.is_file()
    found = json.loads(options.gaps.read_text()) if kept else {}
    with ProcessPoolExecutor(options.workers) as pool:
        for candidate in CANDIDATES:
            if candidate.name not in found:
                gaps = pool.map(smallest_gap, trials, [candidate] * len(trials), chunksize=4)
                found[candidate.name] = list(gaps)
                print(f"{candidate.name}: simulated", flush=True)
                if options.gaps is not None:
                    options.gaps.write_text(json.dumps(found))
    print(table({name: np.array(gaps) for name, gaps in found.items()}, recorded, group))


if __name__ == "__main__":
    main()
