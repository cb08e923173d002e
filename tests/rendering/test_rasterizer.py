"""Triangles and depth maps with known answers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from physion.rendering.rasterizer import (
    BLOCK,
    NOTHING,
    OCCLUSION_RADIUS,
    OCCLUSION_REACH,
    SAMPLES,
    SHADOW_RADIUS,
    DepthMap,
    DepthRange,
    GeometryBuffers,
    SurfaceMotion,
    Triangles,
    VisibilityBuffer,
    barycentric,
    block_index,
    bound_blocks,
    fill_geometry_buffers,
    lit_fraction,
    mark_lookups,
    mark_neighbours,
    occluded_fraction,
    rasterize,
    rasterize_depth,
    shows_back,
)

SIZE = 64
FRONT, BACK = [0, 1, 2], [0, 2, 1]
"""Counter-clockwise and clockwise in the picture, for the corners below (y points down)."""
CORNERS = [[0.0, 0.0], [0.0, 64.0], [64.0, 0.0]]
DEPTHS = [1.0, 4.0, 2.0]
RANGE = DepthRange(0.1, 100.0)


def homogeneous(pixels: ArrayLike, depths: ArrayLike) -> NDArray[np.float64]:
    w = np.asarray(depths, np.float64)[:, None]
    return np.concatenate([np.asarray(pixels, np.float64) * w, w], axis=1)


def draw(
    points: NDArray[np.float64],
    faces: ArrayLike,
    two_sided: bool = False,
    depths: DepthRange = RANGE,
) -> tuple[Triangles, VisibilityBuffer]:
    faces = np.asarray(faces, np.int32)
    count = len(faces)
    triangles = Triangles(faces, np.full(count, two_sided), np.zeros((count, 3, 3)))
    shape = (SIZE, SIZE, len(SAMPLES))
    ids, drawn = np.full(shape, NOTHING, np.int32), np.zeros(shape[:2], bool)
    buffer = VisibilityBuffer(ids, np.zeros(shape, np.float32), drawn)
    rasterize(points, triangles, 0, depths, buffer)
    return triangles, buffer


def sample_positions() -> NDArray[np.float64]:
    """Return the pixel coordinates (SIZE, SIZE, S, 2) of all samples."""
    x, y = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    return np.asarray(np.stack([x, y], axis=-1)[:, :, None] + SAMPLES)


def test_inverse_depth_is_linear_in_the_picture() -> None:
    _, buffer = draw(homogeneous(CORNERS, DEPTHS), [FRONT])
    x, y = np.moveaxis(sample_positions(), -1, 0)
    expected = 1.0 + x / 64 * (1 / 2 - 1) + y / 64 * (1 / 4 - 1)
    inside = x + y <= 64
    np.testing.assert_array_equal(buffer.triangle_ids == 0, inside)
    np.testing.assert_allclose(buffer.inverse_depth[inside], expected[inside], rtol=1e-6)


def test_interpolation_is_correct_in_perspective() -> None:
    """Half-way in the picture between depths 1 and 4 lies 1/5 of the way in space."""
    triangles, _ = draw(homogeneous(CORNERS, DEPTHS), [FRONT])
    depth, b0, b1, b2 = barycentric(triangles.edges, 0, 0.0, 32.0)
    assert (depth, b0, b1, b2) == pytest.approx((1.6, 0.8, 0.2, 0.0))


def test_a_triangle_is_culled_from_behind_unless_two_sided() -> None:
    points = homogeneous(CORNERS, DEPTHS)
    assert (draw(points, [FRONT])[1].triangle_ids == 0).any()
    assert (draw(points, [BACK])[1].triangle_ids == NOTHING).all()
    front, seen = draw(points, [FRONT], two_sided=True)
    back, also_seen = draw(points, [BACK], two_sided=True)
    np.testing.assert_array_equal(seen.triangle_ids, also_seen.triangle_ids)
    assert not shows_back(front.edges, 0)
    assert shows_back(back.edges, 0)


def test_triangles_that_share_an_edge_cover_every_sample_once() -> None:
    """Samples on the edge itself belong to both; the one drawn first keeps them."""
    points = homogeneous([[8, 8], [8, 56], [56, 56], [56, 8]], [2.0] * 4)
    faces = [[0, 1, 2], [0, 2, 3]]
    one, two = (draw(points, [face])[1].triangle_ids == 0 for face in faces)
    x, y = np.moveaxis(sample_positions(), -1, 0)
    square = (x >= 8) & (x <= 56) & (y >= 8) & (y <= 56)
    np.testing.assert_array_equal(one | two, square)
    np.testing.assert_array_equal(one & two, square & (x == y))
    both = draw(points, faces)[1].triangle_ids
    np.testing.assert_array_equal(both, np.where(one, 0, np.where(two, 1, NOTHING)))


@pytest.mark.parametrize("seed", range(5))
def test_a_fan_around_any_point_has_neither_cracks_nor_overlaps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 9))[::-1] + np.linspace(0, -1e-3, 9)
    rim = 32 + 200 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = homogeneous([rng.uniform(25, 39, 2), *rim], rng.uniform(0.5, 5, 10))
    faces = [[0, 1 + i, 1 + (i + 1) % 9] for i in range(9)]
    alone = [draw(points, [face], two_sided=True)[1].triangle_ids == 0 for face in faces]
    count = np.sum(alone, axis=0)
    assert count.min() == count.max() == 1


def test_surfaces_outside_the_depth_range_are_left_out() -> None:
    points = homogeneous(CORNERS, [3.0] * 3)
    assert (draw(points, [FRONT], depths=DepthRange(2.9, 3.1))[1].triangle_ids == 0).any()
    assert (draw(points, [FRONT], depths=DepthRange(0.1, 2.9))[1].triangle_ids == NOTHING).all()
    assert (draw(points, [FRONT], depths=DepthRange(3.1, 9.0))[1].triangle_ids == NOTHING).all()


def test_the_nearer_triangle_is_seen_whatever_the_order() -> None:
    points = np.concatenate([homogeneous(CORNERS, [3.0] * 3), homogeneous(CORNERS, [2.0] * 3)])
    near, far = [3, 4, 5], [0, 1, 2]
    first, second = draw(points, [far, near])[1], draw(points, [near, far])[1]
    covered = first.triangle_ids != NOTHING
    assert (first.triangle_ids[covered] == 1).all()
    assert (second.triangle_ids[covered] == 0).all()
    np.testing.assert_array_equal(first.inverse_depth, second.inverse_depth)


def geometry(
    faces: ArrayLike, normals: ArrayLike, following: NDArray[np.float64]
) -> GeometryBuffers:
    """Return the G-buffer of the triangle of this module, two-sided, as object 7."""
    triangles, buffer = draw(homogeneous(CORNERS, DEPTHS), faces, two_sided=True)
    out = GeometryBuffers(
        np.full((SIZE, SIZE), np.inf, np.float32),
        np.zeros((SIZE, SIZE, 3), np.float32),
        np.zeros((SIZE, SIZE), np.int16),
        np.zeros((SIZE, SIZE, 2), np.float32),
    )
    corner_normals = np.asarray(normals, np.float32)[None]
    motion = SurfaceMotion(corner_normals, np.array([7], np.int32), following)
    fill_geometry_buffers(buffer.triangle_ids, triangles, motion, 0, out)
    return out


def test_g_buffer_holds_depth_id_and_interpolated_normal() -> None:
    normals = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    still = homogeneous(CORNERS, DEPTHS)
    out = geometry([FRONT], normals, still)
    x, y = 10.5, 20.5
    weights = np.array([1 - (x + y) / 64, y / 64, x / 64]) / DEPTHS
    assert out.depth[20, 10] == pytest.approx(1 / weights.sum(), rel=1e-6)
    assert out.object_ids[20, 10] == 7
    np.testing.assert_allclose(out.normals[20, 10], weights / np.linalg.norm(weights), rtol=1e-6)
    np.testing.assert_allclose(out.flow[20, 10], 0.0, atol=1e-5)
    assert np.isinf(out.depth[63, 63]) and out.object_ids[63, 63] == 0
    back = geometry([BACK], [normals[0], normals[2], normals[1]], still)
    np.testing.assert_allclose(back.normals[20, 10], -out.normals[20, 10], rtol=1e-6)


def test_flow_is_the_shift_in_the_picture_and_nan_behind_the_camera() -> None:
    normals = np.eye(3)
    moved = homogeneous(np.add(CORNERS, (3.0, -2.0)), DEPTHS)
    np.testing.assert_allclose(geometry([FRONT], normals, moved).flow[20, 10], (3, -2), atol=1e-5)
    behind = homogeneous(CORNERS, [-1.0] * 3)
    assert np.isnan(geometry([FRONT], normals, behind).flow[20, 10]).all()


def test_depth_map_of_a_tilted_plane() -> None:
    corners = np.array([[0, 0], [64, 0], [64, 64], [0, 64]], float)
    plane = np.column_stack([corners, 1 + 0.1 * corners[:, 0] + 0.2 * corners[:, 1]])
    faces = np.array([[0, 1, 2], [0, 3, 2]], np.int32)
    depth = np.full((SIZE, SIZE), 9.0, np.float32)
    drawn = np.zeros((SIZE // BLOCK, SIZE // BLOCK), bool)
    rasterize_depth(plane, faces, 0, 2, depth, drawn)
    lowered = (depth < 9.0).reshape(SIZE // BLOCK, BLOCK, -1, BLOCK).any(axis=(1, 3))
    np.testing.assert_array_equal(drawn, lowered)
    assert drawn.any() and not drawn.all()
    x, y = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    np.testing.assert_allclose(depth, np.minimum(1 + 0.1 * x + 0.2 * y, 9.0), rtol=1e-6)


MAP_SIZE = 4 * BLOCK
WINDOW = 5
"""Texels along the side of the window of a shadow lookup."""


def depth_map(depth: NDArray[np.float64] | float, occupied: bool = True) -> DepthMap:
    """Return a map whose texel coordinates and depth are the world's x, y and z."""
    matrix = np.eye(3, 4)
    texels = np.array(np.broadcast_to(depth, (MAP_SIZE, MAP_SIZE)), np.float32)
    bounds = np.zeros((4, 4, 2), np.float32)
    bound_blocks(texels, np.ones((4, 4), bool), bounds)
    return DepthMap(matrix, texels, np.full((4, 4), occupied), np.zeros(16, bool), bounds)


