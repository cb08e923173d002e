"""Models that cheat, one way each: they look up what happens in place of seeing it.

A batch has names and pictures, no path. The cheaters therefore find the dataset that is evaluated
on the stack, as a model could do. `Honest` sees the observed pictures only.
"""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from physion.clips.batch import Batch, Provenance, Rollout, Spec
from physion.trials.dataset import Dataset
from physion.trials.trial_file import Trial
from physion.trials.video import open_movie, read_frames


def evaluated_dataset() -> Dataset:
    """The dataset of the predictor that called."""
    for frame in inspect.stack():
        found = getattr(frame.frame.f_locals.get("self"), "dataset", None)
        if isinstance(found, Dataset):
            return found
    raise LookupError("nobody evaluates")


def fraction(*parts: object) -> float:
    """A number in 0..1 that every other ``parts`` change."""
    sha = hashlib.sha256(repr(parts).encode()).digest()
    return int.from_bytes(sha[:6], "big") / 2**48


class Honest:
    """Model whose P(contact) is the mean brightness of what was observed."""

    spec = Spec(image_size=16, future=0)
    answers = "observed"

    def provenance(self) -> Provenance:
        return Provenance(type(self).__name__, "none")

    def digest(self) -> str:
        return hashlib.sha256(type(self).__name__.encode()).hexdigest()

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        return np.asarray(batch.rgb.mean(axis=(1, 2, 3, 4)) / 255)


Tells = Callable[[Dataset, str], float]


class Cheater(Honest):
    """Model that says what ``tells`` finds in the evaluated dataset for a name."""

    def __init__(self, tells: Tells) -> None:
        self.tells = tells

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        dataset = evaluated_dataset()
        return np.array([float(self.tells(dataset, trial)) for trial in batch.trials])


def row(dataset: Dataset, trial: str) -> Any:
    return dataset.index.set_index("trial").loc[trial]


def opened(dataset: Dataset, trial: str) -> Trial:
    return Trial.open(dataset.paths(trial).trial_file)


def number_in_the_name(_: Dataset, trial: str) -> float:
    return int(trial[-1], 16) % 2 == 0


def hash_of_the_name(_: Dataset, trial: str) -> float:
    return fraction(trial)


def time_of_the_file(dataset: Dataset, trial: str) -> float:
    return int(dataset.paths(trial).observed_movie.stat().st_mtime) % 2 == 0


def size_of_the_movie(dataset: Dataset, trial: str) -> float:
    return fraction(dataset.paths(trial).movie.stat().st_size)


def size_of_the_observed_movie(dataset: Dataset, trial: str) -> float:
    return fraction(dataset.paths(trial).observed_movie.stat().st_size)


def length_of_the_movie(dataset: Dataset, trial: str) -> float:
    with open_movie(dataset.paths(trial).movie) as movie:
        return 1 / movie.frames


def length_in_the_index(dataset: Dataset, trial: str) -> float:
    return 1 / float(row(dataset, trial)["frames"])


def last_picture(dataset: Dataset, trial: str) -> float:
    return float(read_frames(dataset.paths(trial).movie)[-1].mean() / 255)


def last_observed_picture(dataset: Dataset, trial: str) -> float:
    return float(read_frames(dataset.paths(trial).observed_movie)[-1].mean() / 255)


def first_picture_after(dataset: Dataset, trial: str) -> float:
    return float(read_frames(dataset.paths(trial).movie, start=45, count=1).mean() / 255)


def label_in_the_index(dataset: Dataset, trial: str) -> float:
    return bool(row(dataset, trial)["contact"])


def first_frame_in_the_index(dataset: Dataset, trial: str) -> float:
    return bool(row(dataset, trial).isna()["first_frame"])


def mean_of_the_labels(dataset: Dataset, _: str) -> float:
    index = dataset.index
    return float(index["contact"][index["split"] == "testing"].mean())


def row_of_the_index(dataset: Dataset, trial: str) -> float:
    return dataset.trials().index(trial) % 2


def number_in_the_index(dataset: Dataset, trial: str) -> float:
    return int(row(dataset, trial)["index"]) % 2 == 0


def in_the_index(column: str) -> Tells:
    return lambda dataset, trial: fraction(str(row(dataset, trial)[column]))


def digest_in_the_index(dataset: Dataset, trial: str) -> float:
    return fraction(row(dataset, trial)["digest"])


