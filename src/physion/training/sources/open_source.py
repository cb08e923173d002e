"""Sources of the batches of a dataset.

Modules that need av or hdf5plugin are imported when they are used, so that clips can be rendered
and models trained without them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from physion.errors import BadInputError
from physion.models.batch import PIXELS, Spec
from physion.scenes.looks import LOOKS
from physion.training.sources.batches import (
    ClipReader,
    ObservedBatches,
    TrialReaders,
    WholeBatches,
)
from physion.training.sources.source import ObservedSource, WholeSource

if TYPE_CHECKING:
    from physion.trials.dataset import Dataset


def observed_source(
    dataset: Dataset,
    spec: Spec,
    *,
    look: str | None = None,
    rendered: bool = False,
) -> ObservedSource:
    """Return the source of the observed part of the trials of a dataset.

    It opens the observed movies, and motions that are cut when they are read.

    Parameters
    ----------
    dataset
        The dataset.
    spec
        What the batches hold. ``ids``, ``depth``, ``boxes`` and ``camera`` are rendered from the
        motions, and so is ``rgb`` if ``rendered`` is set.
    look
        Colours: ``redyellow`` or ``free``, by default each trial's own.
    rendered
        Render ``rgb`` from the motion instead of reading movies.

    Raises
    ------
    BadInputError
        If the look is unknown. Batches raise it for a file that is missing, damaged, or changed
        since it was made.
    """
    return _observed(dataset, spec, look, rendered)


def whole_source(
    dataset: Dataset,
    spec: Spec,
    *,
    look: str | None = None,
    rendered: bool = False,
) -> WholeSource:
    """Return the source of whole trials of a dataset; parameters as of `observed_source`."""
    context = _observed(dataset, spec, look, rendered)
    return WholeBatches(context, _readers(dataset, spec, look, rendered, observed=False))


def _observed(dataset: Dataset, spec: Spec, look: str | None, rendered: bool) -> ObservedBatches:
    readers = _readers(dataset, spec, look, rendered, observed=True)
    return ObservedBatches(spec, readers)


def _readers(
    dataset: Dataset,
    spec: Spec,
    look: str | None,
    rendered: bool,
    *,
    observed: bool,
) -> TrialReaders:
    """Return readers of all that ``spec`` asks for, of the observed part or of whole trials."""
    if look is not None and look not in LOOKS:
        raise BadInputError(f"unknown look {look!r}; known: {', '.join(LOOKS)}")
    index = dataset.index
    column = "observed_frames" if observed else "frames"
    lengths = {
        str(trial): int(frames) for trial, frames in zip(index["trial"], index[column], strict=True)
    }
    readers: list[ClipReader] = []
    from_movies = ("rgb",) if "rgb" in spec.inputs and not rendered else ()
    from_motion = [name for name in spec.inputs if name in PIXELS and name not in from_movies]
    if from_movies:
        from physion.training.sources.movies import MovieReader, movie_files

        files = movie_files(dataset, observed=observed, look=look)
        readers.append(MovieReader(files, spec.image_size))
    if not from_motion and "state" not in spec.inputs:
        return TrialReaders(lengths, readers)
    from physion.training.sources.states import TrialMotions

    motions = TrialMotions(dataset.files("trial_file"), observed=observed)
    if from_motion:
        from physion.training.sources.rendered import MotionRenderer

        if from_movies:
            _check_square(dataset)
        looks = {str(row.trial): look or str(row.look) for row in index.itertuples()}
        readers.append(MotionRenderer(motions, from_motion, spec.image_size, spec.objects, looks))
    return TrialReaders(lengths, readers, motions if "state" in spec.inputs else None)


def _check_square(dataset: Dataset) -> None:
    """Raise `BadInputError` if movies are not square, as what is rendered with them is."""
    oblong = dataset.index[dataset.index["width"] != dataset.index["height"]]
    if len(oblong):
        row = oblong.iloc[0]
        raise BadInputError(
            f"trial {row['trial']!r} has movies of {row['width']} x {row['height']} pixels; "
            "rendered inputs are square and would not fit them: render rgb too (rendered=True)"
        )
