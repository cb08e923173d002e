"""Is the impossible movie of a pair the one that surprises a model more?

The surprise of a frame, given those before it, is

- what ``surprise(batch)`` of the model returns;
- of a model that encodes and imagines: with the features e(t) of a frame, and those i(t) that it
  imagines one step after its context, the mean of (e(t) - i(t))^2 over the features; the smallest
  over its futures;
- of another network: its loss in the window of training that ends with the frame.

The surprise of a movie is the mean, or the largest, over its frames. A pair is a possible and an
impossible movie that begin alike (`physion.trials.making.pairs`), and the answer is right if the
impossible one surprises more; equal surprises count half. Standard errors are of means over trials
that the movies were made of: pairs of one are not independent.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.clips.batch import Batch
from physion.clips.clips import whole_source
from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError
from physion.core.files import folder_for_writing, is_whole, json_digest
from physion.core.version import __version__
from physion.models.interface import Model, ask, can
from physion.readout.model_calls import (
    call_model,
    check_finite,
    check_identity,
    encoded,
    imagined,
    is_network,
    model_name,
    to_array,
    use_device,
)
from physion.readout.settings import (
    Cell,
    EvaluationSettings,
    Models,
    choose_models,
    plan_cells,
    run_cells,
)
from physion.readout.tables import write_table
from physion.readout.whatif import mean_over_trials
from physion.trials.dataset import Dataset
from physion.trials.making.pairs import Pair, is_pair
from physion.trials.making.whatif import MARK

F64 = NDArray[np.float64]
COLUMNS = (
    "model", "init", "scenario", "stimulus", "base", "kind", "hidden", "first", "possible", "mean",
    "largest",
)  # fmt: skip
"""``first``: the world that the movie begins in; the possible and the impossible movie of ``base``,
``kind`` and ``first`` are a pair."""
MEASURES = ("mean", "largest")
ALL, PIXELS = "all", "pixel-statistics"
_VERSION = 2
"""To be increased with every change that can alter a surprise."""
_HASHED_COLUMNS = ["digest", "look", "trial_file_sha256", "movie_sha256"]
"""Columns of the index that a surprise depends on."""
STEP = 6
"""Frames of a step, where a model asks for every frame: in one nothing has moved far."""
_TREES = 100


@dataclass(frozen=True)
class Surprises:
    """What `surprise` did.

    - ``table``: `COLUMNS`, one row for each model and movie.
    - ``failed``: reasons of the models that failed, by name.
    - ``pixels``: a table of the same kind of `pixel_statistics`; None if not asked for.
    """

    table: pd.DataFrame
    failed: Mapping[str, str]
    pixels: pd.DataFrame | None = None

    @property
    def scores(self) -> pd.DataFrame:
        """How often the impossible movie of a pair surprises more (`surprise_scores`)."""
        return surprise_scores([self.table] if self.pixels is None else [self.pixels, self.table])


def surprise(
    models: Models,
    dataset: Dataset | Path | str,
    out: Path | str = "runs/models",
    settings: EvaluationSettings | None = None,
    *,
    options: Mapping[str, Any] | None = None,
    pixels: bool = False,
    progress: Progress | None = None,
    **changes: Any,
) -> Surprises:
    """Return how much each movie of the pairs of a dataset surprises models.

    Parameters
    ----------
    models, options
        Models, as `physion.evaluate` takes them. They are not trained: those without weights that
        ship are random, unless the option ``weights`` names some.
    dataset
        Dataset with pairs (``physion generate --pairs``), or its folder.
    out
        Folder of the tables, ``surprise/MODEL-DIGEST.csv``. What is there is not computed again.
    settings
        Of these ``seed``, ``rendered`` and ``accelerator`` count.
    pixels
        Whether also the table of `pixel_statistics` is made.
    progress
        Called after every trial.
    **changes
        Fields of `EvaluationSettings` to replace in ``settings``.

    Returns
    -------
    Surprises
        A table of models and movies, and what failed; one model that fails does not stop the
        others.

    Raises
    ------
    BadInputError
        If the dataset has no pairs, a model has none of the methods that are needed, or the only
        model fails.
    """
    settings = dataclasses.replace(settings or EvaluationSettings(), **changes)
    trials = dataset if isinstance(dataset, Dataset) else Dataset(dataset)
    pairs = _pairs(trials)
    # Every model is built before anything is computed, so that mistakes are found at once.
    once = dataclasses.replace(settings, seeds=1, protocols=("all",))
    cells = plan_cells(choose_models(models, options), once, lambda model: False)
    for cell in cells:
        _way_of(cell.built)
    folder = Path(out) / "surprise"

    def run(cell: Cell) -> pd.DataFrame:
        return _of_model(cell.take_model(), trials, pairs, folder, settings, progress)

    tables, failed = run_cells(cells, run, Path(out), "models", None, None)
    known = pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=list(COLUMNS))
    reasons = {label.rpartition(",")[0]: why for label, why in failed.items()}
    single = None
    if pixels:
        single = pixel_statistics(trials, out, rendered=settings.rendered, progress=progress)
    return Surprises(known, reasons, single)


def _pairs(dataset: Dataset) -> dict[str, Pair]:
    """Return what each movie of a pair says of itself, by its name."""
    found = {name: Pair.of(dataset.trial(name).scene) for name in dataset.trials() if is_pair(name)}
    if not found:
        raise BadInputError(
            f"{dataset.folder} has no pairs of a possible and an impossible movie; make some with "
            "physion generate --pairs"
        )
    pairs = {name: pair for name, pair in found.items() if pair is not None}
    if silent := sorted(found.keys() - pairs.keys()):
        raise BadInputError(
            f"trial {silent[0]!r} of {dataset.folder} does not say which pair it is of"
        )
    return pairs


def _of_model(
    model: Model,
    dataset: Dataset,
    pairs: Mapping[str, Pair],
    folder: Path,
    settings: EvaluationSettings,
    progress: Progress | None,
) -> pd.DataFrame:
    """Return the surprises of one model, which are kept in ``folder``."""
    origin = check_identity(model)
    # A digest leaves out some settings, such as the number of samples.
    own = repr(ask(model, "settings"))
    inputs = [model.digest(), own, settings.seed, *_facts(dataset, pairs, settings.rendered)]
    path = folder / f"{origin.model}-{json_digest(inputs)[:16]}.csv"
    if is_whole(path):
        return _read(path)
    use_device(model, settings.accelerator)
    scenarios = dataset.index.set_index("trial")["scenario"]
    of_clips = _way_of(model)
    spec = model.spec
    if spec.stride == 1:
        spec = dataclasses.replace(spec, stride=STEP, context=1)
    source = whole_source(dataset, spec, rendered=settings.rendered)
    rows = []
    for name in tracked(list(pairs), f"surprise of {origin.model}", len(pairs), progress):
        start = spec.first % spec.stride
        steps = (source.length(name) - 1 - start) // spec.stride + 1
        clip = source.window([name], [start], steps)
        values = of_clips(clip, settings.seed)
        check_finite(values, model, "surprises", (name,))
        pair = pairs[name]
        rows.append(
            _row(
                origin.model, origin.init, scenarios[name], name, pair, values.mean(), values.max()
            )
        )
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    return _keep(path, table)


def _facts(dataset: Dataset, names: Iterable[str], rendered: bool) -> list[Any]:
    """Return what a surprise depends on, apart from the model."""
    files = dataset.index.set_index("trial")[_HASHED_COLUMNS]
    of_files = [[name, *map(str, files.loc[name])] for name in sorted(names)]
    return [_VERSION, __version__, rendered, *of_files]


def _read(path: Path) -> pd.DataFrame:
    return pd.read_csv(path, dtype={"init": str}, keep_default_na=False)


def _keep(path: Path, table: pd.DataFrame) -> pd.DataFrame:
    with folder_for_writing(path.parent):
        write_table(table, path)
    return table


def _row(
    model: str, init: str, scenario: str, name: str, pair: Pair, mean: float, largest: float
) -> tuple[Any, ...]:
    """Return the values of `COLUMNS`."""
    of_pair = (pair.base, pair.kind, pair.hidden, pair.first, pair.possible)
    return (model, init, scenario, name, *of_pair, float(mean), float(largest))


# The surprise of each frame, (1, T), of a clip of one trial.


def _way_of(model: Model) -> Callable[[Batch, int], F64]:
    """Return the function of a clip and a seed that gives its surprise."""
    if can(model, "surprise"):
        return lambda clip, seed: _own(model, clip)
    if can(model, "encode") and can(model, "imagine"):
        return lambda clip, seed: _imagined_error(model, clip, seed)
    if can(model, "loss") and is_network(model) and ask(model, "learns_from") == "clips":
        return lambda clip, seed: _losses(model, clip)
    raise BadInputError(
        f"model {model_name(model)!r} has no surprise: it needs the method surprise, or encode and "
        "imagine, or a loss on clips"
    )


def _own(model: Model, clip: Batch) -> F64:
    values = call_model(model, "surprise", clip)
    shape: tuple[int | None, ...] = (len(clip), clip.frames.shape[1])
    kinds = ("float64", "float32")
    return np.asarray(to_array(values, model, "surprise gave values", shape, kinds), np.float64)


def _imagined_error(model: Model, clip: Batch, seed: int) -> F64:
    """Return the mean square by which imagined features miss the features of each frame."""
    steps, context = clip.frames.shape[1], model.spec.context
    windows = [_before(step, context) for step in range(steps)]
    if model.spec.framewise:
        whole = encoded(model, clip)
        before = np.concatenate([whole[:, window] for window in windows])
        true = whole[0]
    else:
        # Of frames together: of those up to each one, the last one's.
        before = np.concatenate([encoded(model, _part(clip, window)) for window in windows])
        own = [encoded(model, _part(clip, _before(step + 1, context))) for step in range(steps)]
        true = np.concatenate(own)[:, -1]
    parts = [_part(clip, window) for window in windows]
    # Random futures are drawn by name, and movies of a pair have the same ones.
    named = tuple(trial.partition(MARK)[0] for trial in clip.trials)
    seeds = ask(model, "seed")
    samples, errors = ask(model, "samples"), np.zeros(steps)
    for step in range(1, steps):
        asked = dataclasses.replace(
            parts[step], trials=named, features=before[step : step + 1], future=1
        )
        rollout = imagined(model, asked, samples, seed if seeds is None else seeds)
        if rollout.features is None:
            raise BadInputError(f"model {model_name(model)!r}: imagine gave no features")
        shape = (1, samples, 1, true.shape[-1])
        future = to_array(rollout.features, model, "imagine gave features", shape, ("float32",))
        squares = (future[0, :, 0].astype(np.float64) - true[step]) ** 2
        errors[step] = squares.mean(axis=-1).min()
    return errors[None]


def _before(step: int, count: int) -> list[int]:
    """Return the ``count`` steps before one; the first is repeated in front where there are less.

    Nothing comes before step 0, which stands for itself.
    """
    return [max(index, 0) for index in range(step - count, step)]


def _part(clip: Batch, steps: Sequence[int]) -> Batch:
    return clip.steps(np.asarray(steps, np.int64))


def _losses(model: Model, clip: Batch) -> F64:
    """Return the loss of the window of training that ends with each frame; 0 before the first."""
    steps = clip.frames.shape[1]
    length = min(ask(model, "window") or 2 * model.spec.context, steps)
    losses = np.zeros(steps)
    for step in range(length - 1, steps):
        parts = call_model(model, "loss", _part(clip, range(step - length + 1, step + 1)))
        losses[step] = float(parts["loss"])
    return losses[None]


# Scores of pairs.


def surprise_scores(surprises: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return the fraction of pairs whose impossible movie surprises a model more.

    Parameters
    ----------
    surprises
        Tables of `surprise` or `pixel_statistics`.

    Returns
    -------
    scores
        ``model``, ``init``, ``kind`` (and all together), ``hidden`` (``yes``, ``no``, or ``all``),
        ``pairs``, and for each of `MEASURES` the fraction and ``MEASURE_se``, NaN with less than
        two trials.
    """
    keys = ["model", "init", "base", "kind", "hidden", "first"]
    table = pd.concat([one for one in surprises if len(one)], ignore_index=True)
    sides = [table[table["possible"].astype(bool) == side] for side in (True, False)]
    joined = sides[0].merge(sides[1], on=keys, suffixes=("", "_impossible"), validate="one_to_one")
    for measure in MEASURES:
        more = joined[f"{measure}_impossible"] - joined[measure]
        joined[measure] = (1 + np.sign(more)) / 2
    rows = []
    for (model, init), own in joined.groupby(["model", "init"], sort=False):
        for kind, part in [(ALL, own), *own.groupby("kind")]:
            seen = part["hidden"].astype(bool)
            for hidden, some in ((ALL, part), ("no", part[~seen]), ("yes", part[seen])):
                if some.empty:
                    continue
                row = {"model": model, "init": init, "kind": kind, "hidden": hidden}
                row["pairs"] = len(some)
                for measure in MEASURES:
                    row[measure], row[f"{measure}_se"] = mean_over_trials(some, measure)
                rows.append(row)
    columns = ["model", "init", "kind", "hidden", "pairs"]
    columns += [f"{measure}{end}" for measure in MEASURES for end in ("", "_se")]
    return pd.DataFrame(rows, columns=columns)


