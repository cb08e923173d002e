"""Ask a language model what will happen: tasks of Inspect AI (extra ``inspect``).

``inspect eval physion/contact --model PROVIDER/MODEL -T dataset=FOLDER`` asks whether red will
touch yellow; ``physion/perception`` asks about what is shown, as a control. Each question is asked
twice, with its options in both orders. ``physion compare LOG.eval`` compares the answers with
people. Questions, reading of answers and measures come from `physion.trials.share.questions`.
"""

from __future__ import annotations

import base64
import functools
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import anyio.to_thread
from PIL import Image

from physion.core.errors import BadInputError, MissingExtraError
from physion.trials.dataset import Dataset
from physion.trials.share.items import Item, Shown, frames_of, items_of, movie_of
from physion.trials.share.questions import (
    VERSION,
    WORDINGS,
    JudgedAnswer,
    judged,
    measures,
    prompt,
    read_answer,
)

try:
    from inspect_ai import Task, task
    from inspect_ai.dataset import MemoryDataset, Sample
    from inspect_ai.model import ChatMessageUser, ContentImage, ContentText, ContentVideo
    from inspect_ai.scorer import (
        Metric,
        SampleScore,
        Score,
        Scorer,
        Target,
        accuracy,
        grouped,
        metric,
        scorer,
        stderr,
    )
    from inspect_ai.solver import Generate, Solver, TaskState, generate, solver
    from inspect_ai.util import registry_info
except ImportError as error:
    raise MissingExtraError("physion.tasks.inspect", "inspect") from error

MOST_FRAMES = 45
JPEG_QUALITY = 92
"""Quality of the pictures of a movie, which was compressed before."""

Media = Literal["frames", "movie"]


def registered(function: Callable[..., Task]) -> Callable[..., Task]:
    """Register a task as ``physion/NAME``, also where the package is installed as editable.

    There Inspect does not recognise the package, whose distribution has another name, and leaves
    out ``physion/``.
    """
    made = task(function)
    name = f"physion/{function.__name__}"
    return made if registry_info(made).name == name else task(name=name)(function)


@registered
def contact(
    dataset: str,
    frames: int = 8,
    media: Media = "frames",
    wording: int = 1,
    split: str = "testing",
    scenario: str | None = None,
) -> Task:
    """Ask whether the red object will touch the yellow one.

    Parameters
    ----------
    dataset
        Folder of a dataset.
    frames
        Number of pictures from the observed part of the movie.
    media
        ``frames``: pictures; ``movie``: the observed movie itself.
    wording
        Wording of the question, from 1 (`physion.trials.share.questions.WORDINGS`).
    split, scenario
        Trials that are asked about.
    """
    return _task(dataset, frames, media, wording, split, scenario, control=False)


@registered
def perception(
    dataset: str,
    frames: int = 8,
    media: Media = "frames",
    split: str = "testing",
    scenario: str | None = None,
) -> Task:
    """Ask what is shown, as a control: which object is on the left, what is in view, what moves.

    Arguments as of `contact`.
    """
    return _task(dataset, frames, media, 1, split, scenario, control=True)


def _task(
    dataset: str, frames: int, media: Media, wording: int, split: str, scenario: str | None,
    *, control: bool,
) -> Task:  # fmt: skip
    if media not in ("frames", "movie"):
        raise BadInputError(f"media is {media!r}; choose frames or movie")
    if not 1 <= frames <= MOST_FRAMES or not 1 <= wording <= len(WORDINGS):
        raise BadInputError(
            f"frames must be 1 to {MOST_FRAMES} and wording 1 to {len(WORDINGS)}, not {frames} and "
            f"{wording}"
        )
    trials = Dataset(Path(dataset))
    items = items_of(trials, split=split, scenario=scenario, control=control)
    pictures = "This picture shows" if frames == 1 else f"These {frames} pictures show, in order,"
    shown = "This video shows" if media == "movie" else pictures
    samples = [
        Sample(
            id=item.id,
            input=prompt(item.question, item.order, wording, shown),
            target=item.truth,
            metadata={
                "trial": item.trial,
                "scenario": item.scenario,
                "question": item.question,
                "order": item.order,
                "shown": item.shown,
            },
        )
        for item in items
    ]
    # What is right is stored with the log too, so that missing answers can be counted as wrong.
    asked = {
        item.id: [item.trial, item.scenario, item.question, item.truth, item.order]
        for item in items
    }
    return Task(
        dataset=MemoryDataset(samples, name=trials.folder.resolve().name),
        solver=[show(_Media(trials, frames, media)), generate()],
        scorer=named_option(),
        version=VERSION,
        metadata={"physion": VERSION, "asked": asked, "frames": frames, "media": media}
        | {"wording": wording},
        metrics=None if not control else _of_perception(),
    )


