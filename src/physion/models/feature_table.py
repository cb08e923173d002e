"""Features that were computed elsewhere, as a model: for networks that cannot run here.

A table is an ``.npz`` or HDF5 file with these arrays:

- ``names`` (n): names of trials, in any order.
- ``frames`` (T) or (n, T): for each time step the last frame of the movie that it depends on, from
  0 on; of each trial where movies were cut at different frames.
- ``features`` (n, T, D): floating-point numbers.
- ``model``: name of the row; optional, by default, or if blank, the file's name.
- ``readout``: ``observed`` or ``full``; optional, by default ``observed``, which excludes all
  frames after 44. Features of whole movies are ``full``.
- ``benchmark``: ``v1`` or ``v1.5``, the rules by which movies were cut; optional, by default v1.

``train_features.hdf5`` and ``test_features.hdf5`` of neuroailab/physion_evaluator are read too,
each together with the other one if it is there. They do not say which frames were seen. By its
rules (``dataloader_mp4s.py``) the last one is frame 45, one after the observed part, and in the
folder ``ocd`` a frame after the contact, so that these features are ``full``.

Nothing in a file is executed: pickled arrays are refused.
"""

from __future__ import annotations

import contextlib
import copy
import math
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import LAST_OBSERVED, Batch, Provenance, Spec
from physion.core.errors import BadInputError
from physion.core.files import digest_of, file_sha256
from physion.core.names import NAMES, evaluator_name
from physion.models.interface import Model

EVALUATOR = ("train_features.hdf5", "test_features.hdf5")
_NEEDED = ("names", "frames", "features")
_OBSERVED, _FULL = "observed", "full"
_VERSION = 1
"""To be raised with every change that alters features."""


