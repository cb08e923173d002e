"""Clips from movies, in each look, from files that were not changed; and reading ahead."""

from __future__ import annotations

import hashlib
import os
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from physion.clips.batch import Spec
from physion.clips.clips import observed_source, whole_source
from physion.clips.movies import background
from physion.core.errors import BadInputError, UnknownNameError
from physion.trials import files as indexed_file
from physion.trials.dataset import Dataset
from physion.trials.video import encode_movie, read_frames
from support.official_hand_made import CLOTH, FRAMES, RIGID, SIZE

SPEC = Spec(image_size=16, context=7, future=5, context_at="start")


@pytest.fixture
def copy(made: Dataset, tmp_path: Path) -> Dataset:
    """A copy of the dataset whose files may be changed."""
    shutil.copytree(made.folder, tmp_path / "copy")
    return Dataset(tmp_path / "copy")


def test_context_shows_the_observed_movie(made: Dataset) -> None:
    batch = observed_source(made, SPEC).context([RIGID, CLOTH, RIGID])
    assert batch.trials == (RIGID, CLOTH, RIGID)
    assert batch.frames.tolist() == [list(range(0, 37, 6))] * 3 and batch.valid.all()
    for row, trial in enumerate(batch.trials):
        movie = read_frames(made.paths(trial).observed_movie, size=(16, 16))
        np.testing.assert_array_equal(batch.rgb[row], movie[:37:6])
    assert batch.ids is None and batch.state is None and batch.camera is None


def test_the_end_anchor_ends_with_the_last_observed_frame(made: Dataset) -> None:
    spec = replace(SPEC, context_at="end", context=4, stride=5)
    batch = observed_source(made, spec).context([RIGID])
    assert batch.frames.tolist() == [[29, 34, 39, 44]]
    movie = read_frames(made.paths(RIGID).observed_movie, size=(16, 16))
    np.testing.assert_array_equal(batch.rgb[0], movie[29:45:5])


def test_whole_clips_show_the_full_movie_and_repeat_its_last_frame(made: Dataset) -> None:
    source = whole_source(made, SPEC)
    whole = source.whole([CLOTH])
    assert source.length(CLOTH) == FRAMES
    assert whole.frames.tolist() == [[0, 6, 12, 18, 24, 30, 36, 42, 48, 49, 49, 49]]
    assert whole.valid.tolist() == [[True] * 9 + [False] * 3]
    movie = read_frames(made.paths(CLOTH).movie, size=(16, 16))
    np.testing.assert_array_equal(whole.rgb[0], movie[whole.frames[0]])
    usual = whole_source(made, Spec(image_size=16))
    assert usual.whole([CLOTH]).frames.tolist() == [[2, 8, 14, 20, 26, 32, 38, 44, 49]]
    longer = usual.whole([CLOTH], 60)
    assert longer.frames.tolist() == [[2, 8, 14, 20, 26, 32, 38, 44, 49, 49, 49]]
    assert longer.valid.tolist() == [[True] * 8 + [False] * 3]
    np.testing.assert_array_equal(longer.rgb[0], movie[longer.frames[0]])


def test_windows_start_anywhere(made: Dataset) -> None:
    batch = whole_source(made, SPEC).window([RIGID, CLOTH], [3, 38], 3)
    assert batch.frames.tolist() == [[3, 9, 15], [38, 44, 49]]
    assert batch.valid.tolist() == [[True] * 3, [True, True, False]]
    for row, trial in enumerate(batch.trials):
        movie = read_frames(made.paths(trial).movie, size=(16, 16))
        np.testing.assert_array_equal(batch.rgb[row], movie[batch.frames[row]])


def test_windows_that_make_no_sense_are_refused(made: Dataset) -> None:
    source = whole_source(made, SPEC)
    for start in (-1, FRAMES):
        with pytest.raises(BadInputError, match=f"{FRAMES} frames: a window cannot start at"):
            source.window([RIGID], [start], 2)
    with pytest.raises(BadInputError, match="2 starts for 1 trials"):
        source.window([RIGID], [0, 1], 2)
    with pytest.raises(BadInputError, match="not 0 frames"):
        source.window([RIGID], [0], 0)
    with pytest.raises(BadInputError, match="at least one trial"):
        source.context([])
    with pytest.raises(BadInputError, match="at least one trial"):
        source.whole([])


def test_unknown_trials_get_the_closest_ones(made: Dataset) -> None:
    source = whole_source(made, SPEC)
    for ask in (
        lambda: source.context(["collide_testing_000"]),
        lambda: source.key("collide_testing_000", "context"),
        lambda: source.length("collide_testing_000"),
    ):
        with pytest.raises(UnknownNameError, match=RIGID):
            ask()


