"""Camera, depth, ids, normals and flow against numbers by hand, ray casting and known motion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.numerics.rotations import rotation_matrix
from physion.rendering.camera import View, axes, intrinsics, projection_matrix, view_matrix
from physion.rendering.rasterizer import (
    NOTHING,
    SAMPLES,
    DepthRange,
    Triangles,
    VisibilityBuffer,
    rasterize,
)
from physion.rendering.renderer import Frame, Renderer
from physion.scenes.scene import Camera, Cloth, Scene
from physion.scenes.shapes.primitives import shape, shapes
from support.rendered_scenes import (
    body,
    flat_sheet,
    resting,
    scene_of,
    trajectory_of,
    tumbling,
)

# At (0, -2, 0.5), looking along +y; 90 degrees, so that the focal length is half the height.
CAMERA = Camera((0.0, -2.0, 0.5), (0.0, 3.0, 0.5), fov=math.pi / 2, near=0.1, far=100.0)
VIEW = View(CAMERA, 320, 200)
Array = NDArray[np.float64]


def unproject(view: View, pixels: Array, depth: Array) -> Array:
    """Return world points (..., 3) at pixel coordinates (..., 2) and planar depths (...)."""
    rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1) @ view.ray_matrix.T
    return np.asarray(view.camera.position) + rays * depth[..., None]


def test_axes_are_right_down_forward() -> None:
    np.testing.assert_allclose(axes(CAMERA), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)


def test_view_matrix() -> None:
    expected = [[1, 0, 0, 0], [0, 0, -1, 0.5], [0, 1, 0, 2], [0, 0, 0, 1]]
    np.testing.assert_allclose(view_matrix(CAMERA), expected, atol=1e-15)


def test_intrinsics() -> None:
    expected = [[100, 0, 160], [0, 100, 100], [0, 0, 1]]
    np.testing.assert_allclose(intrinsics(CAMERA, 320, 200), expected, rtol=1e-15)


@pytest.mark.parametrize(
    ("point", "pixel", "depth"),
    [
        ((0.0, 0.0, 0.5), (160.0, 100.0), 2.0),
        ((1.0, 0.0, 0.5), (210.0, 100.0), 2.0),
        ((0.0, 0.0, 1.5), (160.0, 50.0), 2.0),
        ((-3.2, 0.0, -1.5), (0.0, 200.0), 2.0),
        ((0.0, 8.0, 2.5), (160.0, 80.0), 10.0),
    ],
)
def test_project(point: tuple[float, ...], pixel: tuple[float, ...], depth: float) -> None:
    result, result_depth = VIEW.project(point)
    np.testing.assert_allclose(result, pixel, atol=1e-9)
    assert result_depth == pytest.approx(depth)
    np.testing.assert_allclose(unproject(VIEW, np.array(pixel), np.array(depth)), point, atol=1e-12)


def test_behind_the_camera_is_a_negative_depth() -> None:
    assert VIEW.project((0.0, -3.0, 0.5))[1] == pytest.approx(-1.0)


def test_projection_matrix_agrees_with_pixels() -> None:
    camera = Camera((1.3, -2.0, 1.7), (0.1, 0.2, 0.3), fov=0.9, near=0.2, far=30.0)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    seen = np.concatenate([points, np.ones((20, 1))], axis=1) @ view_matrix(camera).T
    clip = seen @ projection_matrix(camera, 320, 200).T
    ndc = clip[:, :3] / clip[:, 3:]
    pixels = np.stack([(ndc[:, 0] + 1) * 160, (1 - ndc[:, 1]) * 100], axis=1)
    result, depth = View(camera, 320, 200).project(points)
    np.testing.assert_allclose(pixels, result, atol=1e-9)
    near_far = np.array([[0, 0, 0.2, 1], [0, 0, 30.0, 1]]) @ projection_matrix(camera, 320, 200).T
    np.testing.assert_allclose(near_far[:, 2] / near_far[:, 3], [-1, 1], atol=1e-9)
    np.testing.assert_allclose(clip[:, 3], depth)


def test_straight_down_has_y_upright() -> None:
    pixel, _ = View(Camera((0, 0, 3), (0, 0, 0)), 100, 100).project((0.0, 0.5, 0.0))
    assert pixel[0] == pytest.approx(50.0)
    assert pixel[1] < 50.0


def test_a_camera_at_its_own_target_is_an_error() -> None:
    with pytest.raises(BadInputError, match="same point"):
        axes(Camera((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)))


EXACT = ("depth", "normals", "ids", "flow")


def pixel_centers(width: int, height: int) -> Array:
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], axis=-1)


def rays(scene: Scene, size: int = 256) -> tuple[Array, Array]:
    """Return the camera position (3,) and the vectors (H, W, 3) from it to depth 1 m."""
    eye = np.asarray(scene.camera.position)
    view = View(scene.camera, size, size)
    return eye, unproject(view, pixel_centers(size, size), np.ones((size, size))) - eye


def inner(mask: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Return which pixels have the same value as their eight neighbours."""
    padded = np.pad(mask, 1, mode="edge")
    height, width = mask.shape
    neighbours = [padded[i : i + height, j : j + width] == mask for i in range(3) for j in range(3)]
    return np.all(neighbours, axis=0)


