"""JSON from outside becomes dataclasses, or one clear error that names the field."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from physion.core.errors import BadInputError, BadSceneError
from physion.core.settings import MAX_DEPTH, parse_json, read_json, read_settings, shown
from physion.scenes.scene import Body, Camera, Roles, Scene


@dataclass(frozen=True)
class Wheel:
    radius: float
    name: str = "w"


@dataclass(frozen=True)
class Cart:
    wheels: tuple[Wheel, ...]
    size: tuple[float, float] = (1.0, 1.0)
    seats: int = 1
    covered: bool = False
    owner: str | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)
    loads: Mapping[str, float] = field(default_factory=dict)
    spares: Mapping[str, Wheel] = field(default_factory=dict)


def test_values_become_what_their_fields_declare() -> None:
    text = '{"wheels": [{"radius": 2}], "size": [1, 2.5], "owner": null, "notes": {"a": [1]}}'
    cart = read_settings(Cart, parse_json(text, "cart"), "cart")
    assert cart == Cart((Wheel(2.0),), (1.0, 2.5), notes={"a": [1]})
    assert isinstance(cart.wheels[0].radius, float)


def test_values_of_mappings_are_read_and_kept() -> None:
    notes = '{"a": [1, 2.5, {"b": null}], "c": true, "d": "NaN"}'
    text = (
        '{"wheels": [], "notes": ' + notes + ', "loads": {"l": 1}, "spares": {"s": {"radius": 1}}}'
    )
    cart = read_settings(Cart, parse_json(text, "cart"), "cart")
    assert cart.notes == {"a": [1, 2.5, {"b": None}], "c": True, "d": "NaN"}
    assert isinstance(cart.loads["l"], float) and cart.spares == {"s": Wheel(1.0)}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1]", "cart must be an object, not [1]"),
        ("{}", "cart: missing 'wheels'"),
        ('{"wheels": [], "seat": 2}', "cart: unknown key 'seat'; did you mean 'seats'? known: "),
        ('{"wheels": {}}', "cart.wheels must be a list, not {}"),
        ('{"wheels": [{"radius": "2"}]}', "cart.wheels[0].radius must be a finite number, not '2'"),
        ('{"wheels": [{"radius": true}]}', "cart.wheels[0].radius must be a finite number"),
        ('{"wheels": [{"radius": NaN}]}', "cart.wheels[0].radius must be a finite number"),
        ('{"wheels": [{"radius": 1e999}]}', "cart.wheels[0].radius must be a finite number"),
        ('{"wheels": [], "size": [1]}', "cart.size must hold 2 values, not 1"),
        ('{"wheels": [], "seats": 1.0}', "cart.seats must be a whole number, not 1.0"),
        ('{"wheels": [], "covered": 1}', "cart.covered must be true or false, not 1"),
        ('{"wheels": [], "owner": 1}', "cart.owner must be a text, not 1"),
        ('{"wheels": [], "notes": []}', "cart.notes must be an object, not []"),
        ('{"wheels": [], "notes": {"a": NaN}}', "cart.notes.a must be a finite number, not nan"),
        ('{"wheels": [], "notes": {"a": [1, {"b": 1e999}]}}', "cart.notes.a[1].b must be a "),
        ('{"wheels": [], "notes": {"a": -Infinity}}', "cart.notes.a must be a finite number"),
        ('{"wheels": [], "loads": {"a": "1"}}', "cart.loads.a must be a finite number, not '1'"),
        ('{"wheels": [], "spares": {"a": {}}}', "cart.spares.a: missing 'radius'"),
        ('{"wheels": [], "wheels": []}', "cart: key 'wheels' is repeated in one object"),
        ('{"wheels": [], "notes": {"a": {"b": 1, "b": 1}}}', "cart: key 'b' is repeated in one"),
        ("{", "cart is not JSON: "),
        ("1" * 5000, "cart is not JSON: "),
    ],
)
def test_errors_name_the_field_and_what_was_expected(text: str, message: str) -> None:
    with pytest.raises(BadSceneError) as error:
        read_settings(Cart, parse_json(text, "cart", BadSceneError), "cart", BadSceneError)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


@pytest.mark.parametrize("depth", [MAX_DEPTH + 1, 900, 100_000])
@pytest.mark.parametrize("brackets", ["[]", '{"a":}'])
def test_json_without_end_is_refused(depth: int, brackets: str) -> None:
    opening, closing = brackets[:-1], brackets[-1]
    text = opening * depth + "1" + closing * depth
    with pytest.raises(BadInputError, match=f"^here is nested deeper than {MAX_DEPTH} levels$"):
        parse_json(text, "here")
    inside = '{"wheels": [], "notes": {"a": ' + text + "}}"
    with pytest.raises(BadInputError, match="nested deeper"):
        parse_json(inside, "here")
    with pytest.raises(BadSceneError, match="scene is nested deeper"):
        Scene.from_json(text)


def test_a_file_is_named_in_errors(tmp_path: Path) -> None:
    path = tmp_path / "settings.json"
    for text, problem in (("[1]", "must be an object"), ("{", "is not JSON")):
        path.write_text(text)
        with pytest.raises(BadInputError, match=f"^{re.escape(str(path))} {problem}"):
            read_json(path, dict[str, Any])


def test_json_of_the_greatest_depth_is_read() -> None:
    assert parse_json("[" * MAX_DEPTH + "]" * MAX_DEPTH, "here")


def test_large_values_are_shortened() -> None:
    assert len(shown(["x" * 1000] * 1000)) < 400 and len(shown(10**4000)) < 100


def test_names_of_many_bodies_are_shortened() -> None:
    bodies = tuple(Body(f"b{i}", "cube", (0.0, 0.0, 0.0)) for i in range(5000))
    scene = Scene("s", "collide", bodies, Roles("b0", "b1"), Camera((1.0, 0.0, 1.0)))
    with pytest.raises(BadSceneError, match="two things are called") as error:
        Scene("s", "collide", bodies + bodies, scene.roles, scene.camera)
    assert len(str(error.value)) < 400
