"""Readouts that ship: fitted once on many sampled trials, and used where they fit a model.

The paper fitted readouts on 1000 trials a scenario, which take hours to make and to look at. For
models whose weights ship, or which pip installs, the package holds the result: for every readout
and scenario a `LinearReadout`, or the `Forest` of a model with the decision *trees*. It belongs to
the digest `Model.readout_digest` of its model and to a number of time steps, and is used where a
dataset has fewer readout trials of its own.
``benchmarks/models/ship_readouts.py`` makes the files, each with a card.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load, save

from physion.core.errors import BadInputError
from physion.core.files import check_digest, file_sha256, write_with_digest
from physion.models.interface import ask
from physion.readout.decisions import Decided, Readout
from physion.readout.features import StoredFeatures
from physion.readout.logistic import JoinedFeatures, LinearReadout
from physion.readout.trees import Forest

FOLDER = "physion.data.readouts"
_HEADER, _ENDING = "physion", ".safetensors"
_LEVELS = 127
"""Weights are stored as whole numbers from -127 to 127."""


@dataclass(frozen=True)
class ShippedReadout:
    """Readout of one scenario that ships.

    - ``fitted``: what turns features (m, steps D) into P(contact).
    - ``steps``: time steps of the features: of the clip, or imagined after the context.
    - ``size``: features D of a step.
    - ``fit_trials``: number of trials it was fitted on. ``fit_on``: name and digest of their set.
    """

    fitted: LinearReadout | Forest
    steps: int
    size: int
    fit_trials: int
    fit_on: str

    def decide(self, parts: Sequence[StoredFeatures]) -> Decided:
        """Return P(contact) of trials from the parts of their features, which are joined in time.

        The last part is brought to the number of steps of the fit: a longer one is cut, and of a
        shorter one the last step is repeated.
        """
        fixed = [*parts[:-1], parts[-1].with_steps(self.steps)]
        fitted = self.fitted
        return Decided(
            fitted.probability(JoinedFeatures(fixed, "test").array()),
            fitted.train_accuracy,
            c=fitted.c if isinstance(fitted, LinearReadout) else float("nan"),
            cv_accuracy=fitted.cv_accuracy,
        )


class ShippedReadouts:
    """Readouts of one model that ship, in a file that `write_readouts` wrote.

    Raises `BadInputError` if the file was changed.
    """

    def __init__(self, path: Path) -> None:
        content = path.read_bytes()
        check_digest(path, content, "install the package again")
        self.sha256 = file_sha256(path)
        self._facts = _header(path)
        self._tensors = load(content)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Return the readouts of which some scenario has one, such as observed."""
        names = {name.split("/")[0] for name in self._facts["readouts"]}
        return tuple(readout.value for readout in Readout if readout.value in names)

    def find(self, readout: Readout, scenario: str) -> ShippedReadout | None:
        """Return the readout of a scenario, None if there is none."""
        name = f"{readout.value}/{scenario}"
        facts = self._facts["readouts"].get(name)
        if facts is None:
            return None
        accuracies = facts["train_accuracy"], facts["cv_accuracy"]
        fitted: LinearReadout | Forest
        if f"{name}/feature" in self._tensors:
            feature = self._tensors[f"{name}/feature"].astype(np.int32)
            fitted = Forest(feature, self._tensors[f"{name}/value"], *accuracies)
        else:
            scale = self._tensors[f"{readout.value}/scale"].astype(np.float64) * facts["scale"]
            flat = (self._tensors[f"{name}/weights"] * (scale / _LEVELS)).reshape(-1)
            zero = np.zeros_like(flat)
            fitted = LinearReadout(flat, zero, facts["intercept"], *accuracies, facts["c"])
        return ShippedReadout(
            fitted, facts["steps"], facts["size"], facts["fit_trials"], self._facts["fit_on"]
        )