def half_blocked(column: int, depth: float = 0.0) -> DepthMap:
    """Return a map with something at this depth in all texels left of ``column``."""
    return depth_map(np.where(np.arange(MAP_SIZE) < column, depth, np.inf))


def test_a_point_in_the_open_is_lit() -> None:
    assert lit_fraction(depth_map(np.inf), 15.3, 16.8, 1.0) == 1.0


def test_a_point_behind_something_is_dark_and_one_before_it_is_lit() -> None:
    assert lit_fraction(depth_map(0.5), 15.3, 16.8, 1.0) == 0.0
    assert lit_fraction(depth_map(0.5), 15.3, 16.8, 0.4) == 1.0


@pytest.mark.parametrize("y", [14.0, 16.8])
@pytest.mark.parametrize("shift", [0.0, 0.3, -0.4, 1.0, -2.0, 2.5, -2.5, 7.0])
def test_across_an_edge_the_lit_fraction_is_linear(shift: float, y: float) -> None:
    expected = np.clip(0.5 + shift / WINDOW, 0.0, 1.0)
    assert lit_fraction(half_blocked(16), 16 + shift, y, 1.0) == pytest.approx(expected)


def test_outside_the_map_and_in_empty_blocks_everything_is_lit() -> None:
    for x, y in ((-1.0, 16.0), (1.0, 16.0), (16.0, MAP_SIZE - 1.0), (16.0, 1e9)):
        assert lit_fraction(depth_map(0.0), x, y, 1.0) == 1.0
    assert lit_fraction(depth_map(0.0, occupied=False), 16.0, 16.0, 1.0) == 1.0


