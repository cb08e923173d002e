"""Make own trials and official stimuli in memory, and keep only what models of intuition see.

    OMP_NUM_THREADS=1 python benchmarks/models/intuition_trials.py FOLDER --trials 1000 [--official]
    python benchmarks/models/intuition_trials.py FOLDER --stored TRIALS --models intuition-pixels

A trial is sampled from the published configurations in turn, simulated until agent and patient
touch, and drawn at the observed frames. Of trials with the digest of a training trial, without a
contact in the observed part, and with agent and patient visible in the first frame, the features of
all `MODELS` are written to FOLDER/own, in files of `EACH` trials. With --official the same of the
stimuli that people saw goes to FOLDER/official; with --stored the training trials of a dataset go
to FOLDER/own, but for those with the scene of an official one. With --look free objects have the
colours of their scenes, and intuition-pixels has a cue in the first frame. The same command
continues.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from physion import Dataset
from physion.clips.batch import Batch, Motion, Spec
from physion.clips.source import ObservedSource, TrialReaders
from physion.clips.states import TrialMotions, cut_motion
from physion.core.errors import BadSceneError
from physion.core.files import write_atomic
from physion.core.names import RIGID, SCENARIOS, canonical_name
from physion.core.seeds import trial_seed
from physion.data.official import official
from physion.models.build import build_model, build_untrained
from physion.models.interface import ask
from physion.physics.engine import make_engine
from physion.physics.labels import label_contact
from physion.readout.decisions import fraction_of_futures
from physion.readout.folds import describe_fit
from physion.readout.model_calls import is_network
from physion.scenes.sampling.sample import load_presets, sample_scene
from physion.scenes.scene import OBSERVED_FRAMES, Scene
from physion.trials.making.choose import split_of
from ship_readouts import Pictures

MODELS = (
    "state-trees", "mask-trees", "blob-trees", "intuition-states", "intuition-masks",
    "intuition-pixels",
)  # fmt: skip
EACH = 25
"""Trials of a file."""
VISIBLE = 0.0005
"""Smallest fraction of the first frame that agent and patient cover, as in `physion generate`."""
SET = "intuition"
"""Name of the set, which is the seed of its trials."""


@dataclass(frozen=True)
class Seen:
    """What models see of a trial, by the name of the model, and what is known of it.

    ``scene`` is its JSON.
    """

    trial: str
    scenario: str
    configuration: str
    contact: bool
    observed_contact: bool
    scene: str
    features: Mapping[str, NDArray[Any]]


FACTS = ("trial", "scenario", "configuration", "contact", "observed_contact", "scene")
"""What is stored of a trial besides its features."""


@cache
def encoder(name: str, **settings: Any) -> Any:
    """Return a model whose features are made; they depend on no weights."""
    return build_untrained(name, **settings)


@dataclass(frozen=True)
class Kept:
    """What is kept of trials: features of ``models``, seen in the colours of ``look``."""

    folder: Path
    models: Sequence[str] = MODELS
    look: str = "redyellow"

    def encoders(self) -> dict[str, Any]:
        """Return the models that make the features, by name."""
        cue = {"cue": True} if self.look == "free" else {}
        return {
            name: encoder(name, **cue if name == "intuition-pixels" else {}) for name in self.models
        }

    def made(self) -> dict[str, str]:
        """Return what the features of each model depend on, as a digest."""
        return {name: ask(model, "encoder_digest")() for name, model in self.encoders().items()}


def see(motion: Motion, kept: Kept) -> dict[str, NDArray[Any]]:
    """Return the features of a motion by model."""
    name = motion.scene.name
    motions, looks = {name: cut_motion(motion)}, {name: kept.look}
    drawn: dict[int, Pictures] = {}

    def read(spec: Spec) -> Batch:
        if not spec.sees_pictures:
            readers = TrialReaders({name: OBSERVED_FRAMES}, [], motions)
        else:
            size = spec.image_size
            shown: Any = drawn.setdefault(size, Pictures(motions, size, looks))  # type: ignore[arg-type]
            readers = TrialReaders({name: OBSERVED_FRAMES}, [shown.reader(spec)])
        return ObservedSource(spec, readers).context([name])

    def features(model: Any) -> NDArray[np.float32]:
        batch = read(model.spec)
        with torch.no_grad():
            found = model.encode(batch.to("cpu") if is_network(model) else batch)
        return np.asarray(found[0], np.float32)

    return {name: features(model) for name, model in kept.encoders().items()}


def own_trial(scenario: str, number: int, kept: Kept) -> Seen:
    """Return one own trial, the first of its samples that is accepted."""
    presets = [p for p in load_presets(scenario).values() if p.official]
    engine, attempt = make_engine("physion"), -1
    while True:
        attempt += 1
        preset = presets[(number + attempt // 40) % len(presets)]
        seed = trial_seed(SET, scenario, "training", number, attempt)
        try:
            scene = sample_scene(scenario, seed, preset.params)
        except BadSceneError:
            continue
        if split_of(scene.physics_digest()) != "training":
            continue
        scene = replace(scene, name=f"{scenario}_training_{number:05d}")
        trajectory = engine.simulate(scene, until_contact=True)
        labels = label_contact(scene, trajectory)
        if labels.observed or len(trajectory) < OBSERVED_FRAMES:
            continue
        features = see(Motion(scene, trajectory), kept)
        if visible(features["intuition-masks"]):
            return Seen(
                scene.name, scenario, preset.official or "", labels.contact, False,
                scene.to_json(), features,
            )  # fmt: skip


def visible(tokens: NDArray[np.float32]) -> bool:
    """Return whether agent and patient cover enough of the first frame, by tokens of masks."""
    first = tokens[0].reshape(encoder("intuition-masks").settings.objects, -1)
    return bool((first[:2, 1] ** 2 >= VISIBLE).all())


def official_scenes() -> list[tuple[Scene, bool]]:
    """Return the official scenes that people saw, and their recorded outcomes."""
    data = official()
    trials = [t for t in data.trials if canonical_name(t.scene.name) in data.labels]
    unique = {canonical_name(trial.scene.name): trial for trial in trials}
    return [(trial.scene, bool(trial.outcome.contact)) for trial in unique.values()]


def official_trial(scene: Scene, contact: bool, kept: Kept) -> Seen:
    """Return an official stimulus, of which only the observed part is simulated."""
    trajectory = make_engine("physion").simulate(scene, frames=OBSERVED_FRAMES)
    labels = label_contact(scene, trajectory)
    # A name with _2 at its end is a second name of the same configuration.
    configuration = scene.name.rpartition("_")[0].removesuffix("_2")
    return Seen(
        canonical_name(scene.name), scene.scenario, configuration, contact,
        bool(labels.observed), scene.to_json(), see(Motion(scene, trajectory), kept),
    )  # fmt: skip


def stored_trial(trial: str, row: Mapping[str, Any], motion: Motion, kept: Kept) -> Seen:
    """Return a trial that is stored in a dataset, with its row of the index."""
    preset = load_presets(row["scenario"]).get(row["preset"])
    configuration = preset.official if preset and preset.official else row["preset"]
    return Seen(
        trial, row["scenario"], configuration, bool(row["contact"]), bool(row["observed_contact"]),
        motion.scene.to_json(), see(motion, kept),
    )  # fmt: skip


def write(path: Path, trials: Sequence[Seen], kept: Kept) -> None:
    """Write trials to a file that has all of them or does not exist."""
    arrays = {n: np.stack([t.features[n] for t in trials]) for n in trials[0].features}
    facts = {name: np.array([getattr(trial, name) for trial in trials]) for name in FACTS}
    buffer = io.BytesIO()
    made = np.array(json.dumps(kept.made()))
    np.savez(buffer, look=np.array(kept.look), made=made, **facts, **arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, buffer.getvalue())


def made_alike(stored: Any, kept: Kept) -> bool:
    """Return whether a file has features of the models as they are now, in the same look."""
    if "made" not in stored.files or str(stored["look"]) != kept.look:
        return False
    return kept.made().items() <= json.loads(str(stored["made"])).items()


def there(path: Path, kept: Kept) -> bool:
    """Return whether a file was made; exit if it keeps something else."""
    if not path.exists():
        return False
    with np.load(path) as stored:
        if not made_alike(stored, kept):
            raise SystemExit(
                f"{path} was made with other --models or --look, or other versions of the models; "
                "take a new FOLDER"
            )
    return True


def make_own(kept: Kept, task: tuple[str, int]) -> str:
    """Make one file of own trials, if it is not there."""
    scenario, part = task
    path = kept.folder / "own" / f"{scenario}-{part:04d}.npz"
    if not there(path, kept):
        start = time.process_time()
        numbers = range(part * EACH, (part + 1) * EACH)
        write(path, [own_trial(scenario, number, kept) for number in numbers], kept)
        return f"{path.stem} {(time.process_time() - start) / EACH:.2f} s a trial"
    return ""


def make_official(kept: Kept, part: int) -> str:
    """Make one file of official stimuli, if it is not there."""
    path = kept.folder / "official" / f"{part:04d}.npz"
    if not there(path, kept):
        scenes = official_scenes()[part * EACH : (part + 1) * EACH]
        write(path, [official_trial(scene, contact, kept) for scene, contact in scenes], kept)
        return f"official {path.stem}"
    return ""


@cache
def opened(folder: Path) -> tuple[pd.DataFrame, Any, str]:
    """Return training trials without a contact in the observed part, their files, and a digest."""
    dataset = Dataset(folder)
    index = dataset.index[dataset.index["split"] == "training"]
    index = index[~index["observed_contact"].astype(bool)].set_index("trial")
    return index, dataset.files("trial_file"), describe_fit(dataset).split()[-1]


@cache
def official_digests() -> frozenset[str]:
    """Return the digests of the physics of all official scenes."""
    return frozenset(trial.scene.physics_digest() for trial in official().trials)


def make_stored(dataset: Path, kept: Kept, part: int) -> str:
    """Make one file of trials of a dataset, without those with the scene of an official one."""
    index, files, digest = opened(dataset)
    path = kept.folder / "own" / f"stored-{digest}-{part:04d}.npz"
    if not there(path, kept):
        motions = TrialMotions(files, observed=True)
        rows = index.iloc[part * EACH : (part + 1) * EACH].to_dict("index")
        write(
            path,
            [
                stored_trial(str(trial), row, motions[str(trial)], kept)
                for trial, row in rows.items()
                if motions[str(trial)].scene.physics_digest() not in official_digests()
            ],
            kept,
        )
        return path.stem
    return ""


# Noisy simulations of trials, from the true state at the last observed frame.


def simulated(
    folder: Path, trials: Mapping[str, str], scale: float, samples: int, contact: float = 0.0
) -> pd.Series:
    """Return the fraction of noisy simulations with a contact, by trial.

    ``trials`` are scenes, as JSON, by name; ``contact`` is the level of noise at new contacts. What
    was simulated is kept in FOLDER/simulations.
    """
    model: Any = build_model("noisy-simulation", scales=[scale], samples=samples, contact=contact)
    name = f"{scale:g}-{samples}" + (f"-contact-{contact:g}" if contact else "")
    path = folder / "simulations" / f"{name}.json"
    known: dict[str, float] = json.loads(path.read_text()) if path.exists() else {}
    path.parent.mkdir(parents=True, exist_ok=True)
    for number, (trial, text) in enumerate(trials.items(), start=1):
        if trial not in known:
            scene = Scene.from_json(text)
            seen = cut_motion(
                Motion(scene, make_engine("physion").simulate(scene, frames=OBSERVED_FRAMES))
            )
            frames = np.array([model.spec.context_frames()])
            batch = Batch((trial,), frames, np.ones(frames.shape, np.bool_), state=(seen,))
            touches = np.asarray(model.imagine(batch, samples, 0, scale=scale).contact)
            known[trial] = float(fraction_of_futures(touches)[0])
        if number % 20 == 0 or number == len(trials):
            write_atomic(path, json.dumps(known).encode())
    return pd.Series(known)[list(trials)]


def predicted(path: Path) -> dict[str, pd.Series]:
    """Return the answers of a table of predictions, by model: *observed*, else what it has.

    P(contact) is by the canonical name of the stimulus.
    """
    table = pd.read_csv(path)
    if "readout" in table and "observed" in set(table["readout"]):
        table = table[table["readout"] == "observed"]
    table = table.assign(stimulus=table["stimulus"].map(canonical_name))
    return {
        str(model): rows.set_index("stimulus")["p_contact"]
        for model, rows in table.groupby("model")
    }


def ended_as_recorded(path: Path) -> pd.Series:
    """Return, by stimulus, whether it ends as recorded with the engine that made the trials."""
    table = pd.read_csv(path).drop_duplicates("stimulus")
    names = table["stimulus"].map(canonical_name)
    return pd.Series((table["outcome"] == table["recorded_outcome"]).to_numpy(), names)


@cache
def kinds(scenario: str) -> Mapping[str, str]:
    """Return the kind of every configuration, by name.

    Configurations that differ in room and scenery only are one kind, which has the name of the
    first of them. Names are official, or of presets that have no official name.
    """
    first: dict[str, str] = {}
    found = {}
    for preset in load_presets(scenario).values():
        given = preset.params
        names = [field.name for field in fields(given) if field.name not in ("room", "scenery")]
        name = (preset.official or preset.name).removesuffix("_2")
        found[name] = first.setdefault(repr([getattr(given, name) for name in names]), name)
    return found


def names_stored(folder: Path) -> list[str]:
    """Return the names of what is stored of the trials in a folder."""
    with np.load(min(folder.glob("*.npz"))) as stored:
        return list(stored.files)


def load(folder: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return what is known of all trials in a folder, and the features of some models, joined.

    Exits if they were made by other versions of the models.
    """
    paths = sorted(folder.glob("*.npz"))
    facts: dict[str, list[NDArray[Any]]] = {name: [] for name in FACTS}
    for path in paths:
        with np.load(path) as stored:
            for name, parts in facts.items():
                parts.append(stored[name])
    out = {name: np.concatenate(parts) for name, parts in facts.items()}
    start = 0
    for path in paths:
        with np.load(path) as stored:
            look = str(stored["look"]) if "look" in stored.files else ""
            if names and not made_alike(stored, Kept(folder, names, look)):
                raise SystemExit(f"{path} was made by other versions of the models; make it again")
            for name in names:
                part = stored[name]
                if name not in out:
                    out[name] = np.empty((len(out["trial"]), *part.shape[1:]), part.dtype)
                out[name][start : start + len(part)] = part
            start += len(stored["trial"])
    return out


