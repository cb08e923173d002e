"""What all scenarios share: registry, colours, assembly of a scene with camera and scenery.

A scenario samples scenes from its parameters and a seed. It registers its sampling function with
the decorator `scenario`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from physion.core.names import SCENARIOS
from physion.core.registry import Registry
from physion.core.seeds import child_generator, stable_hash
from physion.core.settings import as_json
from physion.scenes.looks import pick_material, random_color
from physion.scenes.sampling.placement import CameraRule, SceneryRule, place_camera, place_scenery
from physion.scenes.scene import FLOORS, Body, Cloth, Ending, Joint, Look, Push, Roles, Scene, Vec3

P = TypeVar("P")


@dataclass(frozen=True)
class Scenario:
    """Kind of trial.

    - ``params``: frozen dataclass with a default for each field. It may have a method
      ``check_values`` (`physion.scenes.sampling.parameters.check_together`).
    - ``sample``: function of parameters and seed that returns a scene and depends on nothing else.
    """

    name: str
    params: type[Any]
    sample: Callable[[Any, np.random.SeedSequence], Scene]


scenarios: Registry[Scenario] = Registry(
    "scenario", {name: f"physion.scenes.scenarios.{name}:sample" for name in SCENARIOS}
)


def scenario(
    name: str, params: type[P]
) -> Callable[
    [Callable[[P, np.random.SeedSequence], Scene]], Callable[[P, np.random.SeedSequence], Scene]
]:
    """Return a decorator that registers a sampling function as the scenario ``name``."""

    def add(
        sample: Callable[[P, np.random.SeedSequence], Scene],
    ) -> Callable[[P, np.random.SeedSequence], Scene]:
        scenarios.register(name)(Scenario(name, params, sample))
        return sample

    return add


def scene_name(scenario: str, seed: np.random.SeedSequence) -> str:
    """Return a name for a sampled scene; it depends on scenario and seed only."""
    return f"{scenario}_{stable_hash(str(seed.entropy)) & 0xFFFFFFFF:08x}"


def as_record(params: Any) -> dict[str, Any]:
    """Convert parameters to plain JSON values, for `Scene.parameters`."""
    record: dict[str, Any] = as_json(dataclasses.asdict(params))
    return record


AIM_HEIGHT = 0.5
"""Default height of the camera's target above the floor, metres."""

MovableT = TypeVar("MovableT", Body, Cloth)


class SceneParams(Protocol):
    """Parameters that every scenario has."""

    @property
    def room(self) -> str:
        """Name of a room (``physion ls rooms``)."""
        ...

    @property
    def camera(self) -> CameraRule:
        """How the camera is drawn."""
        ...

    @property
    def scenery(self) -> SceneryRule:
        """How distractors and occluders are drawn."""
        ...


@dataclass
class Palette:
    """Source of random looks that differ from the agent's colour.

    ``shared`` is the single colour of the other bodies of a monochrome scene.
    """

    rng: np.random.Generator
    agent: Vec3
    shared: Vec3

    @classmethod
    def of(cls, seed: np.random.SeedSequence) -> Palette:
        """Return the colours of the trial with this seed."""
        rng = child_generator(seed, "looks")
        agent = random_color(rng)
        return cls(rng, agent, random_color(rng, (agent,)))

    def agent_look(self, textures: Sequence[str]) -> Look:
        """Draw the look of the agent."""
        return Look(self.agent, pick_material(self.rng, textures))

    def look(self, textures: Sequence[str], monochrome: bool = False) -> Look:
        """Draw the look of another body: a new colour, or with ``monochrome`` the shared one."""
        color = random_color(self.rng, (self.agent,))
        return Look(self.shared if monochrome else color, pick_material(self.rng, textures))


def build_scene(
    scenario: str,
    seed: np.random.SeedSequence,
    params: SceneParams,
    *,
    bodies: Sequence[Body],
    roles: Roles,
    max_frames: int,
    aim_height: float = AIM_HEIGHT,
    camera: CameraRule | None = None,
    cloths: Sequence[Cloth] = (),
    pushes: Sequence[Push] = (),
    joints: Sequence[Joint] = (),
    seen: Sequence[Body] | None = None,
    around: Sequence[Body] | None = None,
    settle_frames: int = 0,
) -> Scene:
    """Build the scene of ``bodies``; draw camera and scenery, and move all onto the room's floor.

    Parameters
    ----------
    scenario, seed, params
        Name, seed and parameters of the scene; camera and scenery use streams of their own.
    bodies, cloths, pushes, joints, roles
        Content of the scene, for a floor at height 0.
    max_frames
        Longest trial; it ends earlier if all bodies are at rest.
    aim_height
        Height of the camera's target above the floor, metres.
    camera
        Rule used in place of ``params.camera``.
    seen
        Bodies that the camera must show, by default agent and patient.
    around
        Bodies that scenery keeps a distance from, by default all.
    settle_frames
        See `Scene`.

    Raises
    ------
    BadSceneError
        If no camera shows ``seen``, or there is no space for the scenery.
    """
    by_name = {body.name: body for body in bodies}
    wanted = [by_name[name] for name in (roles.agent, roles.patient) if name in by_name]
    eye = place_camera(
        child_generator(seed, "camera"), camera or params.camera, aim_height, seen or wanted
    )
    scenery = place_scenery(
        params.scenery,
        eye,
        bodies if around is None else around,
        child_generator(seed, "distractors"),
        child_generator(seed, "occluders"),
    )
    floor = FLOORS.get(params.room, 0.0)
    return Scene(
        name=scene_name(scenario, seed),
        scenario=scenario,
        bodies=tuple(move_up(body, floor) for body in (*bodies, *scenery)),
        roles=roles,
        camera=eye,
        cloths=tuple(move_up(cloth, floor) for cloth in cloths),
        pushes=tuple(_move_push_up(push, floor) for push in pushes),
        joints=tuple(joints),
        room=params.room,
        floor=floor,
        ending=Ending(max_frames=max_frames),
        settle_frames=settle_frames,
        parameters=as_record(params),
    )


def move_up(thing: MovableT, height: float) -> MovableT:
    """Return a body or cloth moved up by ``height`` metres."""
    x, y, z = thing.position
    return replace(thing, position=(x, y, z + height))


def _move_push_up(push: Push, height: float) -> Push:
    if push.point is None:
        return push
    x, y, z = push.point
    return replace(push, point=(x, y, z + height))
