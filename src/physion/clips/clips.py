"""Clips of a dataset one by one, as torch's ``DataLoader`` takes them; torch is not needed.

`clips` makes them; `observed_source` and `whole_source` open the sources that models are given.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from physion.clips.batch import PIXELS, Spec
from physion.clips.movies import MovieReader, movie_files
from physion.clips.rendered import MotionRenderer
from physion.clips.source import (
    ClipReader,
    ObservedSource,
    TrialReaders,
    WholeSource,
)
from physion.clips.states import TrialMotions
from physion.core.errors import BadInputError
from physion.scenes.looks import LOOKS
from physion.trials.dataset import Dataset


def observed_source(
    dataset: Dataset,
    spec: Spec,
    *,
    look: str | None = None,
    rendered: bool = False,
    last: Mapping[str, int] | None = None,
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
        Render ``rgb`` from the motion instead of reading movies, as always where no trial has any.
    last
        By trial the last frame that may be seen, where it is an earlier one (`ObservedSource`).

    Raises
    ------
    BadInputError
        If the look is unknown. Batches raise it for a file that is missing, damaged, or changed
        since it was made.
    """
    readers = _readers(dataset, spec, look, rendered, observed=True)
    return ObservedSource(spec, readers, last or {})


def whole_source(
    dataset: Dataset,
    spec: Spec,
    *,
    look: str | None = None,
    rendered: bool = False,
    last: Mapping[str, int] | None = None,
    windows: Mapping[str, tuple[int, int]] | None = None,
) -> WholeSource:
    """Return the source of whole trials of a dataset; parameters as of `observed_source`.

    ``windows``: see `WholeSource`.
    """
    context = observed_source(dataset, spec, look=look, rendered=rendered, last=last)
    readers = _readers(dataset, spec, look, rendered, observed=False)
    return WholeSource(context, readers, windows or {})


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
    rendered = rendered or bool(index["movie_sha256"].isna().all())
    from_movies = ("rgb",) if "rgb" in spec.inputs and not rendered else ()
    from_motion = [name for name in spec.inputs if name in PIXELS and name not in from_movies]
    if from_movies:
        files = movie_files(dataset, observed=observed, look=look)
        readers.append(MovieReader(files, spec.image_size))
    if not from_motion and "state" not in spec.inputs:
        return TrialReaders(lengths, readers)
    motions = TrialMotions(dataset.files("trial_file"), observed=observed)
    if from_motion:
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


