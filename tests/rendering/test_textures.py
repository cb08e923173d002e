"""Textures: painted, looked up, told apart."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from physion.rendering.renderer import Renderer
from physion.rendering.rooms import rooms
from physion.rendering.textures import atlas as textures
from physion.rendering.textures.atlas import (
    FINISHES,
    LEVELS,
    PAINTERS,
    SIZE,
    SLOPE_SCALE,
    SLOPE_ZERO,
    Atlas,
    build_atlas,
    finish,
    mip_level,
    sample_texture,
)
from physion.rendering.textures.materials import F32, Painter
from physion.rendering.triangles import assemble
from physion.scenes.looks import MATERIALS, RED, TEXTURES
from physion.scenes.scene import Camera, Look, Scene
from physion.scenes.shapes.primitives import PREFIX, PROPS, shape
from physion.scenes.shapes.prop_shapes import PropShape
from support.rendered_scenes import body, resting, scene_of

NEAR = Camera((1.3, 1.0, 0.9), (0.0, 0.0, 0.35))


def level(name: str, index: int) -> np.ndarray:
    """Return the linear albedo (side, side, 3) of one level of a texture."""
    atlas = build_atlas((name,))
    start, side = atlas.starts[0, index], SIZE >> index
    texels = atlas.texels[start : start + side * side, :3]
    return (texels.reshape(side, side, 3) / 255.0) ** 2


@pytest.mark.parametrize("name", PAINTERS)
def test_texture_is_in_range_and_keeps_its_mean(name: str) -> None:
    full = level(name, 0)
    assert full.min() >= 0 and full.max() <= 1
    assert full.mean() > 0.03
    for index in range(1, LEVELS):
        np.testing.assert_allclose(level(name, index).mean((0, 1)), full.mean((0, 1)), atol=0.01)


@pytest.mark.parametrize("name", sorted(PAINTERS))
@pytest.mark.parametrize("axis", [0, 1])
def test_texture_repeats_without_a_seam(name: str, axis: int) -> None:
    """The step across the edge is no larger than the largest step inside."""
    image = level(name, 1)
    steps = np.abs(np.diff(image, axis=axis)).mean(axis=(1 - axis, 2))
    over = np.abs(image.take(0, axis) - image.take(-1, axis)).mean()
    assert over <= 1.25 * steps.max() + 0.004


@pytest.mark.parametrize("name", TEXTURES)
def test_every_look_has_a_finish(name: str) -> None:
    kind = finish(name)
    assert kind.texture in PAINTERS
    assert 0 <= kind.reflectance < 1 and 0 <= kind.metalness <= 1 and kind.specular >= 0


def test_materials_differ_in_texture_or_in_finish() -> None:
    finishes = [FINISHES[name] for names in MATERIALS.values() for name in names]
    assert len(set(finishes)) == len(finishes)


def picture(texture: str, size: int) -> np.ndarray:
    """Render a ball and a cube with this texture in grey; sRGB in 0..1."""
    look = Look((0.7, 0.7, 0.7), texture)
    scene = scene_of(
        body("cube", "cube", (0.3, -0.2, 0.0), scale=(0.5, 0.5, 0.5), look=look, kinematic=True),
        body("ball", "sphere", (-0.2, 0.3, 0.0), scale=(0.5, 0.5, 0.5), look=look, kinematic=True),
        camera=NEAR,
    )
    frame = Renderer(scene, resting(scene), size, size).render(0, ("color",))
    assert frame.color is not None
    return frame.color.astype(float) / 255.0


def test_materials_can_be_distinguished_in_a_small_picture() -> None:
    names = [name for names in MATERIALS.values() for name in names]
    shots = {name: picture(name, 128) for name in names}
    for a, b in itertools.combinations(names, 2):
        assert np.abs(shots[a] - shots[b]).mean() > 0.002, f"{a} looks like {b}"


@pytest.mark.parametrize("name", ["wood_oak", "fabric_denim", "fabric_linen", "stone_granite"])
def test_small_pictures_are_large_ones_seen_from_afar(name: str) -> None:
    """Without aliasing, a picture is the mean of 2 x 2 pixels of one of twice the size."""
    small, large = picture(name, 64), picture(name, 128)
    mean = large.reshape(64, 2, 64, 2, 3).mean((1, 3))
    inside = slice(4, -4)
    assert np.abs(small - mean)[inside, inside].mean() < 0.02


def test_a_texture_is_painted_when_first_used_and_then_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    painted: list[str] = []

    def watched(name: str, paint: Painter) -> Painter:
        def watch(rng: np.random.Generator) -> tuple[F32, F32]:
            painted.append(name)
            return paint(rng)

        return watch

    for name, paint in PAINTERS.items():
        monkeypatch.setitem(PAINTERS, name, watched(name, paint))
    textures._levels.cache_clear()
    build_atlas.cache_clear()
    build_atlas(("wood_oak", "plain"))
    assert painted == ["wood_oak", "plain"]
    build_atlas(("plain", "wood_oak"))
    assert len(painted) == 2


def lamp_scene(role: bool) -> Scene:
    look = Look(RED if role else (0.3, 0.3, 0.4), "plain")
    lamp = body("lamp", "prop:lamp", (0, 0, 0), scale=(0.4, 0.4, 0.6), look=look, kinematic=True)
    cube = body("cube", "cube", (0.0, -9.0, 0.0))
    ends = [cube, lamp, body("end", "cube", (2.0, -9.0, 0.0))]
    return scene_of(*(ends[1:] if role else ends), camera=NEAR)


def test_parts_of_props_have_their_own_colours_unless_they_play_a_role() -> None:
    prop = shape("prop:lamp")
    assert isinstance(prop, PropShape)
    free, role = (assemble(scene, rooms.get("empty")) for scene in map(lamp_scene, (False, True)))
    painted = free.material[free.object_ids == 2]
    assert len(set(painted)) == 1 + len(prop.own_looks)
    # Triangles of two colours are two surfaces.
    surfaces = free.groups[free.object_ids == 2]
    pairs = set(zip(surfaces.tolist(), painted.tolist(), strict=True))
    assert len(pairs) == len(set(surfaces.tolist()))
    assert len(set(role.material[role.object_ids == 1])) == 1


def test_paint_follows_the_mesh_of_every_prop() -> None:
    bodies = [
        body(name, PREFIX + name, (3.0 * i, 0.0, 0.0), kinematic=True)
        for i, name in enumerate(PROPS)
    ]
    ends = body("a", "cube"), body("z", "cube")
    made = assemble(scene_of(ends[0], *bodies, ends[1]), rooms.get("empty"))
    for i, name in enumerate(PROPS):
        prop = shape(PREFIX + name)
        assert isinstance(prop, PropShape)
        rows = made.material[made.object_ids == i + 2]
        assert len(rows) == len(prop.paint)
        for slot in set(prop.paint.tolist()):
            assert len(set(rows[prop.paint == slot])) == 1
    assert math.isfinite(float(made.uv.sum()))


SIDE = 512


@pytest.mark.parametrize(
    ("texels", "level"), [(0.01, 0.0), (1.0, 0.0), (2.0, 0.5), (4.0, 1.0), (16.0, 2.0), (1e3, None)]
)
def test_level_of_a_pixel_that_covers_so_many_texels(texels: float, level: float | None) -> None:
    expected = 0.5 * math.log2(texels) if level is None else level
    assert mip_level(texels / SIDE**2, SIDE) == pytest.approx(expected, abs=2e-5)


def test_a_pixel_that_covers_the_whole_texture_takes_the_last_level() -> None:
    assert mip_level(1.0, SIDE) == math.log2(SIDE)


def two_by_two() -> Atlas:
    """Return two levels: texels of stored red 0, 100, 200, 40, then 60; other colours are 255."""
    red = [0, 100, 200, 40, 60]
    slope = int(SLOPE_ZERO + 0.5 * SLOPE_SCALE)
    texels = np.array([[r, 255, 255, slope, int(SLOPE_ZERO)] for r in red], np.uint8)
    return Atlas(texels, np.array([[0, 4]]))


@pytest.mark.parametrize(
    ("u", "v", "level", "stored"),
    [
        (0.25, 0.25, 0.0, 0.0),
        (0.75, 0.25, 0.0, 100.0),
        (0.25, 0.75, 0.0, 200.0),
        (0.5, 0.25, 0.0, 50.0),  # between two texels
        (0.5, 0.5, 0.0, 85.0),  # between all four
        (1.0, 0.25, 0.0, 50.0),  # over the edge, where the texture repeats
        (-3.25, 7.25, 0.0, 100.0),
        (0.3, 0.9, 1.0, 60.0),
        (0.75, 0.25, 0.5, 80.0),  # between two levels
        (0.3, 0.9, 7.0, 60.0),
    ],
)
def test_stored_values_are_mixed_linearly(u: float, v: float, level: float, stored: float) -> None:
    red, green, _, slope_u, slope_v = sample_texture(two_by_two(), 0, u, v, level, True)
    assert red == pytest.approx((stored / 255) ** 2, abs=1e-12)
    assert green == pytest.approx(1.0)
    assert (slope_u, slope_v) == pytest.approx((0.5, 0.0))
