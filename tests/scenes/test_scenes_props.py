"""Props: unit-bounded closed stand-ins, and the bounds of the models that they stand for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from physion.errors import BadInputError
from physion.scenes.props import FALLBACK, prop_for, read_model_bounds
from physion.scenes.shapes import shape, shapes

PROPS = [name for name in shapes.names() if name.startswith("prop:")]


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
    assert len(shape(name).mesh.faces) <= 3000


def test_every_category_leads_to_a_prop_that_exists() -> None:
    for category in ("vase", "Chair", "dog", "coffee maker", "garden plant", "table lamp", "box"):
        assert prop_for(category) in PROPS
        assert prop_for(category) != FALLBACK
    assert prop_for("zeppelin") == FALLBACK


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


def test_bounds_become_our_axes(tmp_path: Path) -> None:
    (tmp_path / "b.json").write_text(json.dumps(record()))
    bounds = read_model_bounds(tmp_path / "b.json")["thing"]
    assert bounds.bottom == pytest.approx((0.5, 1.0, 0.5))
    assert bounds.size == pytest.approx((3, 6, 3))
    assert bounds.category == "vase"


def test_records_turned_inside_out_and_flat_are_mended(tmp_path: Path) -> None:
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
    for name, found in bounds.items():
        assert prop_for(found.category) in PROPS
        assert min(found.size) > 0
        if name in shapes and name != "ramp_with_platform_30":
            assert np.ptp(shape(name).bounds, axis=0) == pytest.approx(found.size, abs=1e-3)