def render(scene: Scene, size: int = 256) -> Frame:
    return Renderer(scene, resting(scene), size, size).render(0, EXACT)


def ball_hits(scene: Scene, center: Array, radius: float) -> Array:
    """Return the depth of a sphere at each pixel, NaN where the ray misses it."""
    eye, ray = rays(scene)
    a = (ray**2).sum(-1)
    b = ray @ (eye - center)
    c = ((eye - center) ** 2).sum() - radius**2
    with np.errstate(invalid="ignore"):
        return np.asarray((-b - np.sqrt(b * b - a * c)) / a)


def test_plane_depth_and_normal_even_where_it_passes_under_the_camera() -> None:
    camera = Camera((0.3, 0.2, 0.8), (1.0, 0.4, 0.0), fov=math.radians(80))
    scene = scene_of(body("far", at=(30.0, 30.0, 0.0)), camera=camera)
    frame = render(scene)
    eye, ray = rays(scene)
    assert frame.depth is not None and frame.normals is not None and frame.ids is not None
    expected = -eye[2] / ray[..., 2]
    floor = (expected > 0) & (frame.ids == 0)
    assert floor.mean() > 0.9
    assert floor[-1].all()
    np.testing.assert_allclose(frame.depth[floor], expected[floor], atol=1e-3)
    np.testing.assert_allclose(frame.normals[floor], [[0, 0, 1]] * floor.sum(), atol=1e-6)


def test_sphere_depth_silhouette_and_normals() -> None:
    scene = scene_of(body("ball", "test:fine_sphere", (0.2, -0.1, 0.3), scale=(0.8, 0.8, 0.8)))
    frame = render(scene)
    assert frame.depth is not None and frame.normals is not None and frame.ids is not None
    center = np.array([0.2, -0.1, 0.7])
    expected = ball_hits(scene, center, 0.4)
    hit = np.isfinite(expected)
    sure = inner(hit)
    assert hit.sum() > 2500
    np.testing.assert_array_equal((frame.ids == 1)[sure], hit[sure])
    both = hit & sure
    np.testing.assert_allclose(frame.depth[both], expected[both], atol=1e-3)
    eye, ray = rays(scene)
    normal = (eye + ray * expected[..., None] - center) / 0.4
    angle = np.degrees(np.arccos(np.clip((normal * frame.normals).sum(-1)[both], -1, 1)))
    assert angle.max() < 1.0


def test_normals_of_a_stretched_and_turned_ball_match_an_ellipsoid() -> None:
    """The gradient of x²/a² + y²/b² + z²/c² in the body's axes."""
    half, turn = np.array([0.5, 0.25, 0.35]), (0.8, 0.36, 0.0, 0.48)
    scene = scene_of(
        body("ball", "test:fine_sphere", (0.1, 0.0, 0.2), scale=tuple(2 * half), rotation=turn)
    )
    frame = render(scene)
    assert frame.normals is not None
    matrix = rotation_matrix(np.array(turn))
    center = np.array([0.1, 0.0, 0.2]) + matrix @ [0, 0, half[2]]
    own = (seen_points(scene, frame) - center) @ matrix
    normal = (own / half**2) @ matrix.T
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    mask = inner(frame.ids == 1) & (frame.ids == 1)
    assert mask.sum() > 1500
    angle = np.degrees(np.arccos(np.clip((normal * frame.normals).sum(-1)[mask], -1, 1)))
    assert np.quantile(angle, 0.99) < 1.5


