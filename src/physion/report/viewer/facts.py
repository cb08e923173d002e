"""Facts about a trial for the viewer: the card, the marks of the time line, the tables."""

from __future__ import annotations

import base64
import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from physion.core.settings import flatten
from physion.numerics.rotations import rotate_vectors
from physion.physics.labels import Labels, contact_frames, label_contact
from physion.report.viewer.movies import thing_colors
from physion.scenes.scene import Scene
from physion.scenes.shapes.primitives import shape
from physion.trials.making.pairs import Pair
from physion.trials.making.plan import PAIR
from physion.trials.share.gltf import role_of
from physion.trials.state import outside_picture
from physion.trials.trial_file import Trial

Table = dict[str, Any]
"""``title``; ``header`` or none; ``rows`` of text; ``outcome`` lists rows that give the answer
away, by number."""

_NAMES = {
    "physics_seconds": "seconds of physics",
    "playback_seconds": "seconds of playback",
    "first_frame": "first frame of contact",
    "observed": "contact while observed",
    "min_distance": "smallest gap to the cloth (m)",
    "robust": "fraction of jittered runs that agree",
    "frame_time": "seconds of physics per frame",
    "playback_rate": "frames of movie per second",
    "completed": "everything came to rest",
    "digest": "digest of the motion",
    "scene_digest": "digest of the scene",
}
"""Labels of fields whose names are not readable."""
_OUTCOME = ("contact", "first_frame", "observed", "min_distance", "robust", "recorded_contact")

_IMPOSSIBLE = ("world before", "world after", "possible")


def labels_of(trial: Trial) -> Labels:
    """Return the labels of a trial, from its motion if it is stored without labels."""
    return trial.labels or label_contact(trial.scene, trial.trajectory)


def card(trial: Trial, unusable: str = "") -> dict[str, Any]:
    """Return what the grid shows and filters by; ``unusable``: why the trial is, if it is."""
    meta, labels = trial.metadata, labels_of(trial)
    robust = labels.robust
    return {
        "trial": meta.trial,
        "scenario": meta.scenario,
        "split": meta.split,
        "preset": meta.preset or "",
        "contact": labels.contact,
        "firstContact": labels.first_frame,
        "observed": labels.observed,
        "robust": robust if robust is not None and math.isfinite(robust) else None,
        "frames": meta.frames,
        "observedFrames": meta.observed_frames,
        "rate": meta.playback_rate,
        "frameTime": meta.frame_time,
        "outside": sorted(outside_picture(trial)),
        "unusable": unusable,
        "pair": _pair_text(trial),
        "searchText": _search_text(trial),
    }


def _pair_text(trial: Trial) -> str:
    """Return kind of a movie of a pair, and whether it is possible; empty for other trials."""
    pair = Pair.of(trial.scene)
    if pair is None:
        return ""
    kept = "possible" if pair.possible else f"impossible at frame {pair.start}"
    return f"{pair.kind}: {kept}{', behind a screen' if pair.hidden else ''}"


def _search_text(trial: Trial) -> str:
    """Return the text that the search looks through, in lower case."""
    meta, scene = trial.metadata, trial.scene
    parts = [meta.trial, meta.dataset, meta.scenario, meta.split, meta.preset, meta.seed]
    parts += [meta.digest, meta.scene_digest, meta.look, scene.room]
    parts += [text for body in scene.bodies for text in (body.name, body.shape, body.look.texture)]
    parts += [cloth.name for cloth in scene.cloths]
    kept = dict.fromkeys(str(part) for part in parts if not _absent(part))
    return " ".join(kept).lower()


def contact_runs(trial: Trial) -> list[list[int]]:
    """Return the frames in which agent and patient touch, as runs: first and last frame of each."""
    runs: list[list[int]] = []
    for frame in contact_frames(trial.scene, trial.trajectory).tolist():
        if runs and runs[-1][1] == frame - 1:
            runs[-1][1] = frame
        else:
            runs.append([frame, frame])
    return runs


def touches(trial: Trial) -> list[list[float]]:
    """Return the contact points of agent and patient: rows of frame, x, y, z."""
    scene, trajectory = trial.scene, trial.trajectory
    agent, patient = (scene.index(name) for name in (scene.roles.agent, scene.roles.patient))
    contacts = trajectory.contacts
    pair = (contacts.bodies == sorted((agent, patient))).all(axis=1)
    counted = np.isin(contacts.frame, contact_frames(scene, trajectory))
    rows = np.flatnonzero(pair & counted)
    points = np.round(np.nan_to_num(contacts.point[rows].astype(np.float64)), 4)
    found: list[list[float]] = [
        [int(contacts.frame[row]), *(float(v) for v in point)]
        for row, point in zip(rows, points, strict=True)
    ]
    # The page counts those up to a frame, and a file may hold them in any order.
    return sorted(found)


def paths(trial: Trial) -> dict[str, str]:
    """Return the paths of agent, patient and probe, if they move: the centre of a body's bounding
    box or of a cloth in each frame, as base64 of x, y, z in single precision.
    """
    scene, trajectory = trial.scene, trial.trajectory
    found = {}
    for role in ("agent", "patient", "probe"):
        name = getattr(scene.roles, role)
        if name is None:
            continue
        index = scene.index(name)
        if index < len(scene.bodies):
            vertices = np.asarray(shape(scene.bodies[index].shape).mesh.vertices)
            centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2 * scene.bodies[index].scale
            turns = trajectory.rotations[:, index].astype(np.float64)
            path = rotate_vectors(turns, np.tile(centre, (len(turns), 1)))
            path = path + trajectory.positions[:, index]
        else:
            sizes = [cloth.resolution**2 for cloth in scene.cloths]
            first = sum(sizes[: index - len(scene.bodies)])
            sheet = trajectory.cloth_vertices[:, first : first + sizes[index - len(scene.bodies)]]
            path = sheet.mean(axis=1)
        if np.any(path != path[0]):
            values = np.nan_to_num(path).astype("<f4")
            found[role] = base64.b64encode(values.tobytes()).decode("ascii")
    return found


