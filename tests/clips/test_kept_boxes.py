"""Boxes that were read before are not rendered again."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest

from physion.clips import rendered
from physion.clips.batch import Motion
from physion.clips.movies import background
from physion.clips.rendered import MotionRenderer
from physion.rendering.renderer import Frame, Renderer
from support.official_hand_made import CLOTH, FRAMES, RIGID, make_scene, make_trajectory

OBJECTS, SIZE = 4, 24
LOOKS = {RIGID: "redyellow", CLOTH: "redyellow"}


@pytest.fixture(scope="module")
def motions() -> dict[str, Motion]:
    scenes = {name: make_scene(name, name == CLOTH) for name in (RIGID, CLOTH)}
    return {name: Motion(scene, make_trajectory(scene)) for name, scene in scenes.items()}


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, tuple[str, ...]]]:
    """Frames and passes that were rendered since the test began."""
    calls: list[tuple[int, tuple[str, ...]]] = []

    class Counting(Renderer):
        def render(self, frame: int, passes: Sequence[str] = ("color",)) -> Frame:
            calls.append((frame, tuple(passes)))
            return super().render(frame, passes)

    monkeypatch.setattr(rendered, "Renderer", Counting)
    return calls


def reader_of(motions: dict[str, Motion], *inputs: str) -> MotionRenderer:
    return MotionRenderer(motions, inputs, SIZE, OBJECTS, LOOKS)


def test_a_trial_that_is_read_again_is_rendered_as_a_whole_and_then_never(
    motions: dict[str, Motion], drawn: list[tuple[int, tuple[str, ...]]]
) -> None:
    reader = reader_of(motions, "boxes")
    windows = [np.array(frames) for frames in ([0, 6, 12], [12, 6, 0], [6, 18, 18], [40, 44, 49])]
    expected = [reader_of(motions, "boxes").read(RIGID, window)["boxes"] for window in windows]
    assert len(drawn) == 3 + 3 + 2 + 3
    drawn.clear()
    found = [reader.read(RIGID, window)["boxes"] for window in windows[:2]]
    assert drawn == [(frame, ("ids",)) for frame in (0, 6, 12)]
    found += [reader.read(RIGID, window)["boxes"] for window in windows[2:]]
    assert sorted(drawn) == [(frame, ("ids",)) for frame in range(FRAMES)]
    np.testing.assert_array_equal(found, expected)
    assert np.isfinite(found[0]).any() and not np.array_equal(found[0], found[3], equal_nan=True)
    reader.read(CLOTH, windows[0])
    assert len(drawn) == FRAMES + 3  # frames of another trial are others


def test_pictures_are_rendered_again_without_ids(
    motions: dict[str, Motion], drawn: list[tuple[int, tuple[str, ...]]]
) -> None:
    reader = reader_of(motions, "rgb", "boxes")
    first = reader.read(RIGID, np.array([3, 9]))
    assert sorted(drawn) == [(3, ("color",)), (3, ("ids",)), (9, ("color",)), (9, ("ids",))]
    drawn.clear()
    again = reader.read(RIGID, np.array([3, 9]))
    assert drawn == [(3, ("color",)), (9, ("color",))]
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name], name)


def test_what_a_caller_changes_does_not_change_what_is_kept(motions: dict[str, Motion]) -> None:
    reader, frames = reader_of(motions, "boxes"), np.array([3, 9])
    first, again = (reader.read(RIGID, frames)["boxes"] for _ in range(2))
    known = first.copy()
    first[...] = again[...] = -1
    np.testing.assert_array_equal(reader.read(RIGID, frames)["boxes"], known)


def test_a_copy_in_another_process_starts_empty_and_reads_the_same(
    motions: dict[str, Motion], drawn: list[tuple[int, tuple[str, ...]]]
) -> None:
    reader, frames = reader_of(motions, "boxes"), np.array([0, 6])
    here = reader.read(RIGID, frames)
    there = pickle.loads(pickle.dumps(reader))
    np.testing.assert_array_equal(there.read(RIGID, frames)["boxes"], here["boxes"])
    assert [frame for frame, _ in drawn] == [0, 6, 0, 6]


def test_threads_may_share_a_reader(motions: dict[str, Motion]) -> None:
    reader = reader_of(motions, "boxes")
    requests = [np.arange(start, FRAMES, 9) for start in range(6)] * 3
    found = background(requests, partial(reader.read, CLOTH), ahead=6, threads=6)
    for window, values in zip(requests, found, strict=True):
        alone = reader_of(motions, "boxes").read(CLOTH, window)
        np.testing.assert_array_equal(values["boxes"], alone["boxes"])