def clips(
    dataset: Dataset | Path | str,
    *,
    split: str | None = None,
    scenario: str | None = None,
    context: int = 0,
    future: int | None = None,
    stride: int = 6,
    context_at: Literal["start", "end"] = "end",
    size: int = 224,
    passes: Sequence[str] = ("rgb",),
    look: str | None = None,
    objects: int = 10,
    padding: bool = True,
    labels: bool = True,
    rendered: bool = False,
) -> Clips:
    """Return clips, one for each trial, which torch's ``DataLoader`` takes as they are.

    The parameters are fields of `physion.clips.batch.Spec`, with the study as default.

    Parameters
    ----------
    dataset
        The dataset, or its folder.
    split, scenario
        Which trials; by default all.
    context, future
        Frames of a clip in the observed part, 0 for all that fit, and after them: by default up to
        the end of the longest of the trials. With ``future=0`` nothing that follows the observed
        part is opened.
    stride
        Frames of 0.01 s from one frame of a clip to the next.
    context_at
        ``end``: the last frame of the context is the last observed one; ``start``: frame 0 comes
        first.
    size
        Pixels per side.
    passes
        Any of rgb, ids, depth, boxes, camera. All but ``rgb`` are rendered.
    look
        Colours: ``redyellow`` or ``free``; by default each trial's own.
    objects
        Rows of ``boxes``.
    padding
        Repeat the last frame in clips that are longer than their trial; otherwise such trials
        are left out, which needs a ``future``.
    labels
        Give the outcome, too.
    rendered
        Render ``rgb`` from the motion instead of reading movies.

    Returns
    -------
    clips
        A sequence of dictionaries: ``trial`` (name), ``label`` (bool: agent and patient touch),
        ``frames`` (T) int64, ``valid`` (T) bool: whether the trial has that frame, ``rgb``
        (T, H, W, 3) uint8, ``ids`` (T, H, W) uint8: 0 scenery, 1 agent, 2 patient, 3 and more
        the others, ``depth`` (T, H, W) float32 in metres, ``boxes`` (T, objects, 4) float32 in
        0..1 with NaN for the unseen, ``camera`` (2, 4, 4) float64: view and projection.

    Raises
    ------
    BadInputError
        For an unknown pass or look, a context that is not observed, or no trial. Items raise it
        for a file that is missing, damaged or changed.

    Examples
    --------
    >>> clips = physion.clips("trials", split="training", size=64)  # doctest: +SKIP
    >>> loader = torch.utils.data.DataLoader(clips, 32, shuffle=True)  # doctest: +SKIP
    """
    unknown = [name for name in passes if name not in PIXELS]
    if unknown or not passes:
        raise BadInputError(
            f"clips: passes must be some of {', '.join(PIXELS)}, not {list(passes)}"
        )
    spec = Spec(
        inputs=tuple(passes),
        image_size=size,
        stride=stride,
        context=context,
        future=future,
        context_at=context_at,
        objects=objects,
    )
    if not isinstance(dataset, Dataset):
        dataset = Dataset(dataset)
    trials = dataset.trials(split, scenario)
    if not padding:
        if future is None:
            raise BadInputError("clips without padding need the number of frames that follow")
        column = "frames" if future else "observed_frames"
        length = dict(zip(dataset.index["trial"], dataset.index[column], strict=True))
        trials = [t for t in trials if length[t] > spec.all_frames(length[t])[-1]]
    if not trials:
        if padding:
            raise BadInputError(
                f"{dataset.folder} has no trial of split {split or 'any'} and scenario "
                f"{scenario or 'any'}"
            )
        raise BadInputError(
            f"no trial of {dataset.folder} is long enough for a clip (split {split or 'any'}, "
            f"scenario {scenario or 'any'})"
        )
    return Clips(dataset, trials, spec, look=look, labels=labels, rendered=rendered)


class Clips(Sequence[dict[str, Any]]):
    """Clips with labels, one for each trial, which `clips` makes.

    Clips without a future are read from the observed movies, and motions that are cut when they
    are read. Files are opened when a clip is asked for, in the process that asks.
    """

    def __init__(
        self,
        dataset: Dataset,
        trials: Sequence[str],
        spec: Spec,
        *,
        look: str | None,
        labels: bool,
        rendered: bool,
    ) -> None:
        self.spec, self.trials = spec, tuple(trials)
        self._labels = None
        if labels:
            outcomes = dataset.index.set_index("trial")["contact"].loc[list(self.trials)]
            if outcomes.isna().any():
                raise BadInputError(
                    f"trial {outcomes.index[outcomes.isna()][0]!r} is stored without labels; ask "
                    "for clips without (labels=False)"
                )
            self._labels = outcomes.astype(bool).to_dict()
        self._dataset, self._look, self._rendered = dataset, look, rendered
        frames = dict(zip(dataset.index["trial"], dataset.index["frames"], strict=True))
        self._longest = max(int(frames[trial]) for trial in self.trials)
        self._source = self._open()

    def __len__(self) -> int:
        return len(self.trials)

    def __getitem__(self, index: Any) -> Any:
        """Return the clip with this number as a dictionary of arrays; several for a slice."""
        if isinstance(index, slice):
            return [self[row] for row in range(*index.indices(len(self)))]
        trial = self.trials[index]
        whole, longest = self.spec.future != 0, self._longest
        read = self._source.whole([trial], longest) if whole else self._source.context([trial])
        item: dict[str, Any] = {name: a[0] for name, a in read.arrays().items()}
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
        open_source = whole_source if self.spec.future != 0 else observed_source
        return open_source(self._dataset, self.spec, look=self._look, rendered=self._rendered)
