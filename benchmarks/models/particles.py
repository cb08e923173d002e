"""What the particle models have learned: contacts, and errors of their rollouts.

    python benchmarks/models/particles.py data FOLDER  # trials without images
    python benchmarks/models/particles.py collide FOLDER --write  # three minutes, three seeds
    python benchmarks/models/particles.py transfer FOLDER --write  # trained without Collide
    python benchmarks/models/particles.py shipped FOLDER --write  # weights of the package
    python benchmarks/models/particles.py official FOLDER --write  # the same on official scenes
    python benchmarks/models/particles.py decisions FOLDER --write  # what turns rollouts into yes
    python benchmarks/models/particles.py futures FOLDER --write  # one and several, beside people
    python benchmarks/models/particles.py batched FOLDER --write  # rollouts together, one by one
    python benchmarks/models/particles.py symmetry FOLDER --write  # scenes that are rotated
    python benchmarks/models/particles.py memory FOLDER --write  # of one scene of Drape

``collide`` trains DPI-Net (small) on 300 trials of Collide, with swept and with plain edges, and
tests on 300 balanced trials without observed contact; `state-trees` are fitted on the same
300. Answers are those of one future, and P(contact) of 8 futures with noise on the velocities from
which they start.

``shipped`` and ``official`` are of the decision *touch*, whose distance was calibrated on contacts
of training trials. ``decisions`` compares all four decisions on all official stimuli that
people saw, or --limit of each scenario; only *gap* is fitted, on the other official trials.

``futures`` compares such answers of the shipped DPI-Net with those of the people who saw the
official scenes, Drape left out; outcomes are the recorded ones. ``symmetry`` compares the step
after the last observed frame with that of the same scene rotated by 1 rad about the vertical, for
shipped weights and untrained ones: the models have no such symmetry built in. ``memory`` does one
training step of one scene of Drape in a process of its own.

Times are processor time; use OMP_NUM_THREADS=1. With --write a section of ``results/particles.md``
is replaced.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import os
import resource
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

from physion import Dataset, build_model, sample_scene, simulate
from physion.analysis.tables import MEAN, POOLED, read_humans, read_predictions
from physion.clips.batch import LAST_OBSERVED, Batch, Motion, cut_to_observed
from physion.clips.clips import observed_source, whole_source
from physion.compute.tasks import processor
from physion.core.names import RIGID, canonical_name
from physion.core.tables import markdown_table
from physion.data.official import PACKAGED, humans_folder, official
from physion.models.build import build_untrained
from physion.models.particles.bodies import poses_of, rotation_from_vector, scene_particles
from physion.models.particles.networks import (
    ObjectState,
    SceneLayout,
    drift_of,
    join_poses,
    join_scenes,
    make_graph,
    rotate_scenes,
)
from physion.models.particles.simulator import OBJECTS, ParticleSimulator
from physion.physics.labels import label_contact
from physion.pipeline import plan_official
from physion.readout.evaluate import evaluate
from physion.readout.rollout_error import motion_error
from physion.readout.trees import fit_forest
from physion.report.compare import compare
from physion.scenes.sampling.build import scenarios
from physion.training.train import train_model
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_dataset

RESULTS = Path(__file__).parents[1] / "results" / "particles.md"
HORIZONS = (15, 30, 60, 90)
"""Frames after the last observed one at which errors are measured."""
GROUP = 64
"""Scenes of one rollout."""
FUTURES, SPREAD = 8, 0.1
"""Futures for P(contact), and standard deviation of the noise on their initial velocities, m/s."""
COLLIDE_STEPS = 2600
TRANSFER_STEPS = 5000
NAMES = ("dpi", "gns", "gns-ransac")
DECISIONS = ("end", "closest", "touch", "gap")

Rows = list[list[str]]


@dataclasses.dataclass(frozen=True)
class Tested:
    """Smallest gaps and outcomes of n trials, and errors (n, H) at the horizons, metres.

    ``observed`` (n,): contact within the observed part. ``constant``: errors of constant velocity.
    """

    gaps: NDArray[np.float64]
    contacts: NDArray[np.bool_]
    observed: NDArray[np.bool_]
    errors: NDArray[np.float64]
    constant: NDArray[np.float64]
    seconds: float

    def only(self, rows: NDArray[np.bool_]) -> Tested:
        """Return some of the trials."""
        names = [f.name for f in dataclasses.fields(self) if f.name != "seconds"]
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in names})

    def cells(self) -> list[str]:
        """Return number, accuracy, AUC, and errors after 30 and 60 frames."""
        right = np.mean((self.gaps <= 0) == self.contacts)
        both = len(set(self.contacts.tolist())) == 2
        auc = roc_auc_score(self.contacts, -self.gaps) if both else float("nan")
        pairs = [
            f"{np.nanmean(self.errors[:, h]):.3f} / {np.nanmean(self.constant[:, h]):.3f}"
            for h in (1, 2)
        ]
        return [str(len(self.gaps)), f"{right:.3f}", f"{auc:.3f}", *pairs]


def test(model: ParticleSimulator, motions: Sequence[Motion], contacts: Iterable[bool]) -> Tested:
    """Imagine the rest of every motion and compare."""
    start, gaps, errors, constant, observed = time.process_time(), [], [], [], []
    for first in range(0, len(motions), GROUP):
        group = motions[first : first + GROUP]
        cut = [Motion(m.scene, cut_to_observed(m.scene, m.trajectory)) for m in group]
        futures = model.futures(cut, 1, 0)
        gaps += model.gaps(cut, futures)[:, 0].tolist()
        for motion, ((particles, poses),) in zip(group, futures, strict=True):
            rows = motion_error(motion, particles, poses, model.spec.stride, max(HORIZONS))
            rows = rows.set_index("frames").reindex(HORIZONS)
            errors.append(rows["error"].tolist())
            constant.append(rows["constant_velocity_error"].tolist())
            observed.append(label_contact(motion.scene, motion.trajectory).observed)
    return Tested(
        np.array(gaps), np.array(list(contacts)), np.array(observed),
        np.array(errors), np.array(constant), time.process_time() - start,
    )  # fmt: skip


def fractions(
    model: ParticleSimulator,
    motions: Sequence[Motion],
    samples: int = FUTURES,
    spread: float = SPREAD,
) -> NDArray[np.float64]:
    """Return the fraction of futures with a contact, for every motion."""
    model.settings = dataclasses.replace(model.settings, spread=spread)
    cut = [Motion(m.scene, cut_to_observed(m.scene, m.trajectory)) for m in motions]
    step = GROUP // samples
    groups = [cut[first : first + step] for first in range(0, len(cut), step)]
    gaps = [model.gaps(group, model.futures(group, samples, 0)) for group in groups]
    return np.asarray((np.concatenate(gaps) <= 0).mean(axis=1))


def motions_of(dataset: Dataset, trials: Sequence[str]) -> tuple[list[Motion], list[bool]]:
    """Return motions and outcomes of trials."""
    files = [dataset.trial(trial) for trial in trials]
    motions = [Motion(file.scene, file.trajectory) for file in files]
    return motions, [label_contact(m.scene, m.trajectory).contact for m in motions]


def trained(
    dataset: Dataset, trials: Sequence[str], steps: int, **options: Any
) -> tuple[ParticleSimulator, float]:
    """Return a DPI-Net trained on some trials, and the processor time that it took."""
    model = build_untrained("dpi", **options)
    assert isinstance(model, ParticleSimulator)
    start = time.process_time()
    train_model(
        model, whole_source(dataset, model.spec), trials, name="benchmark", folder=None,
        settings=dataclasses.replace(model.training_settings, steps=steps),
        seed=model.settings.seed, accelerator="cpu",
    )  # fmt: skip
    return model, time.process_time() - start


def classified(
    dataset: Dataset, fitted_on: Sequence[str], tested: Dataset, trials: Sequence[str]
) -> tuple[float, float]:
    """Return accuracy and AUC of trees on the true state, fitted on some trials, on others."""
    model = build_model("state-trees")
    (fit, labels), (test, contacts) = (
        (
            model.encode(observed_source(source, model.spec).context(names)).reshape(
                len(names), -1
            ),
            motions_of(source, names)[1],
        )
        for source, names in ((dataset, fitted_on), (tested, trials))
    )
    predicted = fit_forest(fit, np.array(labels)).probability(test)
    right = (predicted > 0.5) == np.array(contacts)
    return float(right.mean()), float(roc_auc_score(contacts, predicted))


def make_data(folder: Path) -> None:
    """Make trials without images: of Collide, and of all scenarios."""
    settings = GenerateSettings(movies=False, jitters=0, min_visible=0.0)
    collide = {"training": 300, "testing": 300}
    counts = {"training": 220, "readout": 60, "testing": 60}
    for name, chosen, sizes in (
        ("collide", ("collide",), collide),
        ("all", tuple(scenarios.names()), counts),
    ):
        report = make_trials(folder / name, plan_dataset("physion", chosen, sizes), settings)
        print(f"{name}: {len(report.made)} made, {len(report.failed)} failed", flush=True)


def run_collide(folder: Path) -> str:
    """Return the table of three seeds with swept and with plain edges."""
    dataset = Dataset(folder / "collide")
    motions, contacts = motions_of(dataset, dataset.trials("testing"))
    rows = []
    for seed in range(3):
        for swept in (True, False):
            model, seconds = trained(
                dataset, dataset.trials("training"), COLLIDE_STEPS, seed=seed, swept=swept
            )
            tested, share = test(model, motions, contacts), fractions(model, motions)
            ratio = np.nanmean(tested.errors[:, 2]) / np.nanmean(tested.constant[:, 2])
            rows.append(
                [str(seed), "swept" if swept else "plain", f"{seconds:.0f}", *tested.cells(),
                 f"{ratio:.2f}", f"{np.mean((share > 0.5) == tested.contacts):.3f}",
                 f"{roc_auc_score(tested.contacts, share):.3f}"]
            )  # fmt: skip
            print(rows[-1], flush=True)
    of_several = [f"{name}, {FUTURES} futures" for name in ("accuracy", "AUC")]
    head = ["seed", "edges", "training, s", *HEAD, "of constant", *of_several]
    scores = classified(dataset, dataset.trials("training"), dataset, dataset.trials("testing"))
    return table(head, rows) + of_classifier("the same 300 trials", scores)


def run_transfer(folder: Path) -> str:
    """Return the table of a model and a classifier that never saw Collide."""
    dataset = Dataset(folder / "all")
    others = [t for t in dataset.trials("training") if not t.startswith("collide")]
    model, seconds = trained(dataset, others, TRANSFER_STEPS)
    collide = Dataset(folder / "collide")
    motions, contacts = motions_of(collide, collide.trials("testing"))
    tested = test(model, motions, contacts)
    both, n = tested.contacts.mean(), len(tested.contacts)
    error = np.sqrt((n + 1) / (12 * n * n * both * (1 - both)))
    scores = classified(dataset, others, collide, collide.trials("testing"))
    return (
        table(["model", "training, s", *HEAD], [["dpi-small", f"{seconds:.0f}", *tested.cells()]])
        + f"\nAn AUC of chance has a standard error of {error:.3f} (Mann and Whitney 1947).\n"
        + of_classifier("the same trials of the other scenarios", scores)
    )


def of_classifier(fitted_on: str, scores: tuple[float, float]) -> str:
    """Return a sentence on the scores of trees on the true state."""
    accuracy, auc = scores
    scored = f"accuracy {accuracy:.3f}, AUC {auc:.3f}"
    return f"\nTrees on the true state, fitted on {fitted_on}: {scored}.\n"


def run_shipped(folder: Path, name: str) -> str:
    """Return the table of a model with shipped weights on own testing trials."""
    dataset = Dataset(folder / "all")
    return "**Own testing trials, without observed contact**\n\n" + scores_of_shipped(
        name, *motions_of(dataset, dataset.trials("testing"))
    )


def run_official(_: Path, name: str) -> str:
    """Return the table of a model with shipped weights on official scenes, recorded outcomes.

    The true motion, from which errors are measured, is that of our simulation.
    """
    known = [trial for trial in official().trials if "familiarization" not in trial.scene.name]
    motions = [Motion(trial.scene, simulate(trial.scene)) for trial in known]
    return "**Official scenes, recorded outcomes**\n\n" + scores_of_shipped(
        name, motions, [trial.outcome.contact for trial in known]
    )


def run_decisions(folder: Path, name: str, limit: int) -> str:
    """Return scores beside people of every decision on the same rollouts of a model; GNS also with
    bodies that deform.
    """
    plan = plan_official(Path(PACKAGED), humans_folder(Path(PACKAGED)), limit)
    settings = GenerateSettings(movies=False, jitters=0, min_visible=0.0, look="redyellow")
    make_trials(folder / "official", plan.tasks, settings)
    trials, out = folder / "official", folder / "models"
    models: list[dict[str, Any]] = [{"weights": "shipped"}]
    models += [{"weights": "shipped", "rigid": "free"}] if name == "gns" else []
    paths = [
        path
        for options in models
        for decision in DECISIONS
        for path in evaluate({name: options}, trials, out, decision=decision).paths
    ]
    labels = {canonical_name(name): contact for name, contact in plan.recorded.items()}
    result = compare(paths, humans=humans_folder(Path(PACKAGED)), labels=labels)
    return next_to_people(result.scores) + "\n" + held_out(paths, labels)


def next_to_people(scores: pd.DataFrame) -> str:
    """Return accuracy, mean over scenarios, and likeness to people, all stimuli pooled."""
    columns = {"accuracy": MEAN, "r": POOLED, "kappa_from_averages": POOLED,
               "r_beyond_outcome": POOLED}  # fmt: skip
    lines = []
    for model, rows in scores.groupby("model", sort=False):
        by_scenario = rows.set_index("scenario")
        cells = [str(by_scenario.loc[POOLED, "stimuli"])]
        for name, which in columns.items():
            value, low, high = (by_scenario.loc[which, f"{name}{end}"] for end in ENDS)
            spread = f" ({low:.3f} to {high:.3f})" if np.isfinite(low) else ""
            cells.append(f"{value:.3f}{spread}" if np.isfinite(value) else "-")
        lines.append([str(model), *cells])
    return table(["row", "stimuli", "accuracy", "r", "kappa", "r beyond the outcome"], lines)


ENDS = ("", "_low", "_high")
"""Endings of the columns of a score and its interval."""


def held_out(paths: Sequence[Path], outcomes: Mapping[str, bool]) -> str:
    """Return the accuracies over all trials of the rigid scenarios, also without observed contact.

    The sections of official scenes have the same numbers for the decision *touch*, on all trials.
    """
    rows = read_predictions(paths)
    rows = rows[rows["scenario"].isin(RIGID)]
    names = rows["stimulus"].map(canonical_name)
    rows = rows[names.isin(set(outcomes))].assign(truth=names.map(outcomes))
    right = (rows["p_contact"] > 0.5) == rows["truth"].astype(bool)
    lines = []
    for model, own in rows.assign(right=right).groupby("base_model"):
        later = own[~own["observed_contact"].astype(bool)]
        cells = [(str(len(part)), f"{part['right'].mean():.3f}") for part in (own, later)]
        lines.append([str(model), *cells[0], *cells[1]])
    head = ["model", "trials", "accuracy", "without observed contact", "accuracy"]
    return "Seven rigid scenarios, recorded outcomes, trials pooled\n\n" + table(head, lines)


def run_futures(_: Path) -> str:
    """Return accuracy, and r with people, of one future and of several."""
    people = read_humans(official().humans).set_index("stimulus")["accuracy"]
    trials = [
        trial
        for trial in official().trials
        if canonical_name(trial.scene.name) in people.index and trial.scene.scenario in RIGID
    ]
    contacts = np.array([trial.outcome.contact for trial in trials])
    right = people.loc[[canonical_name(trial.scene.name) for trial in trials]].to_numpy(float)
    said_yes = np.where(contacts, right, 1 - right)
    names = np.array([trial.scene.scenario for trial in trials])
    motions = [Motion(trial.scene, simulate(trial.scene)) for trial in trials]
    model = build_model("dpi", weights="shipped")
    assert isinstance(model, ParticleSimulator)
    rows = []
    for samples, spread in ((1, 0.0), (8, 0.05), (8, 0.1)):
        share = fractions(model, motions, samples, spread)
        hits = (share > 0.5) == contacts
        each = [(hits[names == name].mean(), correlation(share, said_yes, names == name))
                for name in RIGID]  # fmt: skip
        accuracy, r = np.mean(each, axis=0)
        rows.append(
            [str(samples), f"{spread:g}" if samples > 1 else "-", f"{accuracy:.3f}", f"{r:.3f}",
             f"{correlation(share, said_yes, np.ones_like(contacts)):.3f}"]
        )  # fmt: skip
        print(rows[-1], flush=True)
    head = ["futures", "noise, m/s", "accuracy, mean of scenarios", "r, mean of scenarios", "r"]
    return f"{model.name}, {len(trials)} scenes\n\n" + table(head, rows)


def correlation(
    share: NDArray[np.float64], people: NDArray[np.float64], rows: NDArray[np.bool_]
) -> float:
    """Return the correlation of P(contact) with the fraction of people who said yes."""
    return float(np.corrcoef(share[rows], people[rows])[0, 1])


def scores_of_shipped(name: str, motions: Sequence[Motion], contacts: Sequence[bool]) -> str:
    """Return the table of a model with shipped weights by scenario."""
    model = build_model(name, weights="shipped")
    assert isinstance(model, ParticleSimulator)
    tested = test(model, motions, contacts)
    scenario_of = np.array([motion.scene.scenario for motion in motions])
    rigid = np.isin(scenario_of, RIGID)
    parts = {scenario: scenario_of == scenario for scenario in sorted(set(scenario_of))}
    parts["seven rigid"] = rigid
    if tested.observed.any():
        parts["of these without observed contact"] = rigid & ~tested.observed
    rows = [[model.name, part, *tested.only(chosen).cells()] for part, chosen in parts.items()]
    print(rows[-1], f"{tested.seconds:.0f} s", flush=True)
    return table(["model", "scenario", *HEAD], rows)


def run_batched(folder: Path) -> str:
    """Return the times of rollouts of 64 scenes together and one by one, side by side."""
    dataset = Dataset(folder / "collide")
    motions, _ = motions_of(dataset, dataset.trials("testing")[:GROUP])
    cut = [Motion(m.scene, cut_to_observed(m.scene, m.trajectory)) for m in motions]
    model = build_model("dpi", weights="shipped")
    assert isinstance(model, ParticleSimulator)
    model.futures(cut[:2], 1, 0)
    rows = []
    for _ in range(3):
        start = time.process_time()
        model.futures(cut, 1, 0)
        together = time.process_time() - start
        start = time.process_time()
        for motion in cut:
            model.futures([motion], 1, 0)
        apart = time.process_time() - start
        rows.append([f"{together:.2f}", f"{apart:.2f}", f"{apart / together:.1f}"])
    return table(["together, s", "one by one, s", "ratio"], rows)


HEAD = ["trials", "accuracy", "AUC", "error 30, m / constant", "error 60, m / constant"]


def run_symmetry(folder: Path) -> str:
    """Return the table of differences between rotated predictions and those of rotated scenes."""
    dataset = Dataset(folder / "all")
    motions, _ = motions_of(dataset, dataset.trials("testing", "collide"))
    rotation = rotation_from_vector(torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
    rows = []
    for name in NAMES:
        for weights in ("shipped", "random"):
            model: Any = build_model(name, weights=weights)
            changes, differences = [], []
            for motion in motions:
                layout, before, now = last_states(model, motion)
                with torch.no_grad():
                    after = model.step(layout, before, now)
                    other = model.step(
                        layout,
                        rotate_scenes(before, layout, rotation),
                        rotate_scenes(now, layout, rotation),
                    )
                drift = drift_of(layout, before, now)
                change = after.positions(layout) - drift.positions - drift.moves
                rotated = rotate_scenes(after, layout, rotation).positions(layout)
                changes.append(float(change.norm(dim=-1).mean()))
                differences.append(float((rotated - other.positions(layout)).norm(dim=-1).mean()))
            mean, difference = 1000 * np.mean(changes), 1000 * np.mean(differences)
            cells = [f"{mean:.3f}", f"{difference:.3f}", f"{difference / mean:.2f}"]
            rows.append([model.name, weights, str(len(motions)), *cells])
            print(rows[-1], flush=True)
    head = ["model", "weights", "trials", "change of a particle, mm", "difference, mm", "ratio"]
    return table(head, rows) + (
        "\nChange: by the network, of the motion in a step of 0.03 s; mean over particles, "
        "then trials."
    )


def last_states(
    model: ParticleSimulator, motion: Motion
) -> tuple[SceneLayout, ObjectState, ObjectState]:
    """Return the layout of a scene and its last two observed states."""
    particles = scene_particles(motion.scene, model.settings.sampling)
    poses = [poses_of(particles, motion, [LAST_OBSERVED - 3, LAST_OBSERVED])]
    before, now = (join_poses(poses, row, model.device) for row in (0, 1))
    return join_scenes([particles], model.device), before, now


def run_memory(_: Path) -> str:
    """Return the table of particles, edges and memory of a training step of one scene of Drape."""
    rows = []
    for name in ("dpi", "gns"):
        for size in ("small", "paper"):
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                rows.append([f"{name}-{size}", *pool.submit(step_of_drape, name, size).result()])
                print(rows[-1], flush=True)
    return table(["model", "particles", "edges", "before, MB", "at most, MB"], rows)


def step_of_drape(name: str, size: str) -> list[str]:
    """Return particles, edges, and the memory of this process before and at most."""
    scene = sample_scene("drape", 1)
    motion = Motion(scene, simulate(scene))
    model: Any = build_model(name, size=size)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    frames = np.arange(30, 30 + 3 * model.window, 3)[None]
    batch = Batch((scene.name,), frames, np.ones_like(frames, np.bool_), state=(motion,))
    model.train().loss(batch)["loss"].backward()
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    layout, *states = last_states(model, motion)
    drift = drift_of(layout, *states)
    settings = model.settings
    graph = make_graph(
        layout, drift, settings.radius, 1.0,
        swept=settings.swept, within=settings.within, roots=settings.network == OBJECTS,
    )  # fmt: skip
    counts = [len(layout.owners), len(graph.senders), before // 1024, most // 1024]
    return [f"{count:,}" for count in counts]


def table(head: list[str], rows: Rows) -> str:
    """Return a Markdown table that ends with a new line."""
    return markdown_table(head, rows) + "\n"


def report(section: str, command: str, text: str, write: bool) -> None:
    """Print a result, and replace its section of the file of results if asked to."""
    print(text)
    if not write:
        return
    head = "# Particle models\nMade by `benchmarks/models/particles.py`.\n"
    old = RESULTS.read_text() if RESULTS.is_file() else head
    parts = old.split("\n## ")
    kept = [part for part in parts[1:] if not part.startswith(section + "\n")]
    made = f"{datetime.date.today()}, {processor()}, "
    made += f"{os.cpu_count()} cores, torch {torch.__version__}: "
    made += f"`OMP_NUM_THREADS=1 python benchmarks/models/particles.py {command} --write`"
    new = f"{section}\n{made}\n\n{text.strip()}\n"
    RESULTS.write_text("\n## ".join([parts[0], *sorted([*kept, new])]))


def main() -> None:
    """Run one of the benchmarks."""
    runs = {
        "collide": run_collide, "transfer": run_transfer, "futures": run_futures,
        "batched": run_batched, "symmetry": run_symmetry, "memory": run_memory,
    }  # fmt: skip
    by_model = {"shipped": run_shipped, "official": run_official}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["data", *runs, *by_model, "decisions"])
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--models", nargs="+", choices=NAMES, default=NAMES, help="of shipped, official, decisions"
    )
    parser.add_argument(
        "--limit", type=int, default=0, help="stimuli of each scenario, of decisions; 0: all"
    )
    parser.add_argument("--write", action="store_true")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    what = chosen.what
    if what == "data":
        make_data(chosen.folder)
        return
    if what in runs:
        report(what, f"{what} FOLDER", runs[what](chosen.folder), chosen.write)
        return
    for name in chosen.models:
        command = f"{what} FOLDER --models {name}"
        if what == "decisions":
            text = run_decisions(chosen.folder, name, chosen.limit)
            command += f" --limit {chosen.limit}" if chosen.limit else ""
        else:
            text = by_model[what](chosen.folder, name)
        report(f"{what}, {name}", command, text, chosen.write)


if __name__ == "__main__":
    main()