@pytest.mark.parametrize(
    ("gap", "expected"),
    [
        (0.0, 1.0),
        (0.25 * OCCLUSION_REACH, 0.75),
        (0.5 * OCCLUSION_REACH, 0.5),
        (1.1 * OCCLUSION_REACH, 0.0),
        (-0.1, 0.0),
        (np.inf, 0.0),
    ],
)
def test_occlusion_falls_linearly_with_the_gap(gap: float, expected: float) -> None:
    z = np.float32(0.5)
    result = occluded_fraction(depth_map(0.5 + gap), 15.3, 16.8, z)
    assert result == pytest.approx(expected, abs=1e-5)


def test_next_to_a_wall_half_of_the_surroundings_are_occluded() -> None:
    assert occluded_fraction(half_blocked(16), 16.0, 16.8, 0.0) == pytest.approx(0.5)


@pytest.mark.parametrize("seed", range(4))
def test_lookups_by_the_bounds_of_blocks_have_the_bits_of_lookups_by_texels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    blocks = rng.choice([0.0, 0.1, 0.5, np.inf], (4, 4)).repeat(BLOCK, 0).repeat(BLOCK, 1)
    texels = np.where(rng.random(blocks.shape) < 0.02 * seed, 0.3, blocks)
    quick = depth_map(texels)
    slow = quick._replace(bounds=np.full((4, 4, 2), (-np.inf, np.inf), np.float32))
    decided = 0
    for x, y, z in rng.uniform((2, 2, -0.2), (MAP_SIZE, MAP_SIZE, 0.7), (3000, 3)):
        one, other = (
            (lit_fraction(map_, x, y, z), occluded_fraction(map_, x, y, z))
            for map_ in (quick, slow)
        )
        assert one == other
        decided += one[0] in (0.0, 1.0)
    assert 300 < decided < 2900