def test_movies_are_read_in_the_look_that_is_asked_for(made: Dataset) -> None:
    own, free = (observed_source(made, SPEC, look=look) for look in (None, "free"))
    paths = made.paths(RIGID)
    np.testing.assert_array_equal(
        free.context([RIGID]).rgb[0],
        read_frames(paths.free_observed_movie, stride=6, count=7, size=(16, 16)),
    )
    np.testing.assert_array_equal(
        own.context([RIGID]).rgb,
        observed_source(made, SPEC, look="redyellow").context([RIGID]).rgb,
    )
    assert own.key(RIGID, "context") != free.key(RIGID, "context")
    assert own.key(RIGID, "context") == observed_source(made, SPEC, look="redyellow").key(
        RIGID, "context"
    )
    with pytest.raises(BadInputError, match="unknown look 'blue'"):
        observed_source(made, SPEC, look="blue")


def test_a_look_without_movies_is_named_when_it_is_read(copy: Dataset) -> None:
    copy.index.loc[:, ["free_movie_sha256", "free_observed_movie_sha256"]] = None
    source = observed_source(copy, SPEC, look="free")
    with pytest.raises(BadInputError, match=rf"{RIGID}.*rendered=True"):
        source.context([RIGID])
    assert observed_source(copy, SPEC, look="free", rendered=True).context([RIGID]).rgb.any()


def test_a_changed_movie_is_refused_with_its_trial_and_file(copy: Dataset) -> None:
    paths = copy.paths(RIGID)
    paths.observed_movie.write_bytes(paths.observed_movie.read_bytes() + b"\0")
    with pytest.raises(BadInputError, match="was changed since it was made") as caught:
        observed_source(copy, SPEC).context([CLOTH, RIGID])
    message = str(caught.value)
    assert repr(RIGID) in message and str(paths.observed_movie) in message and "\n" not in message
    # Again, and not only the first time.
    with pytest.raises(BadInputError, match="was changed since it was made"):
        observed_source(copy, SPEC).context([RIGID])
    unchecked = observed_source(Dataset(copy.folder, verify=False), SPEC).context([RIGID])
    whole = read_frames(paths.observed_movie, stride=6, count=7, size=(16, 16))
    np.testing.assert_array_equal(unchecked.rgb[0], whole)
    # The full movie is another file.
    assert whole_source(copy, SPEC).whole([RIGID]).rgb.any()


def test_a_movie_is_checked_once_and_again_after_it_was_written(
    copy: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Path] = []
    hashed = indexed_file.file_sha256
    monkeypatch.setattr(indexed_file, "file_sha256", lambda p: read.append(p) or hashed(p))
    movie = copy.paths(RIGID).observed_movie
    for _ in range(3):
        observed_source(copy, SPEC).context([RIGID, RIGID])
    assert read.count(movie) == 1
    content = bytearray(movie.read_bytes())
    content[-1] ^= 1
    movie.write_bytes(bytes(content))
    os.utime(movie, ns=(0, 0))
    with pytest.raises(BadInputError, match="was changed"):
        observed_source(copy, SPEC).context([RIGID])


def test_a_missing_movie_is_named(copy: Dataset) -> None:
    copy.paths(RIGID).observed_movie.unlink()
    for verify in (True, False):
        with pytest.raises(BadInputError, match=rf"{RIGID}_observed\.mp4 is missing"):
            observed_source(Dataset(copy.folder, verify=verify), SPEC).context([RIGID])


@pytest.mark.parametrize(
    ("frames", "size", "rate", "found"),
    [
        (45, SIZE, 100, "at 100 a second"),
        (40, SIZE, 30, "40 frames"),
        (50, SIZE, 30, "50 frames"),
        (45, 64, 30, "64 x 64 pixels"),
    ],
)
def test_a_movie_that_is_not_as_the_index_says_is_refused(
    copy: Dataset, frames: int, size: int, rate: int, found: str
) -> None:
    """Even if its SHA-256 is the one of the index."""
    content = encode_movie(np.full((frames, size, size, 3), 90, np.uint8), rate=rate)
    copy.paths(RIGID).observed_movie.write_bytes(content)
    row = copy.index["trial"] == RIGID
    copy.index.loc[row, "observed_movie_sha256"] = hashlib.sha256(content).hexdigest()
    with pytest.raises(BadInputError, match=rf"{RIGID}_observed\.mp4 has .*{found}.*, not 45") as e:
        observed_source(copy, SPEC).context([RIGID])
    assert "\n" not in str(e.value)


def test_a_cut_movie_is_refused(copy: Dataset) -> None:
    movie = copy.paths(RIGID).movie
    movie.write_bytes(movie.read_bytes()[:-2000])
    with pytest.raises(BadInputError, match=r"_img\.mp4 is (cut short|damaged)"):
        whole_source(Dataset(copy.folder, verify=False), SPEC).whole([RIGID])


