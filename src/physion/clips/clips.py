"""Clips of a dataset one by one, as torch's ``DataLoader`` takes them. This module needs no torch.

`physion.trials.dataset.Dataset.clips` makes them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from physion.clips.batch import PIXELS, Spec
from physion.clips.source import (
    ClipReader,
    ObservedBatches,
    ObservedSource,
    TrialReaders,
    WholeBatches,
    WholeSource,
)
from physion.core.errors import BadInputError
from physion.scenes.looks import LOOKS

if TYPE_CHECKING:
    from physion.trials.dataset import Dataset


# Sources of the batches of a dataset.
#
# Modules that need av or hdf5plugin are imported when they are used, so that clips can be rendered
# and models trained without them.


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
        from physion.clips.movies import MovieReader, movie_files

        files = movie_files(dataset, observed=observed, look=look)
        readers.append(MovieReader(files, spec.image_size))
    if not from_motion and "state" not in spec.inputs:
        return TrialReaders(lengths, readers)
    from physion.clips.states import TrialMotions

    motions = TrialMotions(dataset.files("trial_file"), observed=observed)
    if from_motion:
        from physion.clips.rendered import MotionRenderer

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


class Clips(Sequence[dict[str, Any]]):
    """Clips with labels, one for each trial; see `Dataset.clips` for parameters and items.

    Clips without a future are read from the observed movies, and motions that are cut when they
    are read. Files are opened when a clip is asked for, in the process that asks.
    """

    def __init__(
        self,
        dataset: Dataset,
        *,
        split: str | None = None,
        scenario: str | None = None,
        context: int = 7,
        future: int = 18,
        stride: int = 6,
        context_at: Literal["start", "end"] = "start",
        size: int = 224,
        passes: Sequence[str] = ("rgb",),
        look: str | None = None,
        objects: int = 10,
        padding: bool = True,
        labels: bool = True,
        rendered: bool = False,
    ) -> None:
        unknown = [name for name in passes if name not in PIXELS]
        if unknown or not passes:
            raise BadInputError(
                f"clips: passes must be some of {', '.join(PIXELS)}, not {list(passes)}"
            )
        self.spec = Spec(
            inputs=tuple(passes),
            image_size=size,
            stride=stride,
            context=context,
            future=future,
            context_at=context_at,
            objects=objects,
        )
        index = dataset.index.set_index("trial")
        self.trials = tuple(dataset.trials(split, scenario))
        if not padding:
            column = "frames" if future else "observed_frames"
            long = index[column] > self.spec.all_frames()[-1]
            self.trials = tuple(trial for trial in self.trials if long[trial])
        if not self.trials:
            raise BadInputError(
                f"{dataset.folder} has no trial of split {split or 'any'} and scenario "
                f"{scenario or 'any'}" + ("" if padding else " that is as long as a clip")
            )
        self._labels = index["contact"].astype(bool).to_dict() if labels else None
        self._dataset, self._look, self._rendered = dataset, look, rendered
        self._source = self._open()

    def __len__(self) -> int:
        return len(self.trials)

    def __getitem__(self, index: Any) -> Any:
        """Return the clip with this number as a dictionary of arrays; several for a slice."""
        if isinstance(index, slice):
            return [self[row] for row in range(*index.indices(len(self)))]
        trial = self.trials[index]
        read = self._source.whole if self.spec.future else self._source.context
        item: dict[str, Any] = {name: a[0] for name, a in read([trial]).arrays().items()}
        if self._labels is not None:
            item["label"] = np.bool_(self._labels[trial])
        return {**item, "trial": trial}

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self[row] for row in range(len(self)))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the source: another process opens files itself."""
        return {name: value for name, value in vars(self).items() if name != "_source"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._source = self._open()

    def _open(self) -> Any:
        open_source = whole_source if self.spec.future else observed_source
        return open_source(self._dataset, self.spec, look=self._look, rendered=self._rendered)