def main() -> None:
    """Make what is missing."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trials", type=int, default=0, help="own trials, a scenario")
    parser.add_argument("--scenarios", nargs="*", choices=SCENARIOS, default=list(RIGID))
    parser.add_argument("--official", action="store_true")
    parser.add_argument("--stored", type=Path, help="dataset whose trials are taken, too")
    parser.add_argument("--models", nargs="*", choices=MODELS, default=list(MODELS))
    parser.add_argument(
        "--look", choices=("redyellow", "free"), default="redyellow",
        help="colours; in free ones intuition-pixels has a cue",
    )  # fmt: skip
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=math.inf, help="stop after this time")
    options = parser.parse_args()
    # Scenarios in turn, so that what is there is always of all of them.
    tasks = [(s, part) for part in range(options.trials // EACH) for s in options.scenarios]
    parts = range(-(-len(official_scenes()) // EACH)) if options.official else range(0)
    # Masks tell whether agent and patient are visible in own trials; stored ones were chosen so.
    masks = ("intuition-masks",) if options.trials else ()
    kept = Kept(options.folder, tuple(dict.fromkeys((*options.models, *masks))), options.look)
    count = 0
    if options.stored:
        count = len(opened(options.stored)[0])
    end = time.monotonic() + options.seconds
    with ProcessPoolExecutor(options.workers) as pool:
        made = [pool.submit(make_official, kept, part) for part in parts]
        made += [
            pool.submit(make_stored, options.stored, kept, part)
            for part in range(-(-count // EACH))
        ]
        made += [pool.submit(make_own, kept, task) for task in tasks]
        for future in made:
            if done := future.result():
                print(f"{time.strftime('%H:%M:%S')} {done}", flush=True)
            if time.monotonic() > end:
                pool.shutdown(cancel_futures=True)
                break


if __name__ == "__main__":
    main()
