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
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.numerics.rotations import rotate_vectors
from physion.physics.rigid.bodies import collision_hulls, hull_mass
from physion.rendering.camera import intrinsics, view_matrix
from physion.scenes.scene import FRAME_TIME, Body, Cloth, SurfaceMaterial, Vec3
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
    scene, motion = trial.scene, trial.trajectory
    masses = [
        hull_mass([piece.corners for piece in collision_hulls(b.shape, b.scale)], b.mass)
        for b in scene.bodies
    ]
    centers = np.array([mass.center for mass in masses]).reshape(-1, 3)
    arms = rotate_vectors(motion.rotations.astype(np.float64), centers)
    rigid = motion.positions + arms
    sheets = [part.mean(axis=1, dtype=np.float64) for part in _cloth_parts(trial)]
    return np.concatenate([rigid, *(s[:, None] for s in sheets)], axis=1).astype(np.float32)


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
