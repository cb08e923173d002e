"""Scenes check their consistency and are written to JSON and read back without loss."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from physion.core.errors import BadInputError, BadSceneError
from physion.scenes.scene import (
    Body,
    BodyEvent,
    Camera,
    Cloth,
    Ending,
    Joint,
    Look,
    Push,
    Roles,
    Scene,
    SurfaceMaterial,
)

numbers = st.floats(-1e6, 1e6, allow_nan=False)
sizes = st.floats(1e-3, 1e3)
points = st.tuples(numbers, numbers, numbers)


def small_scene() -> Scene:
    return Scene(
        name="s",
        scenario="collide",
        bodies=(Body("red", "cube", (0.0, 0.0, 0.0)), Body("zone", "cube", (1.0, 0.0, 0.0))),
        roles=Roles("red", "zone"),
        camera=Camera((3.0, 0.0, 1.0)),
    )


@given(points, st.tuples(sizes, sizes, sizes), sizes, st.text(max_size=8), st.integers(0, 500))
def test_json_round_trip_is_exact(
    point: tuple[float, float, float],
    size: tuple[float, float, float],
    mass: float,
    text: str,
    frame: int,
) -> None:
    body = Body("red", "bowl", point, size, mass=mass, contact=SurfaceMaterial(0.1, 0.2, 0.3))
    scene = replace(
        small_scene(),
        bodies=(body, Body("zone", "cube", (1.0, 0.0, 0.0), look=Look((0.1, 0.2, 0.3), "metal"))),
        cloths=(Cloth("sheet", point, stretch=0.25),),
        pushes=(Push("red", point, None, frame), Push("red", point, point)),
        joints=(Joint("zone", "red"),),
        events=(BodyEvent(3, "red", "move", point, None), BodyEvent(9, "zone", "vanish")),
        parameters={"text": text, "list": [1, None, {"deep": True}]},
    )
    assert Scene.from_json(scene.to_json()) == scene


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"roles": Roles("blue", "zone")}, "blue"),
        ({"pushes": (Push("ghost", (1.0, 0.0, 0.0)),)}, "ghost"),
        ({"bodies": (Body("red", "cube", (0.0, 0.0, 0.0)),) * 2}, "two things"),
        (
            {
                "bodies": (
                    Body("red", "cube", (0.0, 0.0, 0.0), mass=0.0),
                    Body("zone", "cube", (1.0, 0.0, 0.0)),
                )
            },
            "above zero",
        ),
    ],
)
def test_impossible_scenes_are_refused(change: dict[str, object], complaint: str) -> None:
    with pytest.raises(BadSceneError, match=complaint):
        replace(small_scene(), **change)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("path", "value", "complaint"),
    [
        (("nonsense",), 1, "unknown key"),
        (("camera", "fov"), "wide", "scene.camera.fov"),
        (("camera", "fov"), True, "scene.camera.fov"),
        (("bodies", 0, "position"), [0, 0], "3 values"),
        (("bodies", 0, "kinematic"), 1, "kinematic"),
        (("name",), None, "scene.name"),
        (("bodies",), {}, "list"),
        (("parameters",), [], "scene.parameters must be an object"),
        (("floor",), 10**400, "scene.floor must be a finite number"),
    ],
)
def test_bad_json_names_the_field(
    path: tuple[str | int, ...], value: object, complaint: str
) -> None:
    data = json.loads(small_scene().to_json())
    place = data
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(BadSceneError, match=complaint):
        Scene.from_json(json.dumps(data))


def test_looks_and_camera_do_not_change_the_physics_digest() -> None:
    scene = small_scene()
    painted = tuple(replace(body, look=Look((1.0, 0.0, 0.0))) for body in scene.bodies)
    other = replace(scene, name="t", bodies=painted, camera=Camera((9.0, 9.0, 9.0)), room="bright")
    assert other.physics_digest() == scene.physics_digest()
    for field, value in {"mass": 3.0, "position": (0.0, 0.0, 0.1), "shape": "cone"}.items():
        moved = dataclasses.replace(scene.bodies[0], **{field: value})  # type: ignore[arg-type]
        assert (
            replace(scene, bodies=(moved, scene.bodies[1])).physics_digest()
            != scene.physics_digest()
        )


def with_events(*events: BodyEvent) -> Scene:
    return replace(small_scene(), events=events)


def test_a_scene_without_events_keeps_its_text_and_digest() -> None:
    scene = small_scene()
    assert "events" not in json.loads(scene.to_json())
    later = with_events(BodyEvent(5, "red", "vanish"))
    assert json.loads(later.to_json())["events"][0]["frame"] == 5
    assert later.physics_digest() != scene.physics_digest()


def test_events_of_scenery_do_not_change_the_motion() -> None:
    tree = Body("tree", "cube", (5.0, 0.0, 0.0), scenery=True)
    scene = replace(small_scene(), bodies=(*small_scene().bodies, tree))
    later = replace(scene, events=(BodyEvent(5, "tree", "vanish"),))
    assert later.physics_digest() == scene.physics_digest() == small_scene().physics_digest()


def test_bodies_are_present_between_their_events() -> None:
    scene = with_events(
        BodyEvent(3, "red", "appear"), BodyEvent(5, "zone", "move"), BodyEvent(6, "red", "vanish")
    )
    assert [scene.present(frame)[0] for frame in range(9)] == [f in (3, 4, 5) for f in range(9)]
    assert all(scene.present(frame)[1] for frame in range(9))


@pytest.mark.parametrize(
    ("events", "complaint"),
    [
        ((BodyEvent(5, "ghost", "vanish"),), "no such body"),
        ((BodyEvent(5, "red", "explode"),), "appear, vanish, move"),
        ((BodyEvent(0, "red", "vanish"),), "the first of which is 1"),
        ((BodyEvent(5, "red", "vanish"), BodyEvent(4, "zone", "vanish")), "sorted"),
        ((BodyEvent(5, "red", "vanish"), BodyEvent(6, "red", "move")), "is absent"),
        ((BodyEvent(4, "red", "vanish"), BodyEvent(5, "red", "vanish")), "is absent"),
        ((BodyEvent(4, "red", "appear"), BodyEvent(5, "red", "appear")), "already there"),
    ],
)
def test_impossible_events_are_refused(events: tuple[BodyEvent, ...], complaint: str) -> None:
    with pytest.raises(BadSceneError, match=complaint):
        with_events(*events)


def test_given_frames_are_the_fewest_and_the_most() -> None:
    ending = Ending(min_frames=20, max_frames=50)
    assert ending.frame_limits() == (20, 50)
    assert ending.frame_limits(1) == (1, 1)
    assert ending.frame_limits(70) == (70, 70)
    with pytest.raises(BadInputError, match="at least 1, not 0"):
        ending.frame_limits(0)


def test_too_many_bodies_are_refused() -> None:
    text, count = json.loads(small_scene().to_json()), 10_001
    text["bodies"] += [{**text["bodies"][0], "name": f"body {i}"} for i in range(count - 2)]
    with pytest.raises(BadSceneError, match=rf"scene has {count} bodies, more than 10000"):
        Scene.from_json(json.dumps(text))
    bodies = tuple(Body(f"b{i}", "cube", (0.0, 0.0, 0.0)) for i in range(10_001))
    with pytest.raises(BadSceneError, match="'many' has 10001 bodies and cloths, more than 10000"):
        Scene("many", "drop", bodies, Roles("b0", "b1"), Camera((1.0, 0.0, 0.0)))