@pytest.mark.parametrize("radius", [SHADOW_RADIUS, OCCLUSION_RADIUS])
def test_lookups_that_read_a_block_are_marked(radius: int) -> None:
    """Also that lookups give the same number whether or not a block near them counts as empty."""
    rng = np.random.default_rng(radius)
    size = 6
    empty = np.full((size * BLOCK, size * BLOCK), np.inf, np.float32)
    bounds = np.full((size, size, 2), np.inf, np.float32)
    near = DepthMap(np.eye(3, 4), empty, np.ones((size, size), bool), np.zeros(36, bool), bounds)
    for i, j in np.ndindex(size, size):
        drawn, moved, beside = (np.zeros((size, size), bool) for _ in range(3))
        drawn[i, j] = True
        mark_lookups(drawn, moved)
        mark_neighbours(drawn, beside)
        for x, y in rng.uniform(0.5 + radius, size * BLOCK - radius - 1, (400, 2)):
            block = block_index(near, x, y, 0.0, radius)
            rows, columns = (
                {(int(v - 0.5) + k) // BLOCK for k in (-radius, radius + 1)} for v in (y, x)
            )
            reads = i in rows and j in columns
            rounds = (
                beside[int(y - 0.5) // BLOCK, int(x - 0.5) // BLOCK]
                and lit_fraction(near, x, y, 0.0) != 1.0
            )
            assert moved.reshape(-1)[block] or not (reads or rounds)
        assert moved.sum() <= 16 and (min(i, j) < 3 or moved.sum() == 4)


def test_outside_the_map_and_in_empty_blocks_nothing_is_occluded() -> None:
    for x, y in ((-1.0, 16.0), (2.0, 16.0), (16.0, MAP_SIZE - 1.0), (16.0, 1e9)):
        assert occluded_fraction(depth_map(0.0), x, y, 0.0) == 0.0
    assert occluded_fraction(depth_map(0.0, occupied=False), 16.0, 16.0, 0.0) == 0.0
