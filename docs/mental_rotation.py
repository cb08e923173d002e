"""Draw the picture of the question of mental rotation that ships for studies.

    python docs/mental_rotation.py

A figure of ten cubes stands above four others. One of them is the same figure turned; the others
are its mirror image, turned. `RIGHT` is the right one.
"""

from __future__ import annotations

from itertools import permutations, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from physion.numerics.rotations import rotate_vectors
from physion.physics.trajectory import Contacts, Trajectory
from physion.rendering.renderer import Frame, Renderer
from physion.scenes.scene import Body, Camera, Look, Roles, Scene

PICTURE = (
    Path(__file__).parents[1]
    / "src/physion/experiment/questions/mental_rotation/mental_rotation.png"
)
CUBES = np.array(
    [
        *((0, -2, 0), (0, -1, 0), (0, 0, 0)),
        *((1, 0, 0), (2, 0, 0), (3, 0, 0)),
        *((3, 0, 1), (3, 0, 2)),
        *((3, 1, 2), (3, 2, 2)),
    ],
    dtype=np.float64,
)
"""Centres (10, 3) of the cubes of the figure: four arms with three bends."""
VIEW = (30.0, 25.0, -30.0)
"""Turn of the upper figure about x, y and z, in degrees."""
OPTIONS = {
    "a": (True, (105.0, 20.0, -105.0)),
    "b": (True, (-90.0, -15.0, 40.0)),
    "c": (False, (110.0, -75.0, -50.0)),
    "d": (True, (160.0, -35.0, -30.0)),
}
"""Whether each option is the mirror image, and its turn."""
RIGHT = next(name for name, (mirrored, _) in OPTIONS.items() if not mirrored)
SIZE, GAP, MARGIN = 240, 16, 44
BACKGROUND = (255, 255, 255)


def is_chiral(cubes: NDArray[np.float64]) -> bool:
    """Return whether no turn takes the figure to its mirror image."""

    def placed(points: NDArray[np.float64]) -> set[tuple[int, ...]]:
        return {tuple(row) for row in np.rint(points - points.min(axis=0)).astype(int).tolist()}

    mirrored = placed(cubes * [-1, 1, 1])
    for axes, signs in product(permutations(range(3)), product((-1, 1), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), axes] = signs
        if np.linalg.det(turn) > 0 and placed(cubes @ turn.T) == mirrored:
            return False
    return True


def render_figure(mirrored: bool, turn: tuple[float, float, float], size: int) -> Frame:
    """Return colours and ids of the figure, or of its mirror image, turned by angles in degrees."""
    cubes = CUBES * [-1, 1, 1] if mirrored else CUBES
    cubes = cubes - cubes.mean(axis=0)
    x, y, z, w = Rotation.from_euler("xyz", turn, degrees=True).as_quat()
    quaternion = np.array([w, x, y, z])
    height = 40.0  # far above the floor, which is not seen
    side = 0.97  # so that edges between cubes are seen
    centres = rotate_vectors(quaternion, cubes) + np.array([0.0, 0.0, height])
    below = rotate_vectors(quaternion, np.array([0.0, 0.0, -side / 2]))
    bodies = tuple(
        Body(
            f"cube_{i}",
            "cube",
            (0.0, 0.0, 0.0),
            (side,) * 3,
            look=Look((0.55, 0.68, 0.85), "plain"),
        )
        for i in range(len(cubes))
    )
    scene = Scene(
        name="figure",
        scenario="support",
        bodies=bodies,
        roles=Roles("cube_0", "cube_1"),
        camera=Camera((0.0, -15.0, height + 4.0), (0.0, 0.0, height), fov=0.48),
        room="empty",
    )
    count = len(bodies)
    still = np.zeros((1, count, 3), np.float32)
    motion = Trajectory(
        positions=(centres + below).astype(np.float32)[None],
        rotations=np.tile(quaternion, (1, count, 1)).astype(np.float32),
        velocities=still,
        angular_velocities=still,
        cloth_vertices=np.zeros((1, 0, 3), np.float32),
        cloth_distance=np.full(1, np.nan, np.float32),
        contacts=Contacts.empty(),
        completed=True,
        engine="placed",
    )
    return Renderer(scene, motion, size, size).render(0, ("color", "ids"))


def draw_figure(mirrored: bool, turn: tuple[float, float, float], size: int) -> Image.Image:
    """Return a picture of the figure, or of its mirror image, on white."""
    frame = render_figure(mirrored, turn, 2 * size)
    assert frame.color is not None and frame.ids is not None
    color = np.where(frame.ids[..., None] > 0, frame.color, np.uint8(255))
    return Image.fromarray(color).resize((size, size), Image.Resampling.LANCZOS)


def draw(size: int = SIZE) -> Image.Image:
    """Return the whole picture: the figure, and below it the options with their letters."""
    width = len(OPTIONS) * (size + GAP) - GAP
    picture = Image.new("RGB", (width, 2 * size + MARGIN), BACKGROUND)
    picture.paste(draw_figure(False, VIEW, size), ((width - size) // 2, 0))
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=size // 9)
    for place, (name, (mirrored, turn)) in enumerate(OPTIONS.items()):
        left = place * (size + GAP)
        picture.paste(draw_figure(mirrored, turn, size), (left, size))
        middle = (left + size // 2, 2 * size + MARGIN // 2)
        pen.text(middle, name.upper(), fill=(30, 30, 30), font=font, anchor="mm")
    return picture


if __name__ == "__main__":
    assert is_chiral(CUBES)
    draw().save(PICTURE, optimize=True)
    print(f"{PICTURE}: the right answer is {RIGHT}")
