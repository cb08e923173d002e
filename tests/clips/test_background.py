"""Batches read ahead: in order, errors at their place, nothing left running."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from physion.clips.batch import Spec
from physion.clips.clips import whole_source
from physion.clips.movies import background
from physion.core.errors import BadInputError
from physion.trials.dataset import Dataset
from support.official_hand_made import CLOTH, RIGID


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


def test_no_thread_is_left_after_an_early_stop() -> None:
    results = background(iter(range(10**9)), slow_square, ahead=4, threads=4)
    assert next(results) == 0 and running()
    for value in results:
        assert value == 1
        break
    results.close()  # type: ignore[attr-defined]
    assert not running()
    with pytest.raises(StopIteration):
        next(results)


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
