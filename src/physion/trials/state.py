"""What the paper gives out as the state of a trial, each by one function of the `Trial`.

Metres, kilograms, seconds and radians; z up, right-handed axes, quaternions (w, x, y, z). F frames,
N things in the order of `Scene.names` (rigid bodies, then cloths), B rigid bodies. Frame f shows
the time f * `FRAME_TIME`. Everything here is worked out from the trial file alone, the future
included: nothing of it may reach who predicts.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.numerics.rotations import rotate_vectors
from physion.physics.cloth.sheet import sheet_triangles, sheet_vertices
from physion.physics.particles import Particles, particles_over_time
from physion.physics.rigid.hulls import collision_hulls
from physion.physics.rigid.mass import hull_mass
from physion.physics.trajectory import ENVIRONMENT
from physion.rendering.camera import intrinsics, view_matrix
from physion.scenes.scene import FRAME_TIME, Body, Cloth, Scene, SurfaceMaterial, Vec3
from physion.scenes.shapes.primitives import shape
from physion.trials.trial_file import Trial

Floats = NDArray[np.float32]
Matrix = NDArray[np.float64]
Mask = NDArray[np.bool_]

FLOOR = "floor"
"""What contacts call the environment."""


class Poses(NamedTuple):
    """``positions`` (F, B, 3) of the pivots and ``rotations`` (F, B, 4), unit quaternions."""

    positions: Floats
    rotations: Floats


class Velocities(NamedTuple):
    """``linear`` (F, B, 3) of centres of mass, m/s; ``angular`` (F, B, 3), world axes, rad/s."""

    linear: Floats
    angular: Floats


@dataclass(frozen=True)
class PairContacts:
    """Touches of two things, one row for each frame with a touch, at the deepest point.

    ``frame`` (C,); ``point`` (C, 3) metres, world; ``normal`` (C, 3) unit, from the first thing to
    the second; ``impulse`` (C,) newton seconds along the normal during the frame.
    """

    frame: NDArray[np.int32]
    point: Floats
    normal: Floats
    impulse: Floats


@dataclass(frozen=True)
class ThingMesh:
    """The drawn surface of a body or cloth.

    ``vertices`` (V, 3) in the shape's frame at unit scale, metres; ``scaled`` (V, 3) the same
    stretched by the body's scale, before its pose; ``faces`` (T, 3) indices of vertices,
    counter-clockwise as seen from outside. A cloth's vertices are those of its undeformed sheet
    about its centre, scaled or not; `world_vertices` has them as they move.
    """

    vertices: Matrix
    scaled: Matrix
    faces: NDArray[np.int32]


def centroids(trial: Trial) -> Floats:
    """Centres of mass (F, N, 3), metres, world: of cloths the mean of their vertices.

    A body's is that of its collision pieces, as the engine moves it (`Velocities.linear`).
    """
    scene, motion = trial.scene, trial.trajectory
    masses = [
        hull_mass([piece.corners for piece in collision_hulls(b.shape, b.scale)], b.mass)
        for b in scene.bodies
    ]
    own = np.array([mass.center for mass in masses]).reshape(-1, 3)
    arms = rotate_vectors(motion.rotations.astype(np.float64), own)
    rigid = motion.positions + arms
    sheets = [part.mean(axis=1, dtype=np.float64) for part in _cloth_parts(trial)]
    return np.concatenate([rigid, *(s[:, None] for s in sheets)], axis=1).astype(np.float32)


def poses(trial: Trial) -> Poses:
    """Where the rigid bodies are and how they are turned."""
    return Poses(trial.trajectory.positions, trial.trajectory.rotations)


def velocities(trial: Trial) -> Velocities:
    """How fast the rigid bodies move and turn."""
    return Velocities(trial.trajectory.velocities, trial.trajectory.angular_velocities)


def contacts_between(trial: Trial, a: str, b: str) -> PairContacts:
    """Contact points and normals of the things called ``a`` and ``b``, normals from a to b.

    `FLOOR` names the environment. `BadSceneError` for a name that the scene does not hold.
    """
    first, second = (_number(trial.scene, name) for name in (a, b))
    contacts = trial.trajectory.contacts
    rows = (contacts.bodies == np.sort([first, second])).all(axis=1)
    sign = np.float32(1 if first <= second else -1)
    return PairContacts(
        contacts.frame[rows],
        contacts.point[rows],
        sign * contacts.normal[rows],
        contacts.impulse[rows],
    )


def environment_contacts(trial: Trial) -> dict[str, PairContacts]:
    """Touches of the floor by the name of the thing that touches it; normals point off the floor.

    Things that never touch it are left out.
    """
    pairs = trial.trajectory.contacts.bodies
    touching = np.unique(pairs[(pairs == ENVIRONMENT).any(axis=1)].max(axis=1, initial=ENVIRONMENT))
    names = trial.scene.names()
    return {names[i]: contacts_between(trial, FLOOR, names[i]) for i in touching if i >= 0}


def contact_table(trial: Trial) -> pd.DataFrame:
    """All contacts, one row each: frame, time (s), first, second, point_*, normal_*, impulse (N s).

    ``first`` and ``second`` are names, the environment `FLOOR`; the normal goes from first to
    second.
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
    """The drawn surface of every thing by name."""
    found = {}
    for body in trial.scene.bodies:
        mesh = shape(body.shape).mesh
        scaled = mesh.moved(body.scale).vertices
        found[body.name] = ThingMesh(mesh.vertices.copy(), scaled, mesh.faces.copy())
    for cloth in trial.scene.cloths:
        flat = sheet_vertices(cloth) - np.asarray(cloth.position)
        found[cloth.name] = ThingMesh(flat, flat, sheet_triangles(cloth.resolution).copy())
    return found


