"""Props: closed shapes in the unit box, and the bounds of the models that they replace."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from physion.core.errors import BadInputError, UnknownNameError
from physion.scenes.looks import (
    MATERIALS,
    RED,
    TEXTURES,
    YELLOW,
    expand_materials,
    is_mistakable,
    pick_material,
    prop_look,
)
from physion.scenes.shapes.primitives import (
    _MODELS,
    FALLBACK,
    PREFIX,
    PROP_CATEGORIES,
    expand_props,
    prop_for,
    read_model_bounds,
    shape,
    shapes,
)
from physion.scenes.shapes.primitives import PROPS as NAMES
from physion.scenes.shapes.prop_shapes import PropShape
from physion.scenes.shapes.props import NATURAL_SIZES

PROPS = [name for name in shapes.names() if name.startswith("prop:")]
OFFICIAL = (
    *("vases", "chairs", "stools", "tables", "plants", "globes", "lamps", "bowls", "boxes"),
    *("mugs", "coffee makers", "dogs"),
)


def test_props_are_listed_once() -> None:
    assert len(NAMES) == len(set(NAMES)) >= 24
    assert set(PROPS) == {PREFIX + name for name in NAMES}
    assert set(NATURAL_SIZES) == set(NAMES)


@pytest.mark.parametrize("name", PROPS)
def test_prop_fills_the_unit_box_and_is_closed(name: str) -> None:
    prop = shape(name)
    assert prop.name == name
    assert prop.bounds == pytest.approx(np.array([[-0.5, -0.5, 0], [0.5, 0.5, 1]]))
    solid = trimesh.Trimesh(prop.mesh.vertices, prop.mesh.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent
    assert all(part.volume > 0 for part in solid.split())
    for piece in prop.pieces:
        corners = piece.mesh.vertices
        assert (corners >= [-0.51, -0.51, -0.01]).all() and (corners <= [0.51, 0.51, 1.01]).all()


@pytest.mark.parametrize("name", PROPS)
def test_prop_is_cheap_to_draw(name: str) -> None:
    assert len(shape(name).mesh.faces) <= 2500


@pytest.mark.parametrize("name", PROPS)
def test_prop_is_modelled_at_its_natural_size(name: str) -> None:
    prop, size = shape(name), NATURAL_SIZES[name.removeprefix(PREFIX)]
    assert isinstance(prop, PropShape)
    assert prop.modelled_size == pytest.approx(size, rel=0.01)
    assert min(size) > 0.01 and max(size) < 3.0, "a thing that one person can carry"


@pytest.mark.parametrize("name", PROPS)
def test_triangles_have_area_and_the_highest_faces_up(name: str) -> None:
    mesh = shape(name).mesh
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    assert np.isfinite(corners).all()
    assert areas.min() > 1e-12, "no triangle without area"
    top = corners.mean(axis=1)[:, 2].argmax()
    assert normals[top, 2] > 0, "the highest triangle faces up"


@pytest.mark.parametrize("name", PROPS)
def test_looks_of_parts_are_not_mistakable_for_role_colors(name: str) -> None:
    prop = shape(name)
    assert isinstance(prop, PropShape)
    assert len(prop.paint) == len(prop.mesh.faces)
    assert set(prop.paint) <= set(range(len(prop.own_looks) + 1))
    assert 0 in prop.paint, "some of a prop has the look of its body"
    for look in (*prop.own_looks, *(prop_look(np.random.default_rng(i), name) for i in range(20))):
        assert look.texture in TEXTURES
        assert not any(is_mistakable(look.color, role) for role in (RED, YELLOW))


@pytest.mark.parametrize("word", OFFICIAL)
def test_official_categories_have_props(word: str) -> None:
    props = expand_props([word])
    assert props and set(props) <= set(NAMES)
    # The singular gives the same, with spaces or underscores.
    single = {"boxes": "box"}.get(word, word.removesuffix("s"))
    assert expand_props([single.replace(" ", "_")]) == props
    assert prop_for(single).removeprefix(PREFIX) in props


def test_every_prop_has_an_official_category() -> None:
    reached = {name for names in PROP_CATEGORIES.values() for name in names}
    words = ("canoe", "baseball bat", "coin", "person", "jug", "throw pillow", "sculpture")
    reached |= {prop_for(word).removeprefix(PREFIX) for word in (*words, "wineglass")}
    assert reached == set(NAMES)


def test_full_is_the_union_of_the_categories_of_the_published_trials() -> None:
    words = ("vase", "chair", "dog", "coffee_maker", "globe", "garden plant", "stool", "box")
    assert set(expand_props(["full"])) == set(expand_props(words))
    assert "person" not in expand_props(["full"])


def test_props_are_named_once_and_in_order() -> None:
    assert expand_props(["dog_sitting", "prop:chair", "dogs", "dog sitting"]) == (
        "dog_sitting",
        "chair",
        "dog",
    )
    assert expand_props([]) == ()


@pytest.mark.parametrize("name", ["chiar", "", "prop:", "prop:chairs", "Vase!"])
def test_unknown_props_get_the_closest_names(name: str) -> None:
    with pytest.raises(UnknownNameError, match="closest"):
        expand_props(["vase", name])


def test_families_of_materials() -> None:
    assert set(MATERIALS) == {"wood", "metal", "plastic", "stone", "fabric"}
    every = [name for names in MATERIALS.values() for name in names]
    assert len(every) == len(set(every)) >= 12
    assert min(len(names) for names in MATERIALS.values()) >= 3
    assert set(every) <= set(TEXTURES)
    assert expand_materials(["wood"]) == MATERIALS["wood"]
    assert expand_materials(["wood_oak", "wood", "plain"])[0] == "wood_oak"
    assert len(expand_materials(["wood_oak", "wood"])) == len(MATERIALS["wood"])


@pytest.mark.parametrize("name", ["wod_oak", "", "woods"])
def test_unknown_materials_get_the_closest_names(name: str) -> None:
    with pytest.raises(UnknownNameError, match="wood"):
        expand_materials(["stone", name])


def test_materials_are_drawn_uniformly_and_reproducibly() -> None:
    drawn = [pick_material(np.random.default_rng(i), ["stone", "plain"]) for i in range(400)]
    assert drawn == [
        pick_material(np.random.default_rng(i), ["stone", "plain"]) for i in range(400)
    ]
    counts = {name: drawn.count(name) for name in set(drawn)}
    assert set(counts) == {*MATERIALS["stone"], "plain"}
    assert min(counts.values()) > 50
    with pytest.raises(BadInputError, match="no material"):
        pick_material(np.random.default_rng(0), [])


def test_every_category_has_an_existing_prop() -> None:
    for category in ("vase", "Chair", "dog", "coffee maker", "garden plant", "table lamp", "box"):
        assert prop_for(category) in PROPS
        assert prop_for(category) != FALLBACK
    assert prop_for("zeppelin") == FALLBACK
    assert prop_for("vase", "amphora_jar_vase") == "prop:vase_amphora"
    assert prop_for("vase", "vase_99") == "prop:vase"


def record(**changes: object) -> dict[str, object]:
    def face(x: float, y: float, z: float) -> dict[str, float]:
        return {"x": x, "y": y, "z": z}

    faces = {
        "left": face(-1, 2, 0),
        "right": face(2, 2, 0),
        "front": face(0.5, 2, 4),
        "back": face(0.5, 2, -2),
        "top": face(0.5, 3.5, 1),
        "bottom": face(0.5, 0.5, 1),
        "center": face(0.5, 2, 1),
    }
    return {"models": {"thing": {"bounds": {**faces, **changes}, "category": "vase"}}}


def test_model_bounds_are_converted_to_our_axes(tmp_path: Path) -> None:
    (tmp_path / "b.json").write_text(json.dumps(record()))
    bounds = read_model_bounds(tmp_path / "b.json")["thing"]
    assert bounds.bottom == pytest.approx((0.5, 1.0, 0.5))
    assert bounds.size == pytest.approx((3, 6, 3))
    assert bounds.category == "vase"


def test_inverted_and_flat_model_bounds_are_corrected(tmp_path: Path) -> None:
    swapped = record(left={"x": 2, "y": 2, "z": 0}, right={"x": -1, "y": 2, "z": 0})
    (tmp_path / "b.json").write_text(json.dumps(swapped))
    assert read_model_bounds(tmp_path / "b.json")["thing"].size == pytest.approx((3, 6, 3))
    point = {"x": 0.0, "y": 0.0, "z": 0.0}
    flat = {
        "models": {"coin": {"bounds": dict.fromkeys(record()["models"]["thing"]["bounds"], point)}}
    }  # type: ignore[index]
    (tmp_path / "c.json").write_text(json.dumps(flat))
    assert min(read_model_bounds(tmp_path / "c.json")["coin"].size) > 0


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[1]",
        "{}",
        '{"models": 3}',
        json.dumps(record(top=None)),
        json.dumps(record(top={"x": "wide"})),
        json.dumps(record(top={"x": 0, "y": float("nan"), "z": 0})),
    ],
)
def test_bad_bounds_are_one_clear_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "b.json").write_text(text)
    with pytest.raises(BadInputError, match=r"b\.json"):
        read_model_bounds(tmp_path / "b.json")


def test_missing_file_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="absent"):
        read_model_bounds(tmp_path / "absent.json")


def test_official_bounds_are_read_and_agree_with_our_primitives(official: Path) -> None:
    bounds = read_model_bounds(official / "model_bounds.json")
    assert {model for models in _MODELS.values() for model in models.split()} <= set(bounds)
    for name, found in bounds.items():
        assert prop_for(found.category, name) in PROPS
        assert min(found.size) > 0
        if name in shapes and name != "ramp_with_platform_30":
            assert np.ptp(shape(name).bounds, axis=0) == pytest.approx(found.size, abs=1e-3)