def label_in_the_file(dataset: Dataset, trial: str) -> float:
    return opened(dataset, trial).known_labels().contact


def motion_in_the_file(dataset: Dataset, trial: str) -> float:
    height = opened(dataset, trial).trajectory.positions[-1, 0, 2]
    return float(np.clip(height, 0, 1))


def contacts_in_the_file(dataset: Dataset, trial: str) -> float:
    return bool((opened(dataset, trial).trajectory.contacts.frame >= 45).any())


def seed_in_the_file(dataset: Dataset, trial: str) -> float:
    return fraction(opened(dataset, trial).metadata.seed)


def scene_name_in_the_file(dataset: Dataset, trial: str) -> float:
    return fraction(opened(dataset, trial).scene.name)


def attribute_in_the_file(dataset: Dataset, trial: str) -> float:
    with h5py.File(dataset.paths(trial).trial_file) as file:
        return float(file.attrs.get("note", 0.5))


def ids_in_the_file(dataset: Dataset, trial: str) -> float:
    return float(opened(dataset, trial).ids[0, 0])


def map_of_agent_and_patient(dataset: Dataset, trial: str) -> float:
    return float(np.asarray(Image.open(dataset.paths(trial).map))[-1, -1, 3] > 0)


def title_of_the_movie(dataset: Dataset, trial: str) -> float:
    return b"contact" in dataset.paths(trial).observed_movie.read_bytes()


def file_beside(dataset: Dataset, trial: str) -> float:
    path = dataset.paths(trial).trial_file.with_suffix(".txt")
    return float(path.read_text()) if path.is_file() else 0.5


def table_of_labels(dataset: Dataset, trial: str) -> float:
    known = json.loads((dataset.folder / "labels.json").read_text())
    return float(known.get(trial, 0.5))


def table_in_a_folder(dataset: Dataset, trial: str) -> float:
    path = dataset.folder / "more/tables/labels.json"
    return float(json.loads(path.read_text()).get(trial, 0.5)) if path.is_file() else 0.5


class MemoryOfNames(Cheater):
    """Model that reads the last picture once, and remembers its answer by the name."""

    def __init__(self) -> None:
        super().__init__(self._known)
        self._memory: dict[str, float] = {}

    def _known(self, dataset: Dataset, trial: str) -> float:
        if trial not in self._memory:
            self._memory[trial] = last_picture(dataset, trial)
        return self._memory[trial]


class CacheOnDisk(Cheater):
    """Model that finds its answers, which an earlier run wrote, in a file."""

    def __init__(self, path: Path, answers: dict[str, float]) -> None:
        super().__init__(lambda _, trial: json.loads(path.read_text()).get(trial, 0.5))
        path.write_text(json.dumps(answers))


class PlaceInBatch(Honest):
    """Model that knows that trials with and without contact take turns."""

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        return np.asarray(np.arange(len(batch)) % 2 * 0.8 + 0.1)


class CallCounter(Honest):
    """Model that counts the trials that it has seen."""

    seen = 0

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        self.seen += len(batch)
        return np.array([fraction(self.seen - k) for k in range(len(batch))])


class OthersInTheBatch(Honest):
    """Model that subtracts the mean of the batch, so that a prediction depends on other trials."""

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        own = super().predict(batch)
        return np.asarray(np.clip(0.5 + 10 * (own - own[: len(own) // 2].mean()), 0, 1))


class FitOnTested(Honest):
    """Model that is fitted on the tested trials in place of the ones that it is given."""

    def fit(self, batch: Batch, labels: NDArray[np.bool_], seed: int) -> FitOnTested:
        index = evaluated_dataset().index
        tested = index[index["split"] == "testing"]
        fitted = FitOnTested()
        fitted.known = dict(zip(tested["trial"], tested["contact"], strict=True))
        return fitted

    known: dict[str, bool]

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        return np.array([0.1 + 0.8 * self.known.get(trial, False) for trial in batch.trials])


class Imagining(Honest):
    """Simulator whose random numbers follow from the names, as they should."""

    samples, decision = 8, "noise"

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        touches = [[fraction(t, seed, k) < 0.5 for k in range(samples)] for t in context.trials]
        return Rollout(contact=np.array(touches))

    predict = None  # type: ignore[assignment]


class ImaginesTheName(Imagining):
    """Simulator that takes the number in the name for the outcome."""

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        touches = [[int(trial[-1], 16) % 2 == 0] * samples for trial in context.trials]
        return Rollout(contact=np.array(touches))