def test_box_silhouette_and_normals() -> None:
    scale, at = np.array([0.5, 0.7, 0.9]), np.array([-0.1, 0.2, 0.1])
    scene = scene_of(body("box", "cube", tuple(at), scale=tuple(scale)))
    frame = render(scene)
    assert frame.depth is not None and frame.normals is not None and frame.ids is not None
    eye, ray = rays(scene)
    low = at - [0.5, 0.5, 0.0] * scale
    near = (low - eye) / ray
    far = (low + scale - eye) / ray
    enter = np.minimum(near, far).max(-1)
    hit = enter < np.maximum(near, far).min(-1)
    sure = inner(hit)
    assert hit.sum() > 2500
    np.testing.assert_array_equal((frame.ids == 1)[sure], hit[sure])
    both = hit & sure
    np.testing.assert_allclose(frame.depth[both], enter[both], atol=1e-4)
    axis = np.minimum(near, far).argmax(-1)[both]
    normal = np.eye(3)[axis] * -np.sign(ray[both][np.arange(len(axis)), axis])[:, None]
    assert (np.abs(frame.normals[both] - normal).max(-1) < 1e-5).mean() > 0.99


def expected_flow(scene: Scene, frame: Frame, moved: Array) -> Array:
    """Return the flow (H, W, 2) of pixels whose surface points move to ``moved`` (H, W, 3)."""
    pixels, _ = View(scene.camera, 256, 256).project(moved)
    return pixels - pixel_centers(256, 256)


def seen_points(scene: Scene, frame: Frame) -> Array:
    assert frame.depth is not None
    depth = np.where(np.isfinite(frame.depth), frame.depth, 0.0)
    return unproject(View(scene.camera, 256, 256), pixel_centers(256, 256), depth)


def test_flow_of_rigid_bodies_is_their_motion() -> None:
    scene, trajectory = tumbling()
    frame = Renderer(scene, trajectory).render(1, EXACT)
    assert frame.ids is not None and frame.flow is not None
    points = seen_points(scene, frame)
    for i in (0, 1):
        now, later = (rotation_matrix(trajectory.rotations[f, i]) for f in (1, 2))
        local = (points - trajectory.positions[1, i].astype(np.float64)) @ now
        moved = local @ later.T + trajectory.positions[2, i].astype(np.float64)
        mask = frame.ids == i + 1
        assert mask.sum() > 500
        expected = expected_flow(scene, frame, moved)[mask]
        assert np.abs(expected).max() > 1.0
        np.testing.assert_allclose(frame.flow[mask], expected, atol=2e-3)


def test_flow_of_cloth_is_its_motion() -> None:
    cloth = Cloth("sheet", (0.0, 0.0, 0.4), (1.4, 1.2, 0.0), resolution=9)
    scene = scene_of(body("box", at=(9.0, 9.0, 0.0)), cloths=[cloth])
    sheet = flat_sheet(cloth)
    matrix = np.eye(3) + 0.1 * np.random.default_rng(5).standard_normal((3, 3))
    shift = np.array([0.03, -0.05, 0.04])
    positions = np.repeat([[scene.bodies[0].position]], 2, axis=0)
    trajectory = trajectory_of(positions, None, np.array([sheet, sheet @ matrix.T + shift]))
    frame = Renderer(scene, trajectory).render(0, EXACT)
    assert frame.ids is not None and frame.flow is not None
    mask = frame.ids == 2
    assert mask.sum() > 2500
    expected = expected_flow(scene, frame, seen_points(scene, frame) @ matrix.T + shift)[mask]
    assert np.abs(expected).max() > 3.0
    np.testing.assert_allclose(frame.flow[mask], expected, atol=2e-3)


def test_flow_leads_to_the_same_object_in_the_next_frame() -> None:
    scene, trajectory = tumbling()
    renderer = Renderer(scene, trajectory)
    now, later = renderer.render(0, EXACT), renderer.render(1, EXACT)
    assert now.ids is not None and now.flow is not None and later.ids is not None
    target = np.floor(pixel_centers(256, 256) + now.flow).astype(int)
    inside = ((target >= 0) & (target < 256)).all(-1) & (now.ids > 0) & inner(now.ids)
    there = later.ids[target[inside][:, 1], target[inside][:, 0]]
    assert (there == now.ids[inside]).mean() > 0.98
    unmoved = later.ids[inside]
    assert (unmoved == now.ids[inside]).mean() < 0.95


def test_flow_of_resting_objects_and_of_the_last_frame_is_zero() -> None:
    scene, trajectory = tumbling()
    renderer = Renderer(scene, trajectory)
    first, last = renderer.render(0, EXACT), renderer.render(-1, EXACT)
    assert first.ids is not None and first.flow is not None and last.flow is not None
    still = (first.ids == 0) | (first.ids == 3)
    assert still.any() and not still.all()
    assert not first.flow[still].any()
    assert first.flow[~still].any()
    assert not last.flow.any()