def test_keys_follow_the_movie_and_what_the_spec_reads(made: Dataset, copy: Dataset) -> None:
    key = observed_source(made, SPEC).key(RIGID, "context")
    assert len(key) == 64 and int(key, 16)
    equal = (replace(SPEC, mean=(0.5,) * 3), replace(SPEC, future=9), replace(SPEC, objects=3))
    other = (
        replace(SPEC, image_size=32),
        replace(SPEC, context=6),
        replace(SPEC, stride=5),
        replace(SPEC, context_at="end"),
        Spec(image_size=16),
        replace(SPEC, inputs=("rgb", "ids")),
    )
    keys = [observed_source(made, spec).key(RIGID, "context") for spec in equal]
    assert set(keys) == {key}
    keys = [observed_source(made, spec).key(RIGID, "context") for spec in other]
    assert len({key, *keys}) == 1 + len(other)
    assert observed_source(made, SPEC).key(CLOTH, "context") != key
    # Another movie of the same trial, in the same file.
    copy.index.loc[copy.index["trial"] == RIGID, "observed_movie_sha256"] = "0" * 64
    assert observed_source(copy, SPEC).key(RIGID, "context") != key


def test_the_context_of_whole_trials_matches_the_observed_source(made: Dataset) -> None:
    observed, whole = observed_source(made, SPEC), whole_source(made, SPEC)
    assert observed.key(RIGID, "context") == whole.key(RIGID, "context")
    np.testing.assert_array_equal(observed.context([RIGID]).rgb, whole.context([RIGID]).rgb)
    assert whole.key(RIGID, "context") != whole.key(RIGID, "whole")
    for future in (6, None):
        other = whole_source(made, replace(SPEC, future=future))
        assert other.key(RIGID, "whole") != whole.key(RIGID, "whole")


# Batches read ahead: in order, errors at their place, nothing left running.


def running() -> list[str]:
    """Names of the threads that read batches."""
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("batches")]


def slow_square(number: int) -> int:
    """The square; even numbers take longer than odd ones."""
    time.sleep(0.002 if number % 2 else 0.01)
    if number == 7:
        raise BadInputError("seven is bad")
    return number**2


@pytest.mark.parametrize(("ahead", "threads"), [(1, None), (2, None), (3, 2), (8, 8)])
def test_results_come_in_order(ahead: int, threads: int | None) -> None:
    found = list(background(range(7), slow_square, ahead=ahead, threads=threads))
    assert found == [number**2 for number in range(7)]
    assert not running()


def test_an_error_is_raised_where_its_result_would_come() -> None:
    found: list[int] = []
    with pytest.raises(BadInputError, match="seven is bad"):
        found.extend(background(range(20), slow_square, ahead=4, threads=4))
    assert found == [number**2 for number in range(7)]
    assert not running()


def test_an_error_of_the_requests_comes_after_the_results_before_it() -> None:
    def requests() -> Iterator[int]:
        yield from (1, 2, 3)
        raise BadInputError("no more requests")

    found: list[int] = []
    with pytest.raises(BadInputError, match="no more requests"):
        found.extend(background(requests(), slow_square, ahead=8, threads=2))
    assert found == [1, 4, 9]
    assert not running()


def test_no_more_is_read_ahead_than_asked_for() -> None:
    taken: list[int] = []

    def requests() -> Iterator[int]:
        for number in range(100):
            taken.append(number)
            yield number

    results = background(requests(), lambda number: number, ahead=3, threads=2)
    assert not taken  # nothing is read before the first result is asked for
    for position in range(5):
        assert next(results) == position
        assert len(taken) == position + 3
    results.close()  # type: ignore[attr-defined]
    assert len(taken) == 7 and not running()


def test_threads_read_at_the_same_time() -> None:
    barrier = threading.Barrier(3, timeout=300)

    def read(number: int) -> int:
        barrier.wait()  # breaks unless three reads run at once
        return number

    assert list(background(range(6), read, ahead=3, threads=3)) == list(range(6))


def test_a_forgotten_iterator_ends_its_threads() -> None:
    results = background(iter(range(10**9)), slow_square, ahead=4, threads=4)
    next(results)
    assert running()
    del results
    assert not running()


def test_batches_of_a_source_are_the_same_read_ahead(made: Dataset) -> None:
    """Movies, rendering and motions, with more threads than trials."""
    spec = Spec(inputs=("rgb", "ids", "boxes", "state"), image_size=16, stride=3)
    source = whole_source(made, spec)
    requests = [((RIGID, CLOTH), (start, 2 * start)) for start in range(8)]
    expected = [source.window(*request, 4) for request in requests]
    ahead = background(requests, lambda request: source.window(*request, 4), ahead=6, threads=6)
    for batch, known in zip(ahead, expected, strict=True):
        for name, values in known.arrays().items():
            np.testing.assert_array_equal(batch.arrays()[name], values, name)
        assert [motion.trajectory.digest() for motion in batch.state or ()] == [
            motion.trajectory.digest() for motion in known.state or ()
        ]


def test_settings_that_make_no_sense_are_refused_at_once() -> None:
    for ahead, threads in ((0, None), (2, 0)):
        with pytest.raises(BadInputError, match="1 result and 1 thread"):
            background([], slow_square, ahead=ahead, threads=threads)
