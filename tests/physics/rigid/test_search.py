"""Search for pairs: boxes, candidates, what is forgotten when a pair parts, contacts in order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from physion.physics.rigid.collision.faces import Hulls
from physion.physics.rigid.collision.manifold import Manifolds, new_manifolds
from physion.physics.rigid.collision.pairs import new_pair_space
from physion.physics.rigid.collision.search import (
    FULL,
    SearchScene,
    SearchSpace,
    find_candidates,
    list_contacts,
    new_contact_list,
    new_search_space,
    update_boxes,
    update_candidates,
)
from support.hull_pairs import box, hulls_of, random_hull, random_rotation

F64 = NDArray[np.float64]
REACH, FLOOR = 0.02, 0.0
NO_ROTATION = [1.0, 0.0, 0.0, 0.0]


class Search:
    """Upright bodies, each one hull and, unless ``fixed``, an actor of its own."""

    def __init__(self, hulls: Hulls, fixed: int = 0, capacity: int = 16) -> None:
        count = len(hulls.margin)
        self.actors = count - fixed
        actor = np.minimum(np.arange(count), self.actors)
        material = np.array([[k / 10, k / 20, k / 40] for k in range(count + 1)])
        self.hulls = hulls
        self.scene = SearchScene(np.arange(count + 1), actor, material)
        self.manifolds: Manifolds = new_manifolds(capacity)
        self.space: SearchSpace = new_search_space(count, count, capacity)
        self.x = np.zeros((self.actors + 1, 3))
        self.rot = np.tile(np.eye(3), (self.actors + 1, 1, 1))
        self.q = np.tile(NO_ROTATION, (self.actors + 1, 1))
        self.asleep = np.zeros(self.actors, np.bool_)
        self.candidates = 0

    def step(self, *x: list[float]) -> int:
        """Move the actors to ``x``, search, and bring all manifolds up to date."""
        self.x[: len(x)] = np.array(x).reshape(-1, 3)
        self.space.counters[1] += 1
        update_boxes(
            self.hulls, self.scene, self.x, self.rot, REACH, self.space.box, self.space.body_box,
            self.space.counters[1] == 1,
        )  # fmt: skip
        self.candidates = find_candidates(
            self.scene, self.manifolds, self.space, self.actors, FLOOR, REACH
        )
        if self.candidates != FULL:
            self.update(False)
        return self.candidates

    def update(self, again: bool) -> None:
        update_candidates(
            self.hulls, self.scene, self.manifolds, self.space, self.candidates, self.x, self.q,
            self.rot, self.asleep, REACH, FLOOR, True, new_pair_space(), again,
        )  # fmt: skip

    def pairs(self) -> list[list[int]]:
        """Geoms of all candidates; the last number is the floor."""
        return self.manifolds.geoms[self.space.candidate[: self.candidates]].tolist()


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_boxes_hold_all_corners_and_half_of_the_reach(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = random_hull(rng)
    search = Search(hulls_of(corners))
    search.rot[0] = random_rotation(rng)
    search.step(rng.normal(size=3).tolist())
    moved = corners @ search.rot[0].T + search.x[0]
    low, high = search.space.box[0, :3], search.space.box[0, 3:]
    assert (moved.min(0) - low >= REACH / 2 - 1e-12).all()
    assert (high - moved.max(0) >= REACH / 2 - 1e-12).all()
    assert search.space.body_box[0].tolist() == search.space.box[0].tolist()


def test_pairs_are_candidates_where_their_boxes_overlap() -> None:
    search = Search(hulls_of(box(0.5), box(0.5), box(0.5)))
    search.step([0, 0, 5], [1.0 + 0.99 * REACH, 0, 5], [0, 1.0 + 1.01 * REACH, 5])
    assert search.pairs() == [[0, 1]]
    search.step([0, 0, 5], [1.0 + 1.01 * REACH, 0, 5], [0, 1.0, 5])
    assert search.pairs() == [[0, 2]]


def test_the_floor_is_a_candidate_for_what_is_low_and_can_move() -> None:
    search = Search(hulls_of(box(0.5), box(0.5), box(0.5)), fixed=1)
    search.step([9, 0, 0.5 + 0.99 * REACH], [-9, 0, 0.5 + 1.01 * REACH])
    assert search.pairs() == [[0, 3]]


def test_bodies_of_one_actor_and_fixed_bodies_are_no_pairs() -> None:
    search = Search(hulls_of(box(0.5), box(0.5), box(0.5), box(0.5)), fixed=2)
    search.scene.actor[1] = 0
    search.step([0, 0, 5])
    assert search.pairs() == []


def test_candidates_without_room_are_counted_and_nothing_is_lost() -> None:
    search = Search(hulls_of(*[box(0.5)] * 3), capacity=2)
    assert search.step([0, 0, 5], [0.2, 0, 5], [0.4, 0, 5]) == FULL
    assert search.space.counters[0] == 2


def test_a_pair_that_parts_for_a_step_starts_afresh() -> None:
    near, far = [[0, 0, 5.0], [0, 0, 6.01]], [[0, 0, 5.0], [3.0, 0, 6.01]]
    search = Search(hulls_of(box(0.5), box(0.5)))
    search.step(*near)
    m = search.manifolds
    m.anchor_count[0] = 2
    before = m.point_a[0].copy()
    # A little aside, and without a break: the points and anchors are the old ones.
    aside = [[0.001, 0, 5.0], [0, 0, 6.01]]
    search.step(*aside)
    assert np.array_equal(m.point_a[0], before)
    assert (m.size[0], m.anchor_count[0]) == (4, 2)
    assert search.step(*far) == 0
    search.step(*aside)
    assert not np.array_equal(m.point_a[0], before)
    assert (m.size[0], m.anchor_count[0]) == (4, 0)
    assert search.space.counters[0] == 1


def test_a_hull_that_returns_to_its_place_on_the_floor_has_points_at_once() -> None:
    search = Search(hulls_of(box(0.5)))
    for height, count in ((0.5, 4), (0.7, None), (0.5, 4)):
        assert search.step([0, 0, height]) == (count is not None)
        if count is not None:
            assert search.manifolds.size[0] == count


def test_hulls_out_of_reach_forget_their_anchors() -> None:
    search = Search(hulls_of(box(0.5), box(0.5)))
    search.step([0, 0, 5.0], [0, 0, 6.01])
    search.manifolds.anchor_count[0] = 2
    assert search.manifolds.touching[0] == 1
    # The boxes still overlap: the upper one stands on an edge.
    half = np.sqrt(0.5)
    search.rot[1] = [[1, 0, 0], [0, half, -half], [0, half, half]]
    search.step([0, 0, 5.0], [0.9, 0.9, 5.9])
    assert search.candidates == 1
    assert search.manifolds.touching[0] == 0
    assert search.manifolds.anchor_count[0] == 0


def test_pairs_of_sleepers_wait_until_one_is_woken() -> None:
    search = Search(hulls_of(box(0.5), box(0.5)))
    search.asleep[:] = True
    search.step([0, 0, 5.0], [0, 0, 6.01])
    assert search.candidates == 1
    assert search.manifolds.size[0] == 0
    contacts = new_contact_list(4)

    def listed() -> int:
        return int(
            list_contacts(
                search.scene, search.manifolds, search.space, search.candidates, search.x,
                search.rot, REACH, contacts,
            )
        )  # fmt: skip

    assert listed() == 0
    search.asleep[1] = False
    search.update(True)
    assert search.manifolds.size[0] == 4
    assert listed() == 1


def test_contacts_are_in_world_axes_from_the_first_body_to_the_second() -> None:
    search = Search(hulls_of(box(0.5), box(0.5)))
    search.step([0, 0, 0.505], [0.2, 0, 1.5])
    contacts = new_contact_list(4)
    pairs = list_contacts(
        search.scene, search.manifolds, search.space, search.candidates, search.x, search.rot,
        REACH, contacts,
    )  # fmt: skip
    assert pairs == 2
    assert contacts.first[:3].tolist() == [0, 4, 8]
    assert contacts.bodies[:2].tolist() == [[0, 1], [0, 2]]
    assert contacts.actors[:2].tolist() == [[0, 1], [0, 2]]
    assert contacts.normal[:2].tolist() == [[0, 0, 1], [0, 0, -1]]
    # The means of 0, 0.1, 0.2 and half, a quarter of these.
    assert contacts.material[:2].tolist() == [
        pytest.approx([0.05, 0.025, 0.0125]),
        pytest.approx([0.1, 0.05, 0.025]),
    ]
    # Points on the second body: the lower face of the upper box, and the floor.
    assert contacts.gap[:8].tolist() == pytest.approx([-0.005] * 4 + [0.005] * 4)
    upper = sorted(np.round(contacts.point[:4], 9).tolist())
    assert upper == [[x, y, 1.0] for x in (-0.3, 0.5) for y in (-0.5, 0.5)]
    floor = sorted(np.round(contacts.point[4:8], 9).tolist())
    assert floor == [[x, y, 0.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
