"""Shading of one tilted plane against closed forms: Lambert, Blinn-Phong, ambient, footprint."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from physion.rendering.camera import View, intrinsics
from physion.rendering.light import pack_light, to_linear, tone_table
from physion.rendering.rasterizer import (
    BLOCK,
    CAMERA,
    LIGHT,
    MATERIAL,
    NOTHING,
    SAMPLES,
    SURFACE,
    DepthMap,
    DepthRange,
    LightMaps,
    ShadingInputs,
    Triangles,
    VisibilityBuffer,
    barycentric,
    rasterize,
)
from physion.rendering.rooms import rooms
from physion.rendering.shading import (
    CORNER_OCCLUSION,
    CORNER_RANGE,
    FOOTPRINT,
    TONES,
    WHITEST,
    corner_occlusion,
    fresnel,
    highlight,
    keep_nothing,
    lambert,
    shade,
    texture_footprint,
    window_fraction,
)
from physion.rendering.textures.atlas import Atlas
from physion.scenes.scene import Camera

SIZE = 33
"""Odd, so that the centre of the middle pixel lies on the optical axis."""
MIDDLE = SIZE // 2
EYE = Camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), fov=0.8)
VIEW = View(EYE, SIZE, SIZE)
BYTES = 60.0
"""Bytes for each unit of light in the straight tone curve of these tests."""


def along(angle: float) -> tuple[float, float, float]:
    """Return the unit vector that is tilted from +z towards +y by an angle in radians."""
    return (0.0, math.sin(angle), math.cos(angle))


def light_from(angle: float = 0.0, **fields: object) -> NDArray[np.void]:
    light = np.zeros(1, LIGHT)
    light["direction"], light["color"] = along(angle), 1.0
    for name, value in fields.items():
        light[name] = value
    return light


def material_of(**fields: object) -> NDArray[np.void]:
    material = np.zeros(1, MATERIAL)
    material["color"], material["exponent"] = 0.5, 10.0
    for name, value in fields.items():
        material[name] = value
    return material


def plane(
    angle: float, light: NDArray[np.void], material: NDArray[np.void]
) -> tuple[ShadingInputs, VisibilityBuffer]:
    """Return a large plane through the origin, tilted by ``angle``, seen from straight above.

    Its texture coordinates are metres.
    """
    tilt = np.array([[1, 0, 0], [0, math.cos(angle), math.sin(angle)]])
    corners = np.array([[-9.0, -9.0], [27.0, -9.0], [-9.0, 27.0]])
    # Rows of ``tilt`` are the plane's axes; the second falls towards +y where the normal leans.
    vertices = corners @ (tilt * [[1, 1, 1], [1, 1, -1]])
    points = vertices @ VIEW.to_pixels[:, :3].T + VIEW.to_pixels[:, 3]
    triangles = Triangles(np.array([[0, 1, 2]], np.int32), np.zeros(1, bool), np.zeros((1, 3, 3)))
    shape = (SIZE, SIZE, len(SAMPLES))
    ids = np.full(shape, NOTHING, np.int32)
    nearness, drawn = np.zeros(shape, np.float32), np.zeros(shape[:2], bool)
    buffer = VisibilityBuffer(ids, nearness, drawn)
    rasterize(points, triangles, 0, DepthRange(0.01, 100.0), buffer)
    assert ids[MIDDLE, MIDDLE, 0] == 0 and drawn[MIDDLE, MIDDLE]
    drawn[...] = False
    surfaces = np.zeros(1, SURFACE)
    surfaces["normals"], surfaces["uv"] = along(angle), corners
    camera = np.zeros(1, CAMERA)
    camera["position"], camera["rays"] = EYE.position, VIEW.ray_matrix
    inputs = ShadingInputs(
        camera=camera,
        edges=triangles.edges,
        surfaces=surfaces,
        groups=np.zeros(1, np.int32),
        materials=material,
        atlas=Atlas(np.array([[255, 255, 255, 128, 128]], np.uint8), np.array([[0]])),
        lights=light,
        tones=np.round(np.linspace(0.0, WHITEST * BYTES, TONES)).astype(np.uint8),
    )
    return inputs, buffer


def shaded_points(inputs: ShadingInputs, buffer: VisibilityBuffer) -> NDArray[np.void]:
    """Return the `POINT` of each pixel of a plane that never moves."""
    maps, colors = (
        LightMaps(flat_map(np.inf), flat_map(np.inf)),
        np.zeros((SIZE, SIZE, 3), np.uint8),
    )
    known = keep_nothing(SIZE, SIZE, maps)
    shade(buffer, 1, inputs, maps, known, colors)
    return known.points[:-1]


def shaded(angle: float, light: NDArray[np.void] | None = None, **material: object) -> np.void:
    """Return the `POINT` in the middle of the picture of a plane, which is the origin."""
    light = light_from() if light is None else light
    inputs, buffer = plane(angle, light, material_of(**material))
    return shaded_points(inputs, buffer)[MIDDLE * SIZE + MIDDLE]


@pytest.mark.slow
def test_the_point_is_where_the_ray_meets_the_plane() -> None:
    inputs, buffer = plane(0.6, light_from(), material_of())
    assert (buffer.triangle_ids[..., 0] == 0).all()
    points = shaded_points(inputs, buffer)
    np.testing.assert_allclose(points["position"] @ along(0.6), 0.0, atol=1e-5)
    pixels, _ = VIEW.project(points["position"])
    centers = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), axis=-1)
    np.testing.assert_allclose(pixels, centers.reshape(-1, 2), atol=1e-3)
    np.testing.assert_allclose(points["normal"], [along(0.6)] * SIZE**2, atol=1e-6)


@pytest.mark.parametrize("light", [0.0, 0.4])
def test_diffuse_light_goes_with_the_cosine_of_the_tilt(light: float) -> None:
    for tilt in (0.0, 0.35, 1.1):
        point = shaded(tilt, light_from(light))
        np.testing.assert_allclose(point["direct"], 0.5 * math.cos(tilt - light), rtol=1e-6)
        np.testing.assert_array_equal(point["ambient"], 0.0)
    first, second = shaded(0.35)["direct"], shaded(1.1)["direct"]
    np.testing.assert_allclose(first / second, math.cos(0.35) / math.cos(1.1), rtol=1e-6)


def test_a_surface_turned_away_gets_no_direct_light() -> None:
    assert lambert(along(0.2), along(0.2 + 0.6 * math.pi)) == 0.0
    assert lambert(along(0.2), along(0.2 + 0.3 * math.pi)) == pytest.approx(math.cos(0.3 * math.pi))
    point = shaded(1.2, light_from(-1.0), specular=1.0)
    np.testing.assert_array_equal(point["direct"], 0.0)


def test_highlight_is_1_where_the_half_vector_is_the_normal() -> None:
    """The eye is at angle 0, so the half vector lies at half the angle of the light."""
    black = {"color": 0.0, "specular": 0.8, "exponent": 60.0}
    np.testing.assert_allclose(shaded(0.3, light_from(0.6), **black)["direct"], 0.8, rtol=1e-4)
    for away in (0.05, -0.2):
        expected = 0.8 * math.cos(away) ** 60
        point = shaded(0.3 + away, light_from(0.6), **black)
        np.testing.assert_allclose(point["direct"], expected, rtol=2e-3)


def test_highlight_is_0_beyond_60_degrees() -> None:
    assert highlight(along(1.0), along(0.0), along(0.0), 2.0) == pytest.approx(
        math.cos(1.0) ** 2, rel=1e-3
    )
    assert highlight(along(1.1), along(0.0), along(0.0), 2.0) == 0.0


def test_ambient_light_depends_on_the_normal_and_emission_on_the_albedo() -> None:
    slopes = [[0.0, 0.0, 0.0], [0.1, 0.2, 0.3], [0.3, 0.2, 0.1]]
    light = light_from(ambient=(0.4, 0.5, 0.6), ambient_slopes=slopes)
    point = shaded(0.7, light, emission=2.0)
    ambient = np.array([0.4, 0.5, 0.6]) + np.array(along(0.7)) @ slopes
    np.testing.assert_allclose(point["ambient"], 0.5 * ambient + 2.0 * 0.5, rtol=1e-6)


def test_a_level_mirror_reflects_what_is_above() -> None:
    environment = [[0.1] * 3, [0.2] * 3, [0.7] * 3]
    above = shaded(0.0, light_from(environment=environment), reflectance=0.3)
    np.testing.assert_allclose(above["ambient"], 0.3 * 0.7, rtol=1e-6)
    # A ray mirrored by a plane at 45 degrees is level; the albedo of a metal tints it.
    sides = shaded(math.pi / 4, light_from(environment=environment), reflectance=0.3, metalness=1.0)
    expected = 0.5 * fresnel(0.3, 1.0, math.cos(math.pi / 4)) * 0.1
    np.testing.assert_allclose(sides["ambient"], expected, rtol=1e-5)


def test_fresnel_reflectance_straight_on_and_edge_on() -> None:
    assert fresnel(0.04, 0.0, 1.0) == 0.04
    assert fresnel(0.04, 0.0, 0.0) == pytest.approx(0.16)
    assert fresnel(0.4, 1.0, 0.0) == pytest.approx(0.8)


def test_reflected_window() -> None:
    low, high = np.array([-2.0, 5.0, 0.0]), np.array([2.0, 5.0, 4.0])
    ahead = (0.0, 1.0, 0.0)
    assert window_fraction((0.0, 0.0, 2.0), ahead, low, high) == 1.0
    assert window_fraction((2.0, 0.0, 2.0), ahead, low, high) == pytest.approx(0.5)
    assert window_fraction((2.0, 0.0, 4.0), ahead, low, high) == pytest.approx(0.25)
    assert window_fraction((4.0, 0.0, 2.0), ahead, low, high) == 0.0
    assert window_fraction((0.0, 0.0, 2.0), (0.0, -1.0, 0.0), low, high) == 0.0


def test_ambient_occlusion_near_a_wall() -> None:
    low, high = np.full(3, -100.0), np.full(3, 100.0)
    up = (0.0, 0.0, 1.0)
    assert corner_occlusion((0.0, 0.0, -100.0), up, low, high) == pytest.approx(1.0)
    for distance in (0.0, 0.6, 1.5):
        left = corner_occlusion((100.0 - distance, 0.0, -100.0), up, low, high)
        lost = CORNER_OCCLUSION * math.exp(-distance / CORNER_RANGE)
        assert left == pytest.approx(1.0 - lost)
    in_the_corner = corner_occlusion((100.0, 100.0, -100.0), up, low, high)
    assert in_the_corner == pytest.approx((1.0 - CORNER_OCCLUSION) ** 2)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0])
def test_footprint_is_the_area_of_a_pixel_on_the_plane(tilt: float) -> None:
    """A pixel spans depth / focal length; on a tilted plane 1 / cos of it along one axis."""
    inputs, _ = plane(tilt, light_from(), material_of())
    depth, b0, b1, b2 = barycentric(inputs.edges, 0, MIDDLE + 0.5, MIDDLE + 0.5)
    u, v, area = texture_footprint(inputs.edges, inputs.surfaces, 0, (b0, b1, b2), depth)
    focal = intrinsics(EYE, SIZE, SIZE)[0, 0]
    assert (u, v) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert depth == pytest.approx(4.0)
    assert area == pytest.approx(FOOTPRINT * (4.0 / focal) ** 2 / math.cos(tilt))


@pytest.mark.parametrize("degrees", [0, 30, 59, 61])
def test_only_level_surfaces_are_occluded_by_things_near_them(degrees: int) -> None:
    expected = max(2.0 * math.cos(math.radians(degrees)) - 1.0, 0.0)
    assert shaded(math.radians(degrees))["levelness"] == pytest.approx(expected, abs=1e-6)


def flat_map(depth: float) -> DepthMap:
    """Return a map of the ground around the origin, 0.25 m a texel, seen from above."""
    size = 8 * BLOCK
    matrix = np.array([[4.0, 0, 0, size / 2], [0, 4.0, 0, size / 2], [0, 0, -1.0, 0]])
    everywhere, nowhere = np.ones((8, 8), bool), np.zeros(64, bool)
    depths, bounds = (np.full(shape, depth, np.float32) for shape in ((size, size), (8, 8, 2)))
    return DepthMap(matrix, depths, everywhere, nowhere, bounds)


@pytest.mark.parametrize("kept", [0, 1])
def test_shadow_takes_its_fraction_only_of_the_direct_light(kept: int) -> None:
    """Also where the shading of static surfaces is read (``kept`` 1) instead of made."""
    light = light_from(ambient=0.8, shadow_strength=0.75, background=(1.0, 2.0, 3.0))
    inputs, buffer = plane(0.0, light, material_of())
    buffer.triangle_ids[0] = NOTHING
    nothing = flat_map(np.inf)
    # A surface is looked up 3 cm above itself: it throws no shadow on itself, nor does what is
    # nearer than that. Depths of the map are heights with the sign reversed.
    for blocker, direct in ((np.inf, 1.0), (-1.0, 0.25), (0.0, 1.0), (-0.02, 1.0), (-0.04, 0.25)):
        colors, maps = np.zeros((SIZE, SIZE, 3), np.uint8), LightMaps(flat_map(blocker), nothing)
        known = keep_nothing(SIZE, SIZE, maps)
        for _ in range(1 + kept):
            shade(buffer, kept, inputs, maps, known, colors)
        assert (known.state == 0).all() == bool(kept)
        expected = round(BYTES * (0.5 * 0.8 + 0.5 * direct))
        assert np.abs(colors[1:].astype(int) - expected).max() <= 1
        np.testing.assert_array_equal(colors[0], [[BYTES, 2 * BYTES, 3 * BYTES]] * SIZE)


def test_occlusion_under_objects_takes_its_fraction_of_all_light() -> None:
    light = light_from(ambient=0.8, occlusion_strength=0.6)
    inputs, buffer = plane(0.0, light, material_of())
    colors = np.zeros((SIZE, SIZE, 3), np.uint8)
    maps = LightMaps(flat_map(np.inf), flat_map(0.0))
    shade(buffer, 0, inputs, maps, keep_nothing(SIZE, SIZE, maps), colors)
    assert abs(int(colors[MIDDLE, MIDDLE, 0]) - BYTES * 0.4 * 0.5 * 1.8) <= 1


def test_room_light_is_packed_by_name() -> None:
    room = rooms.get("bright")
    light = pack_light(room)[0]
    np.testing.assert_allclose(np.linalg.norm(light["direction"]), 1.0)
    np.testing.assert_array_equal(light["color"], room.light_color)
    np.testing.assert_array_equal(light["window_color"], room.window[2])
    np.testing.assert_array_equal(light["room_high"], room.high)
    assert light["shadow_strength"] == room.shadow_strength


@pytest.mark.parametrize("exposure", [1.0, 1.3])
def test_tone_curve_is_srgb_up_to_the_knee_and_bends_to_white_beyond(exposure: float) -> None:
    tones = tone_table(exposure)
    assert tones[0] == 0 and tones.dtype == np.uint8 and (np.diff(tones.astype(int)) >= 0).all()
    for light in (0.001, 0.01, 0.05, 0.2, 0.4, 0.7, 1.5, 3.9):
        x = light * exposure
        y = x if x < 0.55 else 0.55 + 0.45 * (1 - math.exp(-(x - 0.55) / 0.45))
        coded = 12.92 * y if y <= 0.0031308 else 1.055 * y ** (1 / 2.4) - 0.055
        assert tones[round(light * (TONES - 1) / WHITEST)] == pytest.approx(255 * coded, abs=0.6)


def test_srgb_colours_in_linear_light() -> None:
    """Half a code is 21.4 % of the light; the first codes are on the straight part."""
    linear = to_linear([0.0, 0.02, 0.5, 1.0])
    assert linear.tolist() == pytest.approx([0.0, 0.02 / 12.92, 0.21404114, 1.0], abs=1e-6)