def world_vertices(trial: Trial, frame: int) -> dict[str, Matrix]:
    """Where the vertices (V, 3) of every thing's mesh are in one frame, metres, world."""
    _check_frame(trial, frame)
    motion, shapes = trial.trajectory, meshes(trial)
    found = {}
    for i, body in enumerate(trial.scene.bodies):
        turn = motion.rotations[frame, i].astype(np.float64)
        found[body.name] = (
            rotate_vectors(turn, shapes[body.name].scaled) + motion.positions[frame, i]
        )
    for cloth, part in zip(trial.scene.cloths, _cloth_parts(trial), strict=True):
        found[cloth.name] = part[frame].astype(np.float64)
    return found


def particles(
    trial: Trial, spacing: float | None = None, frames: Sequence[int] | None = None
) -> Particles:
    """Particles of all that moves or is touched; see `particles_over_time`."""
    return particles_over_time(trial.scene, trial.trajectory, spacing, frames)


def object_table(trial: Trial, look: str | None = None) -> pd.DataFrame:
    """One row a thing, by `Scene.names`: what it is, looks like, weighs, and how it rubs.

    Columns: name, kind (``body`` or ``cloth``), shape, scale_x, scale_y, scale_z (factors; a
    cloth's sides in metres), red, green, blue (sRGB, 0..1), texture, mass (kg), static_friction,
    dynamic_friction, restitution (NaN for cloth: the solver has its own), kinematic, scenery, role
    (``agent``, ``patient``, ``probe``, joined by ``+``, or empty). Colours are those of ``look``,
    by default the one that the trial's movies show.
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
    """Camera coordinates to homogeneous pixels, (3, 3), as the renderer projects.

    ``[u w, v w, w] = K [x, y, z]`` with camera axes x right, y down, z forward (as OpenCV's), u to
    the right and v down from the picture's upper left corner, w the depth in metres; the centre of
    the first pixel is (0.5, 0.5). For pictures of the trial's own size, or of the given one.
    """
    meta = trial.metadata
    return intrinsics(trial.scene.camera, width or meta.width, height or meta.height)


def camera_extrinsics(trial: Trial) -> Matrix:
    """World to camera coordinates, (4, 4), for column vectors (x, y, z, 1); the same in all frames.

    Camera axes are x right, y down, z forward. The inverse is the camera's pose in the world.
    """
    return view_matrix(trial.scene.camera)


def role_masks(trial: Trial, frame: int) -> tuple[Mask, Mask]:
    """Pixels (H, W) that show the agent, and those that show the patient, in one frame.

    One exact sample at each pixel's centre; what is hidden behind others is not in a mask.
    """
    _check_frame(trial, frame)
    ids = trial.render(frame, ("ids",)).ids
    assert ids is not None, "the renderer left out ids"
    roles, scene = trial.scene.roles, trial.scene
    return ids == scene.index(roles.agent) + 1, ids == scene.index(roles.patient) + 1


def pushes(trial: Trial) -> pd.DataFrame:
    """One row a push: frame and time (s) just before whose step it acts, body, impulse_* (N s),
    point_* (m, world; NaN for a push on the centre of mass), and speed (m/s) that it would give to
    the free body."""
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


def scenario_parameters(trial: Trial) -> dict[str, Any]:
    """What the sampler drew, or the importer found, for this trial: a copy, JSON values only."""
    return copy.deepcopy(dict(trial.scene.parameters))


def _cloth_parts(trial: Trial) -> list[Floats]:
    """The vertices (F, V, 3) of each cloth."""
    counts = [cloth.resolution**2 for cloth in trial.scene.cloths]
    ends = np.cumsum(counts)
    vertices = trial.trajectory.cloth_vertices
    return [vertices[:, end - count : end] for count, end in zip(counts, ends, strict=True)]


def _number(scene: Scene, name: str) -> int:
    return ENVIRONMENT if name == FLOOR and FLOOR not in scene.names() else scene.index(name)


def _check_frame(trial: Trial, frame: int) -> None:
    if not 0 <= frame < trial.metadata.frames:
        raise BadInputError(
            f"trial {trial.metadata.trial!r} has no frame {frame} of {trial.metadata.frames}"
        )