def legend(scene: Scene) -> list[dict[str, Any]]:
    """Return name, role and colour (0..255) in the picture of ids of everything in the scene."""
    colors = thing_colors(scene)
    return [
        {"name": name, "role": role_of(scene, name), "color": list(color)}
        for name, color in zip(scene.names(), colors, strict=True)
    ]


def tables(trial: Trial) -> list[Table]:
    """Return tables of the scene, the settings and the outcome of a trial."""
    scene = trial.scene
    parameters = {name: value for name, value in scene.parameters.items() if name != PAIR}
    result = [
        _bodies_table(scene),
        _cloths_table(scene),
        _pushes_table(scene),
        _table("Joints", ("parent", "child"), [(j.parent, j.child) for j in scene.joints]),
        _trial_table(trial),
        _pair_table(scene),
        _table("Parameters of the scenario", None, list(flatten(parameters, lists=True).items())),
        _stage_table(scene),
    ]
    return [table for table in result if table["rows"]]


def _table(title: str, header: Sequence[str] | None, rows: Iterable[Sequence[object]]) -> Table:
    texts = [[text(value) for value in row] for row in rows]
    return {"title": title, "header": list(header) if header else None, "rows": texts}


def _trial_table(trial: Trial) -> Table:
    """Return times and labels first, then the other metadata in the order of the file."""
    meta, labels = trial.metadata, labels_of(trial)
    facts: dict[str, object] = {
        "physics_seconds": meta.physics_seconds,
        "playback_seconds": meta.playback_seconds,
    }
    facts |= {f.name: getattr(labels, f.name) for f in dataclasses.fields(labels)}
    facts |= {f.name: getattr(meta, f.name) for f in dataclasses.fields(meta)}
    rows = [(_NAMES.get(name, name.replace("_", " ")), value) for name, value in facts.items()]
    table = _table("Trial", None, rows)
    return table | {"outcome": [i for i, name in enumerate(facts) if name in _OUTCOME]}


def _pair_table(scene: Scene) -> Table:
    """Return what a movie of a pair says of itself; no rows for other trials."""
    pair = Pair.of(scene)
    if pair is None:
        return _table("Pair", None, [])
    facts = {
        "kind": pair.kind,
        "trial of both worlds": pair.base,
        "body": pair.body,
        "behind a screen": pair.hidden,
        "first frame of the second world": pair.start,
        "world before": "AB"[pair.first],
        "world after": "AB"[pair.then],
        "possible": pair.possible,
    }
    rows = _table("Pair", None, list(facts.items()))
    return rows | {"outcome": [i for i, name in enumerate(facts) if name in _IMPOSSIBLE]}


def _bodies_table(scene: Scene) -> Table:
    header = ["body", "role", "shape", "mass (kg)", "static friction", "dynamic friction"]
    header += ["restitution", "scale", "position (m)", "kind", "colour", "texture"]
    rows = []
    for body in scene.bodies:
        kind = "scenery" if body.scenery else "fixed" if body.kinematic else "free"
        touch = body.contact
        rows.append(
            [
                *(body.name, role_of(scene, body.name), body.shape, body.mass),
                *(touch.static_friction, touch.dynamic_friction, touch.restitution),
                *(body.scale, body.position, kind, _hex(body.look.color), body.look.texture),
            ]
        )
    return _table("Bodies", header, rows)


def _cloths_table(scene: Scene) -> Table:
    header = ["cloth", "role", "mass (kg)", "size (m)", "position (m)", "resolution"]
    header += ["stretch", "bend", "tether", "colour", "texture"]
    rows = [
        [
            *(c.name, role_of(scene, c.name), c.mass, c.size, c.position, c.resolution),
            *(c.stretch, c.bend, c.tether, _hex(c.look.color), c.look.texture),
        ]
        for c in scene.cloths
    ]
    return _table("Cloths", header, rows)


def _pushes_table(scene: Scene) -> Table:
    header = ["body", "impulse (N s)", "strength (N s)", "point (m)", "before the step after frame"]
    rows = [
        [p.body, p.impulse, math.hypot(*p.impulse), p.point or "centre of mass", p.frame]
        for p in scene.pushes
    ]
    return _table("Pushes", header, rows)


def _stage_table(scene: Scene) -> Table:
    camera = scene.camera
    rows: list[tuple[str, object]] = [
        ("camera at (m)", camera.position),
        ("looks at (m)", camera.target),
        ("vertical field of view", f"{math.degrees(camera.fov):.4g} degrees"),
        ("room", scene.room),
        ("floor (m)", scene.floor),
        ("settling before frame 0", f"{scene.settle_frames} frames"),
        ("ends at rest after", f"{scene.ending.min_frames} frames"),
        ("ends at the latest after", f"{scene.ending.max_frames} frames"),
    ]
    return _table("Camera, room, ending", None, rows)


def text(value: object) -> str:
    """Return any value as readable text: numbers with four digits, a dash if absent."""
    if isinstance(value, list | tuple):
        return ", ".join(text(v) for v in value) if value else "none"
    if _absent(value):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)


def _absent(value: object) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def _hex(color: Sequence[float]) -> str:
    return "#" + "".join(f"{round(min(max(c, 0.0), 1.0) * 255):02x}" for c in color)