def find_readouts(model: Any) -> ShippedReadouts | None:
    """Return the readouts that ship for a model as it is, None if there are none."""
    path = _by_digest().get(str(ask(model, "readout_digest")()))
    return None if path is None else _opened(path)


def shipped_files() -> list[Path]:
    """Return the files of all readouts that ship."""
    with as_file(files(FOLDER)) as folder:
        return sorted(folder.glob(f"*{_ENDING}"))


@lru_cache(maxsize=1)
def _by_digest() -> dict[str, Path]:
    """Return the files by digest of their model."""
    return {_header(path)["digest"]: path for path in shipped_files()}


@lru_cache(maxsize=2)
def _opened(path: Path) -> ShippedReadouts:
    return ShippedReadouts(path)


def _header(path: Path) -> dict[str, Any]:
    """Return the facts of a file, of which only the header is read."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "numpy") as file:
            facts: dict[str, Any] = json.loads(file.metadata()[_HEADER])
            return facts
    except (OSError, SafetensorError, ValueError, KeyError, TypeError) as error:
        raise BadInputError(
            f"readouts {path} cannot be read ({error}); install the package again"
        ) from None


def write_readouts(
    path: Path,
    digest: str,
    fit_on: str,
    fitted: Mapping[tuple[Readout, str], ShippedReadout],
) -> None:
    """Write the readouts of a model, and the digest of the file.

    Weights w (T, D) of scenario s become whole numbers q with w = q a_s b_d / 127. With weights in
    the unit of their scenario's root mean square a_s, b_d is the largest of feature d in all steps
    and scenarios. Raises `BadInputError` for trees on more features than a file can hold.

    Parameters
    ----------
    path
        File, in the folder of the package.
    digest
        `Model.readout_digest` of the model.
    fit_on
        Name and digest of the set that they were fitted on.
    fitted
        By readout and scenario.
    """
    tensors: dict[str, NDArray[Any]] = {}
    facts: dict[str, dict[str, Any]] = {}
    for (readout, scenario), one in fitted.items():
        name, of_fit = f"{readout.value}/{scenario}", one.fitted
        facts[name] = {
            "steps": one.steps,
            "size": one.size,
            "fit_trials": one.fit_trials,
            "train_accuracy": of_fit.train_accuracy,
            "cv_accuracy": of_fit.cv_accuracy,
        }
        if isinstance(of_fit, Forest):
            feature = of_fit.feature.astype(np.int16)
            if (feature != of_fit.feature).any():
                raise BadInputError(
                    f"trees of {name} compare feature {of_fit.feature.max()}; a file holds "
                    f"features up to {np.iinfo(np.int16).max}"
                )
            tensors |= {f"{name}/feature": feature, f"{name}/value": of_fit.value}
            continue
        rows = of_fit.weights.reshape(-1, one.size)
        unit = float(np.sqrt(np.mean(rows**2))) or 1.0
        facts[name] |= {"c": of_fit.c, "scale": unit}
        scale = f"{readout.value}/scale"
        largest = np.abs(rows / unit).max(axis=0).astype(np.float32)
        tensors[scale] = np.maximum(tensors.get(scale, 0), largest)
    for (readout, scenario), one in fitted.items():
        name, of_fit = f"{readout.value}/{scenario}", one.fitted
        if isinstance(of_fit, Forest):
            continue
        step = tensors[f"{readout.value}/scale"].astype(np.float64) * facts[name]["scale"] / _LEVELS
        rows = of_fit.weights.reshape(-1, one.size)
        whole = np.rint(np.divide(rows, step, out=np.zeros_like(rows), where=step > 0))
        tensors[f"{name}/weights"] = whole.astype(np.int8)
        # So that a trial with mean features keeps its decision value.
        shift = float(of_fit.mean @ (whole * step).reshape(-1))
        facts[name]["intercept"] = of_fit.intercept - shift
    header = json.dumps({"digest": digest, "fit_on": fit_on, "readouts": facts}, sort_keys=True)
    write_with_digest(path, save(tensors, {_HEADER: header}))
