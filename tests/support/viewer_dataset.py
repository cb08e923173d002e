"""A small dataset made by hand, so that the viewer is tested without engine and sampler."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from physion.physics.labels import label_contact
from physion.physics.trajectory import Contacts, Trajectory
from physion.scenes.scene import Body, Camera, Cloth, Look, Push, Roles, Scene, SurfaceMaterial
from physion.trials.files import Metadata, TrialPaths, encode_png, write_files
from physion.trials.index import build_index, write_index
from physion.trials.trial_file import TrialWriter
from physion.trials.video import encode_movie

FRAMES, SIZE = 60, 64
EVIL = '</script><img src=x onerror="window.harmed=1"><!--&amp;\'"${harmed}`'


@dataclasses.dataclass(frozen=True)
class Plan:
    """What sets one trial apart."""

    trial: str
    scenario: str = "drop"
    split: str = "testing"
    preset: str | None = "plain"
    touch: tuple[int, ...] = tuple(range(50, FRAMES))
    robust: float | None = 1.0
    cloth: bool = False
    foreign: str = ""
    movies: bool = True


PLANS = (
    Plan("drop_0"),
    Plan("drop_1", touch=(), robust=0.5, preset="other"),
    Plan("drop_2", split="training", touch=(20, 21, 30), robust=None),
    Plan("drape_0", scenario="drape", cloth=True, touch=(55,), preset=None),
)


def make_scene(plan: Plan) -> Scene:
    """A ball above a wide plate, or a cloth in place of the ball, and a prop to look at."""
    rough = SurfaceMaterial(static_friction=0.5, dynamic_friction=0.4, restitution=0.3)
    name = "ball" + plan.foreign
    ball = Body(name, "sphere", (0, 0, 1.0), (0.5, 0.5, 0.5), mass=1.25, contact=rough)
    plate = Body("plate", "cube", (0, 0, 0), (1.5, 1.5, 0.2), kinematic=True)
    blue = Look((0.1, 0.2, 0.8))
    vase = Body("vase", "prop:vase", (-1.2, 0.6, 0), (0.5, 0.5, 0.5), scenery=True, look=blue)
    cloth = Cloth("sheet", (0, 0, 1.2), (1.0, 1.0, 0), resolution=31)
    return Scene(
        name=plan.trial,
        scenario=plan.scenario,
        bodies=(plate, vase) if plan.cloth else (ball, plate, vase),
        cloths=(cloth,) if plan.cloth else (),
        roles=Roles("sheet" if plan.cloth else ball.name, "plate"),
        camera=Camera((3.0, 0.5, 1.5)),
        pushes=() if plan.cloth else (Push(ball.name, (3.0, 4.0, 0.0), None, 7),),
        parameters={
            "height": 1.0,
            "nested": {"list": [1, 2], "evil": plan.foreign},
            plan.foreign or "key": 1,
        },
    )


def make_trajectory(scene: Scene, plan: Plan) -> Trajectory:
    """An even way down; agent and patient touch in the frames of the plan."""
    share = np.linspace(0, 1, FRAMES)
    positions = np.tile(np.array([b.position for b in scene.bodies]), (FRAMES, 1, 1))
    rotations = np.tile([1.0, 0, 0, 0], (FRAMES, len(scene.bodies), 1))
    vertices = np.zeros((FRAMES, 0, 3))
    distance = np.full(FRAMES, np.nan)
    contacts = Contacts.empty()
    if plan.cloth:
        side = np.linspace(-0.5, 0.5, 31)
        grid = np.stack(np.meshgrid(side, side, [0.0], indexing="ij"), -1).reshape(-1, 3)
        vertices = grid + np.stack([0 * share, 0 * share, 1.2 - share], -1)[:, None]
        distance = np.where(np.isin(np.arange(FRAMES), plan.touch), -0.01, 0.1)
    else:
        positions[:, 0, 2] = 1.0 - 0.8 * share
        angle = share * np.pi / 2
        rotations[:, 0] = np.stack([np.cos(angle), 0 * share, 0 * share, np.sin(angle)], -1)
        count = len(plan.touch)
        contacts = Contacts(
            np.array(plan.touch, np.int32).reshape(count),
            np.tile(np.array([[0, 1]], np.int32), (count, 1)),
            np.tile(np.array([[0.1, 0.2, 0.2]], np.float32), (count, 1)),
            np.tile(np.array([[0, 0, -1]], np.float32), (count, 1)),
            np.ones(count, np.float32),
        )
    f32 = np.float32
    return Trajectory(
        positions.astype(f32), rotations.astype(f32), np.zeros_like(positions, f32),
        np.zeros_like(positions, f32), vertices.astype(f32), distance.astype(f32), contacts,
        True, "by hand 1" + plan.foreign,
    )  # fmt: skip


def write_trial(folder: Path, plan: Plan, place: int) -> None:
    """The files of one trial; its movie is a grey that rises frame by frame."""
    scene = make_scene(plan)
    trajectory = make_trajectory(scene, plan)
    labels = dataclasses.replace(label_contact(scene, trajectory), robust=plan.robust)
    metadata = Metadata(
        trial=plan.trial, dataset="by-hand" + plan.foreign, scenario=plan.scenario,
        split=plan.split, index=place, preset=None if plan.preset is None
        else plan.preset + plan.foreign, seed="ff01", look="redyellow", width=SIZE, height=SIZE,
        frames=FRAMES, observed_frames=45, frame_time=0.01, playback_rate=30, completed=True,
        engine=trajectory.engine, renderer="none", package="0", digest=trajectory.digest(),
        scene_digest=scene.physics_digest(), movies=plan.movies,
    )  # fmt: skip
    ids = np.zeros((SIZE, SIZE), np.int16)
    files = {"trial_file": TrialWriter(metadata, scene, trajectory, labels, ids).finish()}
    if plan.movies:
        grey = np.arange(FRAMES, dtype=np.uint8)[:, None, None, None] * 3 + 40
        frames = np.ascontiguousarray(np.broadcast_to(grey, (FRAMES, SIZE, SIZE, 3)))
        files["movie"] = encode_movie(frames)
        files["observed_movie"] = encode_movie(frames[:45])
        files["map"] = encode_png(np.zeros((SIZE, SIZE, 4), np.uint8))
    write_files(TrialPaths(folder, plan.split, plan.scenario, plan.trial), files)


def make_dataset(folder: Path, plans: tuple[Plan, ...] = PLANS) -> Path:
    """Trials and index; the folder."""
    for place, plan in enumerate(plans):
        write_trial(folder, plan, place)
    table, problems = build_index(folder)
    assert problems == {}
    write_index(folder, table)
    return folder
