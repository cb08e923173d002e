"""Shapes and props: sizes, closed meshes, collision pieces, categories, looks, official bounds."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from physion.core.errors import BadInputError, UnknownNameError
from physion.physics.rigid.bodies import body_mass
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
from physion.scenes.scene import Body
from physion.scenes.shapes import prop_shapes
from physion.scenes.shapes.meshes import Mesh, hull, merge, solid_properties
from physion.scenes.shapes.primitives import (
    _MODELS,
    FALLBACK,
    PREFIX,
    PROP_CATEGORIES,
    Shape,
    expand_props,
    prop_for,
    read_model_bounds,
    shape,
    shapes,
)
from physion.scenes.shapes.primitives import PROPS as PROP_NAMES
from physion.scenes.shapes.prop_shapes import PropShape
from physion.scenes.shapes.props import NATURAL_SIZES

NAMES = [name for name in shapes.names() if ":" not in name]
"""The official shapes; props and shapes of other tests have a prefix."""
# (low, high) of our axes, from the official model records: x, y = their z, z = their y. The x of
# ramps is mirrored there.
BOUNDS = {
    "bowl": ((-0.4904, -0.4904, 0), (0.4904, 0.4904, 0.3789)),
    "cone": ((-0.4949, -0.5, 0), (0.4949, 0.5, 1)),
    "cube": ((-0.5, -0.5, 0), (0.5, 0.5, 1)),
    "cylinder": ((-0.5, -0.5, 0), (0.5, 0.5, 1)),
    "dumbbell": ((-0.375, -1.125, 0), (0.375, 1.125, 0.75)),
    "octahedron": ((-0.5, -0.5, 0), (0.5, 0.5, 1.5)),
    "pentagon": ((-0.4755, -0.5, 0), (0.4755, 0.4045, 1)),
    "pipe": ((-0.5, -0.5, 0), (0.5, 0.5, 1)),
    "platonic": ((-0.4472, -0.4253, 0), (0.4472, 0.4253, 1)),
    "pyramid": ((-0.5303, -0.5303, 0), (0.5303, 0.5303, 1)),
    "sphere": ((-0.5, -0.5, 0), (0.5, 0.5, 1)),
    "torus": ((-0.625, -0.625, 0), (0.625, 0.625, 0.25)),
    "triangular_prism": ((-0.5, -0.5, 0), (0.5, 0.5, 0.933)),
    "ramp_with_platform_30": ((-1.629, -1, 0), (3.324, 1, 1.0007)),
    "ramp_with_platform_60": ((-1.629, -1, 0), (1.650, 1, 1.0003)),
}
VOLUMES = {
    "cube": 1.0,
    "cylinder": math.pi / 4,
    "sphere": math.pi / 6,
    "cone": math.pi / 12,
    "pyramid": 1.0607**2 / 3,
    "octahedron": 0.5,
    "pentagon": 2.5 * 0.25 * math.sin(math.radians(72)),
    "triangular_prism": 0.5 * 0.933,
    # Regular icosahedron: 5 (3 + sqrt 5) a^3 / 12 with a = 0.5 / sin 72 degrees.
    "platonic": 5 * (3 + math.sqrt(5)) / 12 * (0.5 / math.sin(math.radians(72))) ** 3,
    "dumbbell": 0.8873,
}


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def contains(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Whether each of the points (K, 3) is inside, by the winding number (van Oosterom 1983)."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] - np.asarray(points)[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    volume = np.einsum("kfi,kfi->kf", a, np.cross(b, c))
    below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.arctan2(volume, below).sum(axis=1) > math.pi


@pytest.fixture(params=NAMES)
def any_shape(request: pytest.FixtureRequest) -> Shape:
    return shape(request.param)


def test_official_shapes_are_registered_and_others_get_the_closest_names() -> None:
    assert set(BOUNDS) == set(NAMES)
    with pytest.raises(UnknownNameError, match="torus"):
        shape("tours")


def test_bounds_equal_official_record(any_shape: Shape) -> None:
    assert any_shape.bounds == pytest.approx(np.array(BOUNDS[any_shape.name]), abs=6e-4)


def test_mesh_is_closed_and_faces_outward(any_shape: Shape) -> None:
    solid = as_trimesh(any_shape.mesh)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert solid.body_count == 1
    assert (solid.area_faces > 1e-9).all()


@pytest.mark.parametrize("name", sorted(VOLUMES))
def test_volume_equals_closed_form(name: str) -> None:
    assert shape(name).volume == pytest.approx(VOLUMES[name], rel=0.025)


def test_pieces_are_convex_and_inside_the_bounds(any_shape: Shape) -> None:
    low, high = any_shape.bounds
    for piece in any_shape.pieces:
        corners = piece.mesh.vertices
        assert (corners >= low - 1e-6).all() and (corners <= high + 1e-6).all()
        assert hull(corners).faces.shape[0] >= 4
        if piece.kind == "convex":
            assert len(piece.vertices) == len(hull(piece.vertices).vertices)
            assert piece.center == pytest.approx((corners.min(axis=0) + corners.max(axis=0)) / 2)


@pytest.mark.slow
def test_pieces_fill_the_mesh(any_shape: Shape) -> None:
    total = sum(solid_properties(piece.mesh)[0] for piece in any_shape.pieces)
    assert total == pytest.approx(any_shape.volume, rel=0.04)
    # Same place, not only same volume: a random point is in both or in neither.
    rng = np.random.default_rng(0)
    points = rng.uniform(*any_shape.bounds, (500, 3))
    drawn = contains(any_shape.mesh, points)
    counts = sum(contains(piece.mesh, points).astype(int) for piece in any_shape.pieces)
    assert (counts > 1).mean() < 0.01
    assert (drawn != (counts > 0)).sum() < 0.25 * drawn.sum()


@pytest.mark.parametrize("name", ["pipe", "torus"])
def test_holes_go_through(name: str) -> None:
    hollow = shape(name)
    assert hollow.hollow
    for piece in hollow.pieces:
        x, y = piece.mesh.vertices[:, :2].T
        assert np.hypot(x, y).min() > 0.38


def test_bowl_is_open_above_and_has_a_floor() -> None:
    bowl = shape("bowl")
    points = np.array(
        [[0.01, 0.01, 0.3], [0.01, 0.01, 0.02], [0.4, 0.01, 0.02], [0.47, 0.01, 0.36]]
    )
    assert contains(bowl.mesh, points).tolist() == [False, True, False, True]
    for point, pieces in zip(points, (0, 1, 0, 1), strict=True):
        assert sum(contains(p.mesh, point[None])[0] for p in bowl.pieces) == pieces


@pytest.mark.parametrize("name", NAMES)
@given(scale=st.tuples(*[st.floats(0.05, 3.0)] * 3))
@settings(max_examples=5, deadline=None)
def test_volume_and_centroid_at_any_scale(name: str, scale: tuple[float, float, float]) -> None:
    """Volume and centroid of the scaled solid agree with trimesh; the pieces' mass is close."""
    known = shape(name)
    volume, centroid = solid_properties(known.mesh.moved(scale))
    theirs = as_trimesh(known.mesh.moved(scale))
    theirs.density = 1 / theirs.volume
    assert volume == pytest.approx(known.volume * math.prod(scale), rel=1e-9)
    assert centroid == pytest.approx(theirs.center_mass, abs=1e-6)
    pieces = body_mass(Body("a", name, (0, 0, 0), scale))
    size = np.ptp(known.bounds, axis=0) * scale
    assert np.abs(pieces.center - centroid).max() < 0.02 * size.max()
    assert np.trace(pieces.inertia) == pytest.approx(np.trace(theirs.moment_inertia), rel=0.05)


