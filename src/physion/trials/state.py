"""State of a trial: quantities that follow from a trial file and are not stored in it.

Every function takes an open `Trial`. Poses, velocities, contacts and parameters are stored:
`Trial.trajectory` and `Trial.scene` hold them. Units are
metres, kilograms, seconds and radians; axes are right-handed with z up; quaternions are
(w, x, y, z). In shapes, F counts frames, N all objects in the order of `Scene.names` (rigid bodies,
then cloths), and B rigid bodies. Frame f shows the time f * `FRAME_TIME`.

The results cover the whole trial, its outcome included: they must not be given to models or
participants that predict. docs/reference/trial-files.md has examples.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.numerics.elementary import arctan2
from physion.numerics.linear_algebra import norm
from physion.numerics.rotations import rotate_vectors
from physion.physics.rigid.bodies import collision_hulls, hull_mass
from physion.rendering.camera import View, intrinsics, view_matrix
from physion.scenes.scene import FRAME_TIME, Body, Cloth, Scene, SurfaceMaterial, Vec3
from physion.trials.trial_file import Trial, mesh_of

Floats = NDArray[np.float32]
Matrix = NDArray[np.float64]
Mask = NDArray[np.bool_]

FLOOR = "floor"
"""Name of the environment in contacts."""


@dataclass(frozen=True)
class ThingMesh:
    """Rendered surface of a body or cloth.

    - ``vertices``: (V, 3) in metres, in the frame of the shape at unit scale. For a cloth: the
      undeformed sheet about its centre.
    - ``scaled``: (V, 3): vertices multiplied by the body's scale, before the pose; for a cloth the
      same as ``vertices``. `world_vertices` returns the vertices as they move.
    - ``faces``: (T, 3) indices of vertices, counter-clockwise as seen from outside.
    """

    vertices: Matrix
    scaled: Matrix
    faces: NDArray[np.int32]


def centroids(trial: Trial) -> Floats:
    """Return the centres of mass (F, N, 3) in metres, world coordinates.

    `Trajectory.velocities` is the velocity of a body's centre, which its collision hulls give; the
    centre of a cloth is the mean of its vertices.
    """
    motion = trial.trajectory
    arms = rotate_vectors(motion.rotations.astype(np.float64), mass_centers(trial.scene))
    rigid = motion.positions + arms
    sheets = [part.mean(axis=1, dtype=np.float64) for part in _cloth_parts(trial)]
    return np.concatenate([rigid, *(s[:, None] for s in sheets)], axis=1).astype(np.float32)


def mass_centers(scene: Scene) -> Matrix:
    """Return the centres of mass (B, 3) of rigid bodies, from their pivots, in their own axes."""
    masses = [
        hull_mass([piece.corners for piece in collision_hulls(b.shape, b.scale)], b.mass)
        for b in scene.bodies
    ]
    return np.array([mass.center for mass in masses]).reshape(-1, 3)


def contact_table(trial: Trial) -> pd.DataFrame:
    """Return all contacts as a table with one row per pair and frame, at the deepest point.

    Columns: frame, time (s), first, second (names in the order of `Scene.names`, `FLOOR` before
    them), point_x .. point_z (m), normal_x .. normal_z (from first to second), impulse (N s along
    the normal, during the frame).
    """
    contacts = trial.trajectory.contacts
    names = np.array([FLOOR, *trial.scene.names()], dtype=object)
    columns: dict[str, Any] = {
        "frame": contacts.frame,
        "time": contacts.frame * FRAME_TIME,
        "first": names[contacts.bodies[:, 0] + 1],
        "second": names[contacts.bodies[:, 1] + 1],
    }
    for what in ("point", "normal"):
        values = getattr(contacts, what)
        columns |= {f"{what}_{axis}": values[:, k] for k, axis in enumerate("xyz")}
    return pd.DataFrame(columns | {"impulse": contacts.impulse})


def meshes(trial: Trial) -> dict[str, ThingMesh]:
    """Return the rendered surface of every object by name."""
    found = {}
    for body in trial.scene.bodies:
        vertices, faces = mesh_of(body)
        found[body.name] = ThingMesh(
            vertices.copy(), vertices * np.asarray(body.scale), faces.copy()
        )
    for cloth in trial.scene.cloths:
        flat, faces = mesh_of(cloth)
        found[cloth.name] = ThingMesh(flat, flat, faces.copy())
    return found


def world_vertices(trial: Trial, frame: int) -> dict[str, Matrix]:
    """Return the mesh vertices (V, 3) of every object in one frame, metres, world coordinates."""
    _check_frame(trial, frame)
    motion, shapes = trial.trajectory, meshes(trial)
    found = {}
    for i, body in enumerate(trial.scene.bodies):
        rotation = motion.rotations[frame, i].astype(np.float64)
        found[body.name] = (
            rotate_vectors(rotation, shapes[body.name].scaled) + motion.positions[frame, i]
        )
    for cloth, part in zip(trial.scene.cloths, _cloth_parts(trial), strict=True):
        found[cloth.name] = part[frame].astype(np.float64)
    return found


def outside_picture(trial: Trial, frame: int = 0) -> dict[str, float]:
    """Return which objects reach beyond the edges of the picture in one frame, and how far.

    Values are fractions of an object's vertices outside the picture or behind the camera; objects
    that are wholly inside are left out, and so is scenery.
    """
    view = View(trial.scene.camera, trial.metadata.width, trial.metadata.height)
    scenery = {body.name for body in trial.scene.bodies if body.scenery}
    size = np.array([view.width, view.height])
    found = {}
    for name, vertices in world_vertices(trial, frame).items():
        if name in scenery or not np.isfinite(vertices).all():
            continue
        pixels, depth = view.project(vertices)
        inside = ((pixels >= 0) & (pixels <= size)).all(axis=1) & (depth > 0)
        if not inside.all():
            found[name] = float(1 - inside.mean())
    return found


def object_table(trial: Trial, look: str | None = None) -> pd.DataFrame:
    """Return the properties of all objects, one row each, in the order of `Scene.names`.

    Columns: name, kind (``body`` or ``cloth``), shape, scale_x, scale_y, scale_z (factors; a
    cloth's sides in metres), red, green, blue (sRGB, 0..1), texture, mass (kg), static_friction,
    dynamic_friction, restitution (NaN for cloth: the solver has its own), kinematic, scenery, role
    (``agent``, ``patient``, ``probe``, joined by ``+``, or empty). Colours as in ``look``, by
    default the one that the trial's movies show.
    """
    scene = trial.shown(look)
    roles = {"agent": scene.roles.agent, "patient": scene.roles.patient, "probe": scene.roles.probe}
    rows = [_body_row(body) for body in scene.bodies] + [_cloth_row(c) for c in scene.cloths]
    table = pd.DataFrame(rows)
    table["role"] = [
        "+".join(role for role, holder in roles.items() if holder == name) for name in scene.names()
    ]
    return table


def _body_row(body: Body) -> dict[str, Any]:
    return {
        **_thing_row(body, "body", body.shape, body.scale),
        **dataclasses.asdict(body.contact),
        "kinematic": body.kinematic,
        "scenery": body.scenery,
    }


def _cloth_row(cloth: Cloth) -> dict[str, Any]:
    return {
        **_thing_row(cloth, "cloth", "sheet", cloth.size),
        **dict.fromkeys((field.name for field in dataclasses.fields(SurfaceMaterial)), np.nan),
        "kinematic": False,
        "scenery": False,
    }


def _thing_row(thing: Body | Cloth, kind: str, shape_name: str, size: Vec3) -> dict[str, Any]:
    return {
        "name": thing.name,
        "kind": kind,
        "shape": shape_name,
        **dict(zip(("scale_x", "scale_y", "scale_z"), size, strict=True)),
        **dict(zip(("red", "green", "blue"), thing.look.color, strict=True)),
        "texture": thing.look.texture,
        "mass": thing.mass,
    }


def camera_intrinsics(trial: Trial, width: int | None = None, height: int | None = None) -> Matrix:
    """Return the matrix (3, 3) from camera coordinates to homogeneous pixel coordinates.

    ``[u w, v w, w] = K [x, y, z]`` with camera axes x right, y down, z forward, as in OpenCV. u
    points right and v down from the upper left corner of the picture; the centre of the first pixel
    is (0.5, 0.5); w is the depth in metres. ``width`` and ``height`` are the size of the picture in
    pixels, by default the trial's own.
    """
    meta = trial.metadata
    return intrinsics(trial.scene.camera, width or meta.width, height or meta.height)


def camera_extrinsics(trial: Trial) -> Matrix:
    """Return the matrix (4, 4) from world to camera coordinates, for columns (x, y, z, 1).

    Camera axes are x right, y down, z forward. The inverse is the camera's pose in the world. The
    camera does not move.
    """
    return view_matrix(trial.scene.camera)


def role_masks(trial: Trial, frame: int) -> tuple[Mask, Mask]:
    """Return the masks (H, W) of the pixels that show the agent and the patient in one frame.

    Masks are sampled at pixel centres, without antialiasing; occluded parts are not included.
    """
    _check_frame(trial, frame)
    ids = trial.render(frame, ("ids",)).ids
    assert ids is not None, "the renderer left out ids"
    roles, scene = trial.scene.roles, trial.scene
    return ids == scene.index(roles.agent) + 1, ids == scene.index(roles.patient) + 1


def pushes(trial: Trial) -> pd.DataFrame:
    """Return the pushes as a table with one row per push.

    Columns: frame and time (s) of the step before which it acts, body, impulse_x .. impulse_z
    (N s), point_x .. point_z (m, world; NaN for the centre of mass), and speed (m/s) that it would
    give to a free body.
    """
    scene = trial.scene
    masses = {body.name: body.mass for body in scene.bodies}
    names = ["frame", "time", "body"]
    names += [f"{what}_{axis}" for what in ("impulse", "point") for axis in "xyz"]
    rows = [
        (
            push.frame,
            push.frame * FRAME_TIME,
            push.body,
            *push.impulse,
            *(push.point or (np.nan,) * 3),
            float(np.linalg.norm(push.impulse)) / masses.get(push.body, np.nan),
        )
        for push in scene.pushes
    ]
    return pd.DataFrame(rows, columns=[*names, "speed"])


ROLES = ("agent", "patient", "probe")
DRAWN = {
    **{
        f"drawn_{role}_{name}": (dtype, f"{what} of the {role}{unit}")
        for role in ROLES
        for name, dtype, what, unit in (
            ("shape", "string", "shape", "; cloth has none"),
            ("width", "Float64", "scale along its own x axis", ", about m"),
            ("depth", "Float64", "scale along its own y axis", ", about m"),
            ("height", "Float64", "scale along its own z axis", ", about m"),
            ("mass", "Float64", "mass", ", kg"),
            ("static_friction", "Float64", "static friction", ""),
            ("dynamic_friction", "Float64", "dynamic friction", ""),
            ("restitution", "Float64", "restitution", ""),
        )
    },
    "drawn_blocks": ("Int64", "bodies that take part, without agent, patient and probe"),
    "drawn_block_mass": ("Float64", "their mean mass, kg"),
    "drawn_block_friction": ("Float64", "their mean static friction"),
    "drawn_distance": ("Float64", "horizontal distance from agent to patient in frame 0, m"),
    "drawn_agent_lift": ("Float64", "height of the agent above the floor in frame 0, m"),
    "drawn_push_speed": ("Float64", "speed that the first push would give to a free body, m/s"),
    "drawn_push_heading": ("Float64", "direction of the first push, degrees from +x to +y"),
    "drawn_push_frame": ("Int64", "frame of the first push"),
    "drawn_cloth_stretch": ("Float64", "stiffness of the cloth against stretching, 0 to 1"),
    "drawn_cloth_bend": ("Float64", "stiffness of the cloth against bending, 0 to 1"),
    "drawn_camera_distance": ("Float64", "horizontal distance of the camera from the centre, m"),
    "drawn_camera_height": ("Float64", "height of the camera above the floor, m"),
    "drawn_camera_azimuth": ("Float64", "direction of the camera, degrees from +x to +y"),
    "drawn_room": ("string", "room"),
}
"""Type and meaning of each value of `drawn_values`, a column of the index."""


def drawn_values(scene: Scene) -> dict[str, float | int | str | None]:
    """Return the values of this scene that its preset leaves to chance, with the keys of `DRAWN`.

    `Scene.parameters` holds the ranges that they were drawn from. None: the scene has no such
    thing, for example no probe. A primitive is where its bottom face is.
    """
    roles = scene.roles
    things: dict[str, Body | Cloth] = {body.name: body for body in scene.bodies}
    things |= {cloth.name: cloth for cloth in scene.cloths}
    values: dict[str, float | int | str | None] = dict.fromkeys(DRAWN)
    named = {role: things.get(getattr(roles, role) or "") for role in ROLES}
    for role, thing in named.items():
        if thing is None:
            continue
        size = thing.scale if isinstance(thing, Body) else thing.size
        own = zip(("width", "depth", "height", "mass"), (*size, thing.mass), strict=True)
        values |= {f"drawn_{role}_{name}": value for name, value in own}
        if isinstance(thing, Body):
            surface = dataclasses.asdict(thing.contact)
            values |= {f"drawn_{role}_{name}": value for name, value in surface.items()}
            values[f"drawn_{role}_shape"] = thing.shape
    taken = {getattr(roles, role) for role in ROLES}
    blocks = [body for body in scene.bodies if not body.scenery and body.name not in taken]
    values["drawn_blocks"] = len(blocks)
    if blocks:
        values["drawn_block_mass"] = _mean([body.mass for body in blocks])
        values["drawn_block_friction"] = _mean([body.contact.static_friction for body in blocks])
    agent, patient = things[roles.agent], things[roles.patient]
    apart = np.subtract(agent.position, patient.position)[:2]
    values["drawn_distance"] = float(norm(apart))
    values["drawn_agent_lift"] = agent.position[2] - scene.floor
    if scene.pushes:
        first = scene.pushes[0]
        mass = things[first.body].mass
        values["drawn_push_speed"] = float(norm(np.array(first.impulse))) / mass
        values["drawn_push_heading"] = _degrees(*first.impulse[:2])
        values["drawn_push_frame"] = first.frame
    if scene.cloths:
        values["drawn_cloth_stretch"] = scene.cloths[0].stretch
        values["drawn_cloth_bend"] = scene.cloths[0].bend
    x, y, z = scene.camera.position
    values["drawn_camera_distance"] = float(norm(np.array([x, y])))
    values["drawn_camera_height"] = z - scene.floor
    values["drawn_camera_azimuth"] = _degrees(x, y)
    values["drawn_room"] = scene.room
    return values


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)


def _degrees(x: float, y: float) -> float:
    return math.degrees(arctan2(y, x))


def _cloth_parts(trial: Trial) -> list[Floats]:
    """Return the vertices (F, V, 3) of each cloth."""
    counts = [cloth.resolution**2 for cloth in trial.scene.cloths]
    ends = np.cumsum(counts)
    vertices = trial.trajectory.cloth_vertices
    return [vertices[:, end - count : end] for count, end in zip(counts, ends, strict=True)]


def _check_frame(trial: Trial, frame: int) -> None:
    if not 0 <= frame < trial.metadata.frames:
        raise BadInputError(
            f"trial {trial.metadata.trial!r} has no frame {frame} of {trial.metadata.frames}"
        )
