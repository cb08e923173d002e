"""Random draws stay in their ranges; parameters are read from tables and checked."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from physion.core.errors import BadInputError, BadSceneError
from physion.numerics.rotations import rotate_vectors
from physion.scenes.sampling.build import as_record, scenarios
from physion.scenes.sampling.parameters import (
    Angle,
    Axes,
    Count,
    Counts,
    FloorPosition,
    Length,
    Lengths,
    Masses,
    Range,
    Room,
    Rotations,
    Shapes,
    Sizes,
    check_params,
    describe_limits,
    draw_axes,
    draw_count,
    draw_frame,
    draw_rotation,
    pick,
    read_params,
    retry,
    uniform,
)
from physion.scenes.sampling.placement import (
    BodyRule,
    PushRule,
    ZoneRule,
    draw_body,
    draw_push,
    draw_zone,
    raise_to_floor,
    require_apart,
)
from physion.scenes.sampling.sample import sample_scene
from physion.scenes.scene import Body, Look
from physion.scenes.shapes.primitives import shape, shapes

SOLIDS = tuple(name for name in shapes.names() if not name.startswith(("prop:", "ramp")))
SEEDS = st.integers(0, 2**32 - 1).map(np.random.default_rng)


def ranges(low: float, high: float) -> SearchStrategy[Range]:
    """Return a strategy of ranges between two values, some of length zero."""
    ends = st.floats(low, high, allow_subnormal=False)
    return st.tuples(ends, ends).map(lambda pair: (min(pair), max(pair)))


def axes(low: float, high: float) -> SearchStrategy[Axes]:
    return ranges(low, high) | st.tuples(*[ranges(low, high)] * 3)


def each_axis(drawn: Axes) -> list[Range]:
    return [drawn] * 3 if isinstance(drawn[0], float) else list(drawn)  # type: ignore[list-item]


def within(value: float, limits: Range) -> bool:
    return limits[0] - 1e-9 <= value <= limits[1] + 1e-9


@settings(deadline=None)
@given(SEEDS, ranges(-50, 50))
def test_draws_are_in_range(rng: np.random.Generator, limits: Range) -> None:
    assert within(uniform(rng, limits), limits)


@settings(deadline=None)
@given(SEEDS, axes(0.005, 200))
def test_sizes_are_in_range(rng: np.random.Generator, limits: Axes) -> None:
    drawn = draw_axes(rng, limits)
    assert all(within(value, one) for value, one in zip(drawn, each_axis(limits), strict=True))
    if isinstance(limits[0], float):
        assert len(set(drawn)) == 1, "one draw for all axes"


@settings(deadline=None)
@given(SEEDS, st.integers(0, 50), st.integers(0, 50))
def test_counts_reach_both_ends(rng: np.random.Generator, one: int, other: int) -> None:
    low, high = sorted((one, other))
    assert low <= draw_count(rng, (low, high)) <= high
    assert {draw_count(rng, (low, low + 1)) for _ in range(64)} == {low, low + 1}


@settings(deadline=None)
@given(SEEDS, ranges(0, 300))
def test_frames_are_whole_and_in_range(rng: np.random.Generator, limits: Range) -> None:
    frame = draw_frame(rng, limits)
    assert isinstance(frame, int) and math.floor(limits[0]) <= frame <= limits[1]


def test_the_last_frame_is_left_out() -> None:
    rng = np.random.default_rng(0)
    assert {draw_frame(rng, (0.0, 15.0)) for _ in range(1000)} == set(range(15))
    assert draw_frame(rng, (30.0, 30.0)) == 30


@settings(deadline=None)
@given(SEEDS, axes(-360, 360))
def test_drawn_rotations_are_unit_quaternions(rng: np.random.Generator, limits: Axes) -> None:
    turn = draw_rotation(rng, limits)
    assert math.isclose(math.hypot(*turn), 1.0)
    if isinstance(limits[0], float):
        assert turn[1] == turn[2] == 0, "one angle turns about the upright"


def test_euler_rotation_has_unity_order() -> None:
    rng = np.random.default_rng(0)
    turn = draw_rotation(rng, ((90.0, 90.0), (0.0, 0.0), (90.0, 90.0)))
    # About x first, which lays z along -y, then about z, which brings that along x.
    assert rotate_vectors(turn, (0, 0, 1)) == pytest.approx([1, 0, 0], abs=1e-12)
    turn = draw_rotation(rng, ((90.0, 90.0), (90.0, 90.0), (0.0, 0.0)))
    assert rotate_vectors(turn, (0, 0, 1)) == pytest.approx([1, 0, 0], abs=1e-12)


@settings(deadline=None)
@given(SEEDS, st.lists(st.sampled_from(SOLIDS), min_size=1, max_size=5))
def test_names_are_picked_from_those_given(rng: np.random.Generator, names: list[str]) -> None:
    assert pick(rng, names) in names
    many = {pick(rng, names) for _ in range(200)}
    assert many == set(names)


@settings(max_examples=60, deadline=None)
@given(
    SEEDS,
    st.sampled_from(SOLIDS),
    axes(0.005, 20),
    axes(-360, 360),
    st.booleans(),
    ranges(0.001, 100),
    ranges(0, 10),
    ranges(0, 10),
    ranges(0, 1),
)
def test_bodies_follow_their_rule(
    rng: np.random.Generator,
    kind: str,
    scale: Axes,
    turn: Axes,
    tumbled: bool,
    mass: Range,
    static: Range,
    dynamic: Range,
    bounce: Range,
) -> None:
    rule = BodyRule((kind,), scale, turn, tumbled, mass, static, dynamic, bounce)
    body = draw_body(rng, rule, "thing", (1.0, 2.0, 0.0), Look())
    assert body.shape == kind and body.position == (1.0, 2.0, 0.0)
    assert all(within(v, one) for v, one in zip(body.scale, each_axis(scale), strict=True))
    assert within(body.mass, mass) and within(body.contact.dynamic_friction, dynamic)
    assert within(body.contact.restitution, bounce)
    assert body.contact.static_friction >= body.contact.dynamic_friction
    assert within(body.contact.static_friction, (static[0], max(static[1], dynamic[1])))
    raised = raise_to_floor(body)
    corners = rotate_vectors(raised.rotation, shape(kind).mesh.vertices * raised.scale)
    lowest = corners[:, 2].min() + raised.position[2]
    assert lowest > -1e-9 and raised.position[:2] == body.position[:2]
    assert raised.position[2] == 0.0 or abs(lowest) < 1e-9, "no higher than needed"


@settings(deadline=None)
@given(SEEDS, ranges(0, 20), ranges(-90, 90), ranges(0, 3), st.floats(-3, 3), ranges(0, 100))
def test_pushes_follow_their_rule(
    rng: np.random.Generator,
    speed: Range,
    heading: Range,
    rise: Range,
    turn: float,
    frame: Range,
) -> None:
    body = Body("probe", "cube", (1.0, 2.0, 0.5), (0.2, 0.4, 0.6), mass=3.0)
    push = draw_push(rng, PushRule(speed, heading, rise, 0.8, 0.0, frame), body, turn)
    x, y, z = (part / 3.0 for part in push.impulse)
    along = math.hypot(x, y)
    assert within(along, speed)
    assert along * rise[0] - 1e-9 <= z <= along * rise[1] + 1e-9
    if along > 1e-6:
        away = math.degrees((math.atan2(y, x) - turn + math.pi) % (2 * math.pi) - math.pi)
        assert heading[0] - 1e-6 <= away <= heading[1] + 1e-6
    assert push.point == pytest.approx((1.0, 2.0, 0.5 + 0.8 * 0.6))
    assert int(frame[0]) <= push.frame <= frame[1]


@settings(deadline=None)
@given(SEEDS, st.sampled_from(SOLIDS), st.floats(0, 2))
def test_push_points_are_jittered_but_not_above_the_body(
    rng: np.random.Generator, kind: str, jitter: float
) -> None:
    body = Body("probe", kind, (0.0, 0.0, 0.0), (0.5, 0.5, 0.5))
    point = draw_push(rng, PushRule(point_jitter=jitter), body).point
    assert point is not None
    top = min(0.8, float(shape(kind).bounds[1, 2])) * 0.5
    rounding = 1e-15
    assert all(abs(a - b) <= jitter + rounding for a, b in zip(point, (0, 0, top), strict=True))


@settings(deadline=None)
@given(SEEDS, ranges(0, 10), st.floats(-5, 5), st.floats(-5, 5))
def test_zones_are_fixed_flat_and_slippery_once_they_slip(
    rng: np.random.Generator, friction: Range, x: float, y: float
) -> None:
    zone = draw_zone(rng, ZoneRule(center=(x, y), friction=friction), Look(), (1.0, 0.0))
    assert zone.kinematic and zone.position == (1.0 + x, y, 0.0)
    assert within(zone.contact.dynamic_friction, friction)
    assert zone.contact.static_friction == pytest.approx(10 * zone.contact.dynamic_friction)


def test_require_apart() -> None:
    cube = Body("one", "cube", (0.0, 0.0, 0.0))
    require_apart(cube, Body("other", "cube", (1.001, 0.0, 0.0)))
    require_apart(cube, Body("other", "cube", (0.0, 0.0, 1.001)))
    with pytest.raises(BadSceneError, match=r"one and other would start [^\d]*$"):
        require_apart(cube, Body("other", "cube", (0.999, 0.0, 0.0)))


def test_retry_reports_the_most_frequent_reason() -> None:
    answers = iter(["too wide"] * 3 + ["too high"] + [None])
    retry(5, "it", lambda: next(answers))
    for order in (["too wide", "too high", "too wide"], ["too high", "too wide", "too wide"]):
        answers = iter(order)
        with pytest.raises(
            BadSceneError, match=r"^it could not be placed in 3 tries: too wide; change"
        ):
            retry(3, "it", lambda: next(answers))  # noqa: B023  # called at once


@dataclass(frozen=True)
class Inner:
    size: Sizes = (1.0, 1.0)
    turn: Rotations = (0.0, 0.0)


@dataclass(frozen=True)
class Sample:
    length: Length = 1.0
    width: Lengths = (0.5, 1.0)
    mass: Masses = (1.0, 2.0)
    angle: Angle = 0.0
    count: Count = 2
    counts: Counts = (1, 3)
    spot: FloorPosition = (0.0, 0.0)
    names: Shapes = ("cube",)
    room: Room = "box"
    flag: bool = False
    inner: Inner = Inner()  # frozen


def test_a_number_is_a_range_of_one_value() -> None:
    table = {"width": 2, "counts": 4, "inner": {"size": [1, [2, 3], 4.5], "turn": 30}}
    read = read_params(Sample, table, "here")
    assert read.width == (2.0, 2.0) and read.counts == (4, 4)
    assert read.inner.size == ((1.0, 1.0), (2.0, 3.0), (4.5, 4.5))
    assert read.inner.turn == (30.0, 30.0)
    assert read.length == 1.0 and read.names == ("cube",), "what is not named stays"


def test_nested_tables_change_what_they_name() -> None:
    base = dataclasses.replace(Sample(), inner=Inner((2.0, 3.0), (5.0, 6.0)), length=7.0)
    read = read_params(Sample, {"inner": {"turn": 1}}, "here", base)
    assert read == dataclasses.replace(base, inner=Inner((2.0, 3.0), (1.0, 1.0)))


LIMITS = {"length": (0, 50), "angle": (-360, 360), "count": (0, 50)}


@settings(deadline=None)
@given(st.sampled_from(sorted(LIMITS)), st.floats() | st.integers(-(10**6), 10**6))
def test_numbers_are_taken_within_their_limits_only(key: str, value: float) -> None:
    low, high = LIMITS[key]
    good = low <= value <= high and (key != "count" or value == int(value))
    if good:
        assert getattr(read_params(Sample, {key: value}, "here"), key) == value
        check_params(dataclasses.replace(Sample(), **{key: value}), "here")
        return
    with pytest.raises(BadInputError, match=f"^here: {key} ") as error:
        read_params(Sample, {key: value}, "here")
    assert f"{low} to {high}" in str(error.value) or not math.isfinite(value)
    with pytest.raises(BadInputError, match=f"^here: {key} "):
        check_params(dataclasses.replace(Sample(), **{key: value}), "here")


BELOW_LEAST = {
    "drape": ["cloth.size", "anchors.width", "anchors.depth", "prop.size"],
    "drop": ["camera.radius", "scenery.distractor_size", "scenery.occluder_size"],
}


@pytest.mark.parametrize(
    ("scenario", "key"), [(name, key) for name, keys in BELOW_LEAST.items() for key in keys]
)
@pytest.mark.parametrize("value", [0, [0, 1], [np.float64(0), np.float64(1)]])
def test_sizes_of_zero_are_refused(scenario: str, key: str, value: Any) -> None:
    rule, name = key.split(".")
    kind = scenarios.get(scenario).params
    with pytest.raises(BadInputError, match=f"here: {rule}: {name} is 0, allowed is 0[.]") as error:
        read_params(kind, {rule: {name: value}}, "here")
    assert "np." not in str(error.value)


@pytest.mark.parametrize(
    "value", [(np.float64(3), np.float64(2)), (np.float64(1),) * 4, [(np.float64(1),), np.int64(2)]]
)
def test_numpy_numbers_are_shown_as_plain_numbers(value: Any) -> None:
    with pytest.raises(BadInputError, match=r"^mine: width must .*\d\]$") as error:
        check_params(dataclasses.replace(Sample(), width=value), "mine")
    assert "np." not in str(error.value)


JUNK = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=6,
)


@pytest.mark.slow
@settings(deadline=None)
@given(st.sampled_from([field.name for field in dataclasses.fields(Sample)]), JUNK)
def test_any_value_is_read_or_refused_by_its_key(key: str, value: Any) -> None:
    try:
        read = read_params(Sample, {key: value}, "here")
    except BadInputError as error:
        refused = str(error)
    else:
        check_params(read, "what was read is good")
        return
    assert refused.startswith(f"here: {key}")


@settings(deadline=None)
@given(st.text(max_size=8).filter(lambda key: key not in Sample.__dataclass_fields__))
def test_unknown_keys_are_refused(key: str) -> None:
    with pytest.raises(BadInputError, match=r"^here: unknown key .*known: length, width"):
        read_params(Sample, {key: 1}, "here")


@pytest.mark.parametrize("name", scenarios.names())
def test_parameters_survive_their_record(name: str) -> None:
    """The parameters stored with a trial are a table from which they can be read again."""
    kind = scenarios.get(name).params
    check_params(kind(), name)
    assert read_params(kind, json.loads(json.dumps(as_record(kind()))), name) == kind()
    limits = describe_limits(kind())
    assert limits["room"] == "names of rooms" and limits["camera.height"] == "0 to 50 m"
    assert all(limits.values())


def test_values_are_checked_with_one_another_wherever_they_are_nested() -> None:
    slippery = BodyRule(static_friction=(0.1, 0.2), dynamic_friction=(0.3, 0.9))
    roll = scenarios.get("roll").params()
    nested = dataclasses.replace(roll, ledge=dataclasses.replace(roll.ledge, target=slippery))
    with pytest.raises(
        BadInputError,
        match=r"mine: ledge: target: static_friction is at most 0\.2 and dynamic_friction at least",
    ):
        check_params(nested, "mine")
    meeting = dataclasses.replace(slippery, static_friction=(0.1, 0.3))
    check_params(meeting, "mine")


@pytest.mark.parametrize("name", ["dominoes", "collide", "contain", "link", "support"])
def test_pushes_come_before_a_trial_can_end(name: str) -> None:
    kind = scenarios.get(name).params
    last = sample_scene(name, np.random.SeedSequence(0)).ending.min_frames - 1
    assert read_params(kind, {"push": {"frame": last}}, "here").push.frame == (last, last)
    for late in (last + 1, [0, 400]):
        with pytest.raises(BadInputError, match=f"frame is .*, allowed is 0 to {last} frames"):
            read_params(kind, {"push": {"frame": late}}, "here")


def test_rules_of_another_kind_are_refused() -> None:
    wrong = dataclasses.replace(scenarios.get("collide").params(), push=BodyRule(), room=Inner())
    with pytest.raises(BadInputError, match="mine: push must be a PushRule, not a BodyRule"):
        check_params(wrong, "mine")
    with pytest.raises(BadInputError, match="mine: room must name a room"):
        check_params(dataclasses.replace(wrong, push=PushRule()), "mine")


def test_parameters_in_code_are_checked_too() -> None:
    kind = scenarios.get("collide").params
    fast = dataclasses.replace(kind().push, speed=(5.0, 3.0))
    with pytest.raises(BadInputError, match="mine: push: speed must go from smaller to larger"):
        check_params(dataclasses.replace(kind(), push=fast), "mine")
    with pytest.raises(BadInputError, match="mine: room: unknown room 'attic'"):
        check_params(dataclasses.replace(kind(), room="attic"), "mine")