@pytest.mark.parametrize(
    ("name", "recorded"), [("torus", 0.26175), ("pipe", 0.51461), ("dumbbell", 0.88731)]
)
def test_volume_of_piece_boxes_equals_official_record(name: str, recorded: float) -> None:
    """The bounding boxes of all pieces have the recorded volume."""
    boxes = [np.ptp(piece.mesh.vertices, axis=0) for piece in shape(name).pieces]
    assert sum(map(np.prod, boxes)) == pytest.approx(recorded, rel=0.02)


REST = [
    ("octahedron", "a slanted face", 0.832),
    ("triangular_prism", "a slanted side", 0.441),
    ("pentagon", "a side", 0.403),
    ("pyramid", "a side", 0.465),
    ("cone", "its mantle", 0.444),
    ("dumbbell", "a side", 0.375),
]


@pytest.mark.parametrize(("name", "lying_on", "recorded"), REST)
def test_pivot_height_at_rest_matches_official_trials(
    name: str, lying_on: str, recorded: float
) -> None:
    """Height of the pivot of official objects at rest, in units of the scale."""
    solid = hull(shape(name).mesh.vertices)
    corners = solid.vertices[solid.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights = np.einsum("ij,ij->i", normals, corners[:, 0])
    assert np.abs(heights - recorded).min() < 0.006, f"{name} lying on {lying_on}"


def test_ramp_rises_towards_plus_x() -> None:
    points = np.array([[3.2, 0, 0.99], [0.033, 0, 0.49], [0.033, 0, 0.52]])
    inside = contains(shape("ramp_with_platform_30").mesh, points)
    assert inside.tolist() == [True, True, False]


@given(
    points=st.lists(
        st.tuples(*[st.integers(-20, 20)] * 3), min_size=6, max_size=30, unique=True
    ).filter(lambda p: np.linalg.matrix_rank(np.array(p) - np.array(p[0])) == 3)
)
@settings(max_examples=60, deadline=None)
def test_hull_is_closed_and_contains_its_points(points: list[tuple[int, int, int]]) -> None:
    solid = hull(np.array(points, float))
    volume, center = solid_properties(solid)
    assert volume > 0
    edges = {(int(f[i]), int(f[(i + 1) % 3])) for f in solid.faces for i in range(3)}
    assert all((b, a) in edges for a, b in edges)
    corners = solid.vertices[solid.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for point in itertools.chain(points, [center]):
        assert (np.einsum("ij,ij->i", normals, np.array(point) - corners[:, 0]) < 1e-6).all()


PROPS = [name for name in shapes.names() if name.startswith("prop:")]
OFFICIAL = (
    *("vases", "chairs", "stools", "tables", "plants", "globes", "lamps", "bowls", "boxes"),
    *("mugs", "coffee makers", "dogs"),
)


def test_props_are_listed_once() -> None:
    assert len(PROP_NAMES) == len(set(PROP_NAMES)) >= 24
    assert set(PROPS) == {PREFIX + name for name in PROP_NAMES}
    assert set(NATURAL_SIZES) == set(PROP_NAMES)


@pytest.mark.parametrize("name", PROPS)
def test_prop_is_modelled_in_its_natural_size(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    build = shapes.get(name)
    monkeypatch.setattr(prop_shapes, "_fit_to_unit_box", lambda _, parts: parts)
    low, high = merge(part.mesh for part in build()).bounds
    size = NATURAL_SIZES[name.removeprefix(PREFIX)]
    assert high - low == pytest.approx(size, rel=0.01)
    assert min(size) > 0.01 and max(size) < 3.0, "a thing that one person can carry"


@pytest.mark.parametrize("name", PROPS)
def test_prop_fills_the_unit_box_and_is_closed(name: str) -> None:
    prop = shape(name)
    assert isinstance(prop, PropShape) and prop.name == name
    assert len(prop.mesh.faces) <= 2500, "cheap to draw"
    assert prop.bounds == pytest.approx(np.array([[-0.5, -0.5, 0], [0.5, 0.5, 1]]))
    solid = trimesh.Trimesh(prop.mesh.vertices, prop.mesh.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent
    assert all(part.volume > 0 for part in solid.split())
    for piece in prop.pieces:
        corners = piece.mesh.vertices
        assert (corners >= [-0.51, -0.51, -0.01]).all() and (corners <= [0.51, 0.51, 1.01]).all()


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
    assert props and set(props) <= set(PROP_NAMES)
    # The singular gives the same, with spaces or underscores.
    single = {"boxes": "box"}.get(word, word.removesuffix("s"))
    assert expand_props([single.replace(" ", "_")]) == props
    assert prop_for(single).removeprefix(PREFIX) in props


def test_every_prop_has_an_official_category() -> None:
    reached = {name for names in PROP_CATEGORIES.values() for name in names}
    words = ("canoe", "baseball bat", "coin", "person", "jug", "throw pillow", "sculpture")
    reached |= {prop_for(word).removeprefix(PREFIX) for word in (*words, "wineglass")}
    assert reached == set(PROP_NAMES)


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
        assert min(found.size) > 0
        if name in shapes and name != "ramp_with_platform_30":
            assert np.ptp(shape(name).bounds, axis=0) == pytest.approx(found.size, abs=1e-3)
