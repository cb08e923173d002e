"""A small dataset whose trials move as things can, for export to and import from official files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from physion.physics.labels import label_contact
from physion.physics.trajectory import ENVIRONMENT, Contacts, Trajectory
from physion.rendering.renderer import Renderer, role_map
from physion.scenes.looks import in_look
from physion.scenes.scene import Body, Camera, Cloth, Look, Push, Roles, Scene, SurfaceMaterial
from physion.trials.files import Metadata, TrialPaths, write_files
from physion.trials.index import build_index, write_index
from physion.trials.trial_file import TrialWriter
from physion.trials.video import encode_movie
from support.hand_made import encode_png

FRAMES, SIZE, OBSERVED = 50, 32, 45
TOUCH, PART = 46, 48
"""Frames in which agent and patient begin and cease to touch."""
RIGID, CLOTH = "collide_testing_0003", "drape_testing_0000"


def turning(rng: np.random.Generator, frames: int) -> np.ndarray:
    """Unit quaternions (F, 4) that turn about one axis."""
    axis = rng.normal(size=3)
    half = np.linspace(0.3, 2.0, frames) / 2
    return np.column_stack([np.cos(half), np.sin(half)[:, None] * axis / np.linalg.norm(axis)])


def make_scene(name: str, cloth: bool) -> Scene:
    """A pushed ball, a target, a zone, a vase behind; the target may be a cloth in its place."""
    bodies = [
        Body("ball", "sphere", (-1.0, 0.2, 0.1), (0.3, 0.3, 0.3), mass=3.0, look=Look((0, 0.5, 1))),
        Body("zone", "cube", (1.0, 0.1, 0.0), (0.5, 0.9, 0.01), mass=500.0, kinematic=True),
        Body(
            "distractor_0", "prop:vase", (-1.0, -1.5, 0.0), (0.4, 0.4, 0.7), mass=7.0, scenery=True
        ),
        Body(
            "cone", "cone", (0.0, 0.1, 0.3), (0.2, 0.3, 0.4), contact=SurfaceMaterial(0.3, 0.2, 0.1)
        ),
    ]
    stiffness = {"stretch": 0.2, "bend": 0.3, "tether": 0.9}
    sheet = Cloth("sheet", (0.2, 0.1, 0.9), (0.8, 0.8, 0.0), resolution=5, **stiffness)
    return Scene(
        name=name,
        scenario="drape" if cloth else "collide",
        bodies=tuple(bodies),
        cloths=(sheet,) if cloth else (),
        roles=Roles("sheet" if cloth else "cone", "zone", "ball"),
        camera=Camera((3.0, 1.0, 1.5), (0.1, 0.0, 0.4)),
        pushes=(Push("ball", (2.0, 0.5, 0.1), (-1.1, 0.2, 0.2), 4),),
    )


def make_trajectory(scene: Scene, touch: bool = True) -> Trajectory:
    """The zone and the vase stand, the others fly and turn; the target may touch the zone."""
    rng = np.random.default_rng(5)
    count = len(scene.bodies)
    starts = np.array([body.position for body in scene.bodies])
    moving = np.array([not (body.kinematic or body.scenery) for body in scene.bodies])
    speeds = 0.4 * rng.normal(size=(count, 3)) * moving[:, None]
    time = np.arange(FRAMES)[:, None, None] * 0.01
    rotations = np.zeros((FRAMES, count, 4))
    rotations[..., 0] = 1.0
    for body in np.flatnonzero(moving):
        rotations[:, body] = turning(rng, FRAMES)
    spins = rng.normal(size=(FRAMES, count, 3)) * moving[:, None]
    rows = [(frame, 1, 3) for frame in range(TOUCH, PART) if touch]
    rows += [(frame, 0, 3) for frame in range(10, 12)] + [(3, ENVIRONMENT, 3)]
    rows.sort()
    normals = rng.normal(size=(len(rows), 3))
    return Trajectory(
        positions=(starts + speeds * time).astype(np.float32),
        rotations=rotations.astype(np.float32),
        velocities=np.broadcast_to(speeds, (FRAMES, count, 3)).astype(np.float32),
        angular_velocities=spins.astype(np.float32),
        cloth_vertices=_cloth(scene, rng),
        cloth_distance=np.linspace(0.1, -0.02, FRAMES, dtype=np.float32)
        if scene.cloths
        else np.full(FRAMES, np.nan, np.float32),
        contacts=Contacts(
            np.array([row[0] for row in rows], np.int32),
            np.array([row[1:] for row in rows], np.int32),
            rng.normal(size=(len(rows), 3)).astype(np.float32),
            (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
            rng.uniform(size=len(rows)).astype(np.float32),
        ),
        completed=True,
        engine="by hand 1",
    )


def _cloth(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    if not scene.cloths:
        return np.zeros((FRAMES, 0, 3), np.float32)
    from physion.physics.cloth.springs import sheet_vertices

    flat = sheet_vertices(scene.cloths[0])
    wave = rng.normal(size=flat.shape) * 0.05
    return (flat + wave * np.linspace(0, 1, FRAMES)[:, None, None]).astype(np.float32)


def make_dataset(folder: Path, *, touch: bool = True) -> Path:
    """A rigid trial and one with cloth, with movies in both looks and an index.

    Without ``touch`` there is only the rigid one, in which target and zone do not touch.
    """
    for name, cloth in ((RIGID, False), (CLOTH, True))[: 1 + touch]:
        scene = make_scene(name, cloth)
        trajectory = make_trajectory(scene, touch)
        paths = TrialPaths(folder, "testing", scene.scenario, name)
        files = {}
        for look in ("redyellow", "free"):
            renderer = Renderer(in_look(scene, look), trajectory, SIZE, SIZE)
            color = np.stack([frame.color for frame in renderer.frames()])
            prefix = "free_" if look == "free" else ""
            files[f"{prefix}movie"] = encode_movie(color)
            files[f"{prefix}observed_movie"] = encode_movie(color[:OBSERVED])
        ids = renderer.render(0, ("ids",)).ids
        metadata = Metadata(
            trial=name,
            dataset="tests",
            scenario=scene.scenario,
            split="testing",
            index=3,
            preset="default",
            seed="ff",
            attempt=0,
            look="redyellow",
            width=SIZE,
            height=SIZE,
            frames=FRAMES,
            observed_frames=OBSERVED,
            frame_time=0.01,
            playback_rate=30,
            completed=True,
            engine=trajectory.engine,
            renderer="none",
            package="0",
            digest=trajectory.digest(),
            scene_digest=scene.physics_digest(),
            free_movies=True,
        )
        labels = replace(label_contact(scene, trajectory), robust=0.875)
        files["map"] = encode_png(role_map(ids, scene))
        files["trial_file"] = TrialWriter(metadata, scene, trajectory, labels, ids).finish()
        write_files(paths, files)
    table, problems = build_index(folder)
    assert not problems
    write_index(folder, table)
    return folder