class _Media:
    """What items of a dataset show, as content of messages; the last ones are remembered."""

    def __init__(self, dataset: Dataset, frames: int, media: Media) -> None:
        self._dataset, self._frames, self._media = dataset, frames, media
        self.content = functools.lru_cache(maxsize=64)(self._content)

    def _content(self, trial: str, question: str, shown: Shown) -> list[Any]:
        item = Item(trial, "", question, "", 0, shown)
        if self._media == "movie":
            movie = _data_uri("video/mp4", movie_of(self._dataset, item))
            return [ContentVideo(video=movie, format="mp4")]
        pictures = []
        for frame in frames_of(self._dataset, item, self._frames):
            buffer = io.BytesIO()
            Image.fromarray(frame).save(buffer, format="jpeg", quality=JPEG_QUALITY)
            pictures.append(ContentImage(image=_data_uri("image/jpeg", buffer.getvalue())))
        return pictures


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


@solver
def show(media: Any) -> Solver:
    """Put pictures or movie of a sample's trial before its question."""

    async def solve(state: TaskState, generate: Generate) -> TaskState:
        about = state.metadata
        content = await anyio.to_thread.run_sync(
            media.content, about["trial"], about["question"], about["shown"]
        )
        text = ContentText(text=state.input_text)
        state.messages = [ChatMessageUser(content=[*content, text])]
        return state

    return solve


def _measured(name: str) -> Callable[[list[SampleScore]], float]:
    """Return the measure ``name`` of `physion.trials.share.questions.measures` as a metric."""

    def value(scores: list[SampleScore]) -> float:
        return measures(map(_answer, scores))[name]

    return value


def _answer(score: SampleScore) -> JudgedAnswer:
    about, value = score.sample_metadata or {}, score.score.as_dict()
    numbers = (float(value[name]) for name in ("first", "readable", "right"))
    return JudgedAnswer(
        f"{about['trial']} {about['question']}",
        str((score.score.metadata or {})["truth"]),
        *numbers,
    )


@metric
def d_prime() -> Metric:
    """Return d' of yes and no."""
    return _measured("d_prime")


@metric
def yes_bias() -> Metric:
    """Return the rate of yes less the rate of contacts."""
    return _measured("yes_bias")


@metric
def flips() -> Metric:
    """Return the fraction of stimuli whose answer changes with the order of the options."""
    return _measured("flips")


@metric
def unreadable() -> Metric:
    """Return the number of answers that name no option; they count as wrong."""
    return _measured("unreadable")


def _of_perception() -> list[Any]:
    right = [grouped(accuracy(), "question"), stderr(cluster="trial")]
    return [{"right": right}, flips(), unreadable()]


@scorer(
    metrics=[
        {"right": [accuracy(), stderr(cluster="trial")]},
        d_prime(),
        yes_bias(),
        flips(),
        unreadable(),
    ]
)
def named_option() -> Scorer:
    """Compare the option that a completion names with the right one."""

    async def score(state: TaskState, target: Target) -> Score:
        about = state.metadata
        item = Item(about["trial"], "", about["question"], target.text, about["order"])
        answer = read_answer(state.output.completion, item.options)
        found = judged(item.trial, item.question, item.truth, answer)
        return Score(
            value={name: getattr(found, name) for name in ("right", "first", "readable")},
            answer=answer,
            explanation=state.output.completion,
            metadata={"truth": item.truth},
        )

    return score
