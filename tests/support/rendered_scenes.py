"""Small scenes with hand-made motion for the renderer's tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from physion.physics.trajectory import Contacts, Trajectory
from physion.scenes.scene import Body, Camera, Cloth, Look, Roles, Scene, Vec3
from physion.scenes.shapes.meshes import Mesh
from physion.scenes.shapes.primitives import Shape, shapes

CAMERA = Camera((2.4, 1.9, 1.3), (0.0, 0.0, 0.4))
ALL = ("color", "depth", "normals", "ids", "flow")


@cache
def _fine_sphere() -> Shape:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    vertices = np.asarray(ball.vertices) + np.array([0.0, 0.0, 0.5])
    mesh = Mesh(vertices, np.asarray(ball.faces, np.int32), math.radians(40))
    return Shape("test:fine_sphere", mesh, ())


shapes.register("test:fine_sphere")(_fine_sphere)


def scene_of(
    *bodies: Body,
    cloths: Sequence[Cloth] = (),
    camera: Camera = CAMERA,
    room: str = "empty",
) -> Scene:
    """A scene of these bodies; the first and the last are agent and patient."""
    names = [body.name for body in bodies] + [cloth.name for cloth in cloths]
    return Scene(
        name="test",
        scenario="test",
        bodies=tuple(bodies),
        roles=Roles(agent=names[0], patient=names[-1]),
        camera=camera,
        cloths=tuple(cloths),
        room=room,
    )


def body(name: str, shape: str = "cube", at: Vec3 = (0.0, 0.0, 0.0), **more: object) -> Body:
    """A body in tinted cedar."""
    more.setdefault("look", Look((0.8, 0.2, 0.2), "wood_cedar"))
    return Body(name, shape, at, **more)  # type: ignore[arg-type]


def trajectory_of(
    positions: ArrayLike, rotations: ArrayLike | None = None, cloth: ArrayLike | None = None
) -> Trajectory:
    """A trajectory of these poses (F, N, 3), (F, N, 4) and cloth vertices (F, V, 3)."""
    at = np.asarray(positions, np.float32)
    frames, bodies = at.shape[:2]
    turned = np.zeros((frames, bodies, 4), np.float32)
    turned[..., 0] = 1.0
    if rotations is not None:
        turned = np.asarray(rotations, np.float32)
    sheet = np.zeros((frames, 0, 3)) if cloth is None else cloth
    still = np.zeros_like(at)
    return Trajectory(
        positions=at,
        rotations=turned,
        velocities=still,
        angular_velocities=still,
        cloth_vertices=np.asarray(sheet, np.float32),
        cloth_distance=np.full(frames, np.nan, np.float32),
        contacts=Contacts.empty(),
        completed=True,
        engine="by hand",
    )


def resting(scene: Scene, frames: int = 1) -> Trajectory:
    """A trajectory in which nothing moves; cloths lie flat where they start."""
    positions = np.array([[b.position for b in scene.bodies]] * frames).reshape(frames, -1, 3)
    rotations = np.array([[b.rotation for b in scene.bodies]] * frames).reshape(frames, -1, 4)
    sheets = [flat_sheet(cloth) for cloth in scene.cloths]
    sheet = np.concatenate(sheets) if sheets else np.zeros((0, 3))
    return trajectory_of(positions, rotations, np.repeat(sheet[None], frames, axis=0))


def flat_sheet(cloth: Cloth) -> np.ndarray:
    """Vertices (V, 3) of a cloth as it starts, row by row along x then y."""
    steps = np.linspace(-0.5, 0.5, cloth.resolution)
    x, y = np.meshgrid(steps * cloth.size[0], steps * cloth.size[1], indexing="ij")
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3) + cloth.position


def tumbling(frames: int = 3) -> tuple[Scene, Trajectory]:
    """Two bodies that fly and turn over a moving cloth, in the box room, with a still zone."""
    cloth = Cloth(
        "sheet", (0.0, 0.0, 0.25), (1.2, 1.2, 0.0), resolution=12, look=Look(texture="cloth")
    )
    bodies = (
        body("ball", "sphere", (0.3, 0.2, 0.5), scale=(0.4, 0.4, 0.4)),
        body("block", "cube", (-0.3, 0.1, 0.6), scale=(0.3, 0.2, 0.5)),
        body("zone", "cube", (0.5, -0.6, 0.0), scale=(1.0, 0.8, 0.01), kinematic=True),
    )
    scene = scene_of(*bodies, cloths=[cloth], room="box")
    rng = np.random.default_rng(3)
    start = np.array([b.position for b in bodies])
    velocity = rng.uniform(-0.04, 0.04, (3, 3))
    velocity[2] = 0.0
    time = np.arange(frames)[:, None, None]
    rotations = np.zeros((frames, 3, 4))
    angle = 0.12 * np.arange(frames)
    rotations[:, :, 0] = np.cos(angle)[:, None]
    rotations[:, :2, 1:] = np.sin(angle)[:, None, None] * np.array([0.6, 0.0, 0.8])
    rotations[:, 2] = (1.0, 0.0, 0.0, 0.0)
    sheet = flat_sheet(cloth)
    waves = [sheet + [0, 0, 1] * (0.05 * np.sin(4 * sheet[:, :1] + i)) for i in range(frames)]
    return scene, trajectory_of(start + time * velocity, rotations, np.array(waves))
