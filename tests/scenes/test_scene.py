"""Scenes check their consistency and are written to JSON and read back without loss."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from physion.errors import BadSceneError
from physion.scenes.scene import (
    Body,
    Camera,
    Cloth,
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