class FeatureTable(Model):
    """Model whose features of a trial are found by its name.

    Parameters
    ----------
    path
        File of the table.

    Raises
    ------
    BadInputError
        If there is no such file, an array is missing or does not fit the others, a name occurs
        twice, a frame comes after the observed part, or a feature is not finite.
    """

    decision = "logistic"

    def __init__(self, path: Path | str) -> None:
        self.path, self._of_evaluator = Path(path), Path(path).name in EVALUATOR
        paths = [self.path]
        if self._of_evaluator:
            pair = [self.path.with_name(name) for name in EVALUATOR]
            paths = [one for one in pair if one == self.path or one.is_file()]
        tables = [self._read(one) for one in paths]
        names = [self._key(str(name)) for table in tables for name in table["names"]]
        self.rows = {name: row for row, name in enumerate(names)}
        if len(self.rows) < len(names):
            twice = next(name for row, name in enumerate(names) if self.rows[name] != row)
            raise self._error(f"the name {twice!r} occurs twice")
        shape = tables[0]["features"].shape[1:]
        if any(table["features"].shape[1:] != shape for table in tables):
            raise self._error(f"{' and '.join(EVALUATOR)} have features of different shapes")
        self.features = np.concatenate([table["features"] for table in tables])
        frames = np.concatenate([table["frames"] for table in tables])
        readout = str(tables[0].get("readout", _OBSERVED))
        if readout not in (_OBSERVED, _FULL):
            raise self._error(f"readout must be {_OBSERVED} or {_FULL}, not {readout!r}")
        if self._of_evaluator and self.path.absolute().parent.name == "ocd":
            readout = _FULL
        self._check_frames(frames, readout, names)
        unfit = np.argwhere(~np.isfinite(self.features))
        if len(unfit):
            row, step = unfit[0][:2]
            raise self._error(
                f"the features of trial {names[row]!r}, time step {step}, are not finite numbers"
            )
        self.answers = _FULL if readout == _FULL else ""
        self.benchmark = "v1.5" if self._of_evaluator else str(tables[0].get("benchmark", "v1"))
        if self.benchmark not in ("v1", "v1.5"):
            raise self._error(f"benchmark must be v1 or v1.5, not {self.benchmark!r}")
        self.spec = Spec(
            inputs=(),
            stride=1,
            context=LAST_OBSERVED + 1,
            future=None if readout == _FULL else 0,
            framewise=False,
        )
        folder = self.path.absolute().parent
        named = folder.parent if folder.name in ("ocp", "ocd") else folder
        self._model = named.name if self._of_evaluator else self.path.stem
        self._model = tables[0].get("model", "").strip() or self._model
        if not self._model.isprintable():
            raise self._error(f"model must be a name of printable characters, not {self._model!r}")
        self.frames = "" if self._of_evaluator else f"up to {frames.max()}"
        """Frames that the features depend on, as the file says."""
        self._last = frames[:, -1]
        self._sha256 = digest_of(" ".join(file_sha256(one) for one in paths))

    def _read(self, path: Path) -> dict[str, Any]:
        """Return the arrays of a file, checked against each other."""
        if not path.is_file():
            raise BadInputError(f"there is no file of features {str(path)!r}")
        with self._opened(path) as file:
            if self._of_evaluator and "filenames" in file and "features" in file:
                names = [Path(_text(name)).name for name in file["filenames"][()]]
                values = np.asarray(file["features"][()])
                values = values.reshape(len(values), 1, -1) if len(values) else values
                table: dict[str, Any] = {"names": names, "frames": np.zeros(1, np.int64)}
            else:
                missing = [name for name in _NEEDED if name not in file]
                if missing:
                    raise self._error(f"no array {missing[0]!r}; needed: {', '.join(_NEEDED)}")
                named = np.asarray(file["names"][()])
                if named.ndim != 1:
                    raise self._error(f"names have the shape {named.shape}, expected one row")
                table = {"names": [_text(name) for name in named]}
                table["frames"], values = (np.asarray(file[name][()]) for name in _NEEDED[1:])
                texts = ("model", "readout", "benchmark")
                table |= {name: _text(file[name][()]) for name in texts if name in file}
        rows, frames = len(table["names"]), table["frames"]
        whole = frames.dtype.kind in "iu" and frames.ndim in (1, 2)
        if not whole or (frames.ndim == 2 and len(frames) != rows):
            raise self._error(
                "frames must be integers, one for each time step, or a row of them for each trial"
            )
        steps = frames.shape[-1]
        table["frames"] = np.broadcast_to(frames, (rows, steps))
        if values.ndim != 3 or values.shape[:2] != (rows, steps) or not values.size:
            raise self._error(
                f"features are {values.shape} for {rows} names and {steps} frames, expected "
                f"({rows}, {steps}, features of a time step)"
            )
        if values.dtype.kind != "f":
            raise self._error(f"features are {values.dtype}, expected floating-point numbers")
        with np.errstate(over="ignore"):
            table["features"] = values.astype(np.float32)
        return table

    @contextlib.contextmanager
    def _opened(self, path: Path) -> Iterator[Any]:
        """Open a file whose arrays are read by name."""
        try:
            if path.suffix.lower() == ".npz":
                if not zipfile.is_zipfile(path):  # numpy would speak of pickled data
                    raise ValueError(
                        "it is not an npz file, or is damaged; write it with numpy.savez"
                    )
                with np.load(path, allow_pickle=False) as arrays:
                    yield arrays
            else:
                with h5py.File(path, "r") as file:
                    yield file
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            what = " ".join(str(error).split())
            if "pickle" in what:
                what = "pickled objects are refused; save names as an array of text (dtype str)"
            raise BadInputError(f"features {path} cannot be read: {what}") from error

    def _check_frames(self, frames: NDArray[Any], readout: str, names: Sequence[str]) -> None:
        """Check frames (n, T) of the trials ``names``."""
        if (frames < 0).any() or (np.diff(frames.astype(np.int64)) < 0).any():
            raise self._error("frames must be 0 or more and must not decrease")
        if readout == _FULL:
            return
        self._check_last(dict(zip(names, frames[:, -1].tolist(), strict=True)), {})
        if frames.shape[1] > LAST_OBSERVED + 1:
            raise self._error(
                f"{frames.shape[1]} time steps are more than the {LAST_OBSERVED + 1} observed "
                "frames; put tokens of one time into one row of features"
            )

    def _check_last(self, frames: Mapping[str, int], allowed: Mapping[str, int]) -> None:
        """Raise `BadInputError` for a last frame of a trial that is later than the allowed one."""
        for name, frame in frames.items():
            last = allowed.get(name, LAST_OBSERVED)
            if frame <= last:
                continue
            of_all = last == LAST_OBSERVED
            where = "" if of_all else f" of {name!r}"
            instead = f"add readout={_FULL!r} to the file"
            if not of_all:
                instead = "let the file have a row of frames for each trial"
            raise self._error(
                f"frame {frame} comes after the observed part{where}, whose last frame is {last}; "
                f"leave it out, or {instead}"
            )

    def _key(self, name: str) -> str:
        """Return the name of a trial under which its features are found."""
        if not self._of_evaluator:
            return name
        scenario = next((known for known in NAMES if name.startswith(f"{known}_")), "")
        return evaluator_name(name, scenario)

    def _error(self, what: str) -> BadInputError:
        return BadInputError(f"features {self.path}: {what}")

    def check_trials(self, needed: Collection[str], known: Collection[str]) -> None:
        """Raise `BadInputError` for trials without features, and for features of no trial.

        A mapping ``needed`` says the last frame of each trial that may be seen; a later one is
        refused too.
        """
        missing = sorted(trial for trial in needed if self._key(trial) not in self.rows)
        if missing:
            raise self._error(
                f"{len(missing)} of {len(needed)} trials that are tested or fit the readout are "
                f"missing, such as {missing[0]!r}; encode them too"
            )
        unknown = sorted(set(self.rows) - {self._key(trial) for trial in known})
        if unknown:
            raise self._error(
                f"{len(unknown)} of {len(self.rows)} names are unknown to the dataset, such as "
                f"{unknown[0]!r}; leave them out, or choose the dataset that was encoded"
            )
        if isinstance(needed, Mapping) and self.frames and not self.answers:
            last = {trial: int(self._last[self.rows[trial]]) for trial in needed}
            self._check_last(last, needed)

    def of_trials(self, trials: Collection[str]) -> FeatureTable:
        """Return the table of these trials only, as far as it has them."""
        part, wanted = copy.copy(self), {self._key(trial) for trial in trials}
        part.rows = {name: row for name, row in self.rows.items() if name in wanted}
        return part

    def random_twin(self, rng: np.random.Generator) -> FeatureTable:
        """Return a table of the same trials with random numbers in place of all features."""
        twin = copy.copy(self)
        twin.features = rng.normal(size=self.features.shape).astype(np.float32)
        twin._sha256 = digest_of(twin.features.tobytes())
        return twin

    def telling(self, outcomes: Mapping[str, bool]) -> tuple[str, float]:
        """Return a number of the features that tells all outcomes of trials, and the chance of it.

        Parameters
        ----------
        outcomes
            Outcomes by trial.

        Returns
        -------
        place, chance
            ``time step T, feature D`` of a number that is larger in all trials of one outcome than
            in all of the other, or an empty text; and how many of the numbers would be so if none
            had to do with the outcome.
        """
        values = self.features[[self.rows[self._key(trial)] for trial in outcomes]]
        contact = np.array(list(outcomes.values()), np.bool_)
        yes, no = values[contact], values[~contact]
        if not (len(yes) and len(no)):
            return "", float("inf")
        chance = 2 * values[0].size / math.comb(len(values), len(yes))
        apart = (yes.min(0) > no.max(0)) | (yes.max(0) < no.min(0))
        places = np.argwhere(apart)
        place = "time step {}, feature {}".format(*places[0]) if len(places) else ""
        return place, chance

    def encode(self, batch: Batch) -> NDArray[np.float32]:
        """Return the features (B, T, D) of the trials of a batch."""
        self.check_trials(batch.trials, self.rows)
        return self.features[[self.rows[self._key(trial)] for trial in batch.trials]]

    def provenance(self) -> Provenance:
        """Return the name of the row, and the hash of the file in place of the weights'."""
        of = self.frames.replace("up to", "up to frame") or "of unstated frames"
        return Provenance(self._model, f"local:{self._sha256[:12]}", inputs=f"features {of}")

    def digest(self) -> str:
        """Return the SHA-256 of the content of the files."""
        return digest_of(f"features {_VERSION} {self._sha256} {self.answers}")


def _text(value: Any) -> str:
    """Return a name of a file as text, which HDF5 holds as bytes."""
    value = value.item() if isinstance(value, np.ndarray | np.generic) else value
    return value.decode() if isinstance(value, bytes) else str(value)