@pytest.mark.parametrize("height", [1.3, 0.1])
def test_cloth_is_seen_from_both_sides_and_faces_the_camera(height: float) -> None:
    camera = Camera((2.0, 0.3, height), (0.0, 0.0, 0.5))
    cloth = Cloth("sheet", (0.0, 0.0, 0.6), (1.0, 1.0, 0.0), resolution=5)
    scene = scene_of(body("box", at=(9.0, 9.0, 0.0)), cloths=[cloth], camera=camera)
    frame = render(scene)
    assert frame.ids is not None and frame.normals is not None
    mask = frame.ids == 2
    assert mask.sum() > 1000
    up = 1.0 if height > 0.6 else -1.0
    np.testing.assert_allclose(frame.normals[mask], [[0, 0, up]] * mask.sum(), atol=1e-6)


def test_faces_seen_from_behind_are_culled() -> None:
    enclosing = body("enclosing", "cube", (2.4, 1.9, 0.8), scale=(1.0, 1.0, 1.0))
    frame = render(scene_of(enclosing, body("other", at=(0.0, 0.0, 0.0))))
    assert frame.ids is not None
    assert not (frame.ids == 1).any()
    assert (frame.ids == 2).any()


@pytest.mark.parametrize("name", [n for n in shapes.names() if not n.startswith("test:")])
def test_every_shape_is_closed(name: str) -> None:
    """Culling the back faces of a closed mesh that is wound outwards changes no depth."""
    mesh = shape(name).mesh
    view = View(Camera((2.2, 1.4, 1.6), (0.0, 0.0, 0.4)), 128, 128)
    homogeneous = mesh.vertices @ view.to_pixels[:, :3].T + view.to_pixels[:, 3]
    faces = np.asarray(mesh.faces, np.int32)
    pictures = []
    for two_sided in (False, True):
        ids = np.full((128, 128, len(SAMPLES)), NOTHING, np.int32)
        inverse = np.zeros(ids.shape, np.float32)
        sides = np.full(len(faces), two_sided)
        triangles = Triangles(faces, sides, np.zeros((len(faces), 3, 3)))
        buffer = VisibilityBuffer(ids, inverse, np.zeros(ids.shape[:2], bool))
        rasterize(homogeneous, triangles, 0, DepthRange(0.1, 100.0), buffer)
        pictures.append(inverse)
    assert (pictures[0] > 0).sum() > 2000
    np.testing.assert_allclose(pictures[0], pictures[1], atol=1e-6)
    scene = scene_of(body("it", name))
    frame = render(scene)
    assert frame.ids is not None and frame.normals is not None
    assert (frame.ids == 1).sum() > 1000
    np.testing.assert_allclose(np.linalg.norm(frame.normals[frame.ids == 1], axis=-1), 1, atol=1e-5)


def test_a_triangle_through_the_camera_plane_hides_what_is_behind_it() -> None:
    """One corner behind the camera: the visible part still has the depth of its plane."""
    view = View(Camera((0.0, 0.0, 1.0), (1.0, 0.0, 1.0)), 64, 64)
    corners = np.array([[-3.0, 0.0, 0.5], [5.0, -4.0, 0.5], [5.0, 4.0, 0.5]])
    homogeneous = corners @ view.to_pixels[:, :3].T + view.to_pixels[:, 3]
    ids = np.full((64, 64, 1), NOTHING, np.int32)
    inverse = np.zeros(ids.shape, np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    triangles = Triangles(faces, np.ones(1, bool), np.zeros((1, 3, 3)))
    buffer = VisibilityBuffer(ids, inverse, np.zeros(ids.shape[:2], bool))
    rasterize(homogeneous, triangles, 0, DepthRange(0.1, 100.0), buffer)
    eye = np.array([0.0, 0.0, 1.0])
    ray = unproject(view, pixel_centers(64, 64), np.ones((64, 64))) - eye
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -0.5 / ray[..., 2]
        hit = eye + ray * depth[..., None]
    inside = (depth > 0.1) & (hit[..., 0] < 5) & (np.abs(hit[..., 1]) < (hit[..., 0] + 3) / 2)
    sure = inner(inside)
    np.testing.assert_array_equal((ids[..., 0] == 0)[sure], inside[sure])
    assert inside[-1].all()
    np.testing.assert_allclose(1 / inverse[inside & sure, 0], depth[inside & sure], atol=1e-4)