def pixel_statistics(
    dataset: Dataset | Path | str,
    out: Path | str = "runs/models",
    *,
    rendered: bool = False,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Return a table as `surprise` does, of what single pictures tell: a check of the pairs.

    Of each movie it knows mean and standard deviation of red, green and blue, in the whole and in
    each of nine parts of the picture, each averaged over the first, second and last third of the
    movie. Extremely randomised trees learn from all other trials which movies
    are impossible; their P(impossible) stands for the surprise. If movies are well paired, nothing
    of this tells, and half of the pairs come out right. The table is kept in ``out``.
    """
    from sklearn.ensemble import ExtraTreesClassifier

    from physion.clips.batch import Spec

    trials = dataset if isinstance(dataset, Dataset) else Dataset(dataset)
    pairs = _pairs(trials)
    digest = json_digest(_facts(trials, pairs, rendered))
    path = Path(out) / "surprise" / f"{PIXELS}-{digest[:16]}.csv"
    if is_whole(path):
        return _read(path)
    source = whole_source(trials, Spec(image_size=48), rendered=rendered)
    features = []
    for name in tracked(list(pairs), PIXELS, len(pairs), progress):
        steps = (source.length(name) - 1) // STEP + 1
        features.append(_statistics(source.window([name], [0], steps).rgb[0]))
    known = np.array(features)
    impossible = np.array([not pair.possible for pair in pairs.values()])
    bases = np.array([pair.base for pair in pairs.values()])
    probability = np.full(len(pairs), 0.5)
    folds = np.arange(len(set(bases))) % 10
    of = dict(zip(sorted(set(bases)), folds.tolist(), strict=True))
    fold = np.array([of[base] for base in bases])
    for number in sorted(set(fold.tolist())):
        tested = fold == number
        if tested.all():
            break
        forest = ExtraTreesClassifier(_TREES, min_samples_leaf=4, random_state=0)
        forest.fit(known[~tested], impossible[~tested])
        probability[tested] = forest.predict_proba(known[tested])[:, 1]
    scenarios = trials.index.set_index("trial")["scenario"]
    rows = [
        _row(PIXELS, "none", scenarios[name], name, pair, value, value)
        for (name, pair), value in zip(pairs.items(), probability.tolist(), strict=True)
    ]
    return _keep(path, pd.DataFrame(rows, columns=list(COLUMNS)))


def _statistics(rgb: NDArray[np.uint8]) -> F64:
    """Return statistics of pictures (T, H, W, 3)."""
    side = rgb.shape[1] // 3
    colors = rgb[:, : 3 * side, : 3 * side].astype(np.float64) / 255
    cells = colors.reshape(len(rgb), 3, side, 3, side, 3)
    parts = [cells.mean(axis=(2, 4)), cells.std(axis=(2, 4))]
    each = np.concatenate([part.reshape(len(rgb), -1) for part in parts], axis=1)
    whole = np.concatenate([colors.mean(axis=(1, 2)), colors.std(axis=(1, 2))], axis=1)
    each = np.concatenate([whole, each], axis=1)
    return np.concatenate([part.mean(axis=0) for part in np.array_split(each, 3)])
