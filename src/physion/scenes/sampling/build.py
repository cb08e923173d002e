"""What every scenario does the same way: colours, camera, scenery, and the scene around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from physion.scenes.looks import pick_material, random_color
from physion.scenes.sampling.placement import CameraRule, SceneryRule, place_camera, place_scenery
from physion.scenes.sampling.registry import as_record, scene_name
from physion.scenes.scene import Body, Cloth, Ending, Joint, Look, Push, Roles, Scene, Vec3
from physion.seeds import child_generator

AIM_HEIGHT = 0.5
"""Metres above the floor at which the camera looks, where a scenario does not say otherwise."""
FLOORS = {"box": 0.0, "bright": 0.0043, "empty": 0.0}
"""Height of each room's floor in metres. In the official ``tdw_room``, our ``bright``, everything
that was put at 0 ends .004 or .005 higher than in ``box_room_2018``."""


class SceneParams(Protocol):
    """What the parameters of every scenario have in common."""

    @property
    def room(self) -> str:
        """Name of a room of `FLOORS`."""
        ...

    @property
    def camera(self) -> CameraRule:
        """Where the camera stands."""
        ...

    @property
    def scenery(self) -> SceneryRule:
        """What stands behind and before the scene."""
        ...


@dataclass
class Palette:
    """Draws looks that nobody takes for the agent's; ``shared`` is the colour of all others."""

    rng: np.random.Generator
    agent: Vec3
    shared: Vec3

    @classmethod
    def of(cls, seed: np.random.SeedSequence) -> Palette:
        """The colours of the trial with this seed."""
        rng = child_generator(seed, "looks")
        agent = random_color(rng)
        return cls(rng, agent, random_color(rng, (agent,)))

    def agent_look(self, textures: Sequence[str]) -> Look:
        """The look of the agent."""
        return Look(self.agent, pick_material(self.rng, textures))

    def look(self, textures: Sequence[str], monochrome: bool = False) -> Look:
        """The look of another body: a new colour, or the one that ``monochrome`` bodies share."""
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
    """The scene of ``bodies``, with the camera and the scenery that ``params`` draw around them.

    ``seen`` are the bodies that the camera must show: agent and patient, where they are bodies.
    Scenery keeps clear of the bodies ``around`` which it stands: all, but for those without end.
    ``camera`` replaces the rule of ``params``. Everything stands on the floor of its room.
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
    floor = FLOORS[params.room]
    return Scene(
        name=scene_name(scenario, seed),
        scenario=scenario,
        bodies=tuple(raised(body, floor) for body in (*bodies, *scenery)),
        roles=roles,
        camera=eye,
        cloths=tuple(raised(cloth, floor) for cloth in cloths),
        pushes=tuple(_raised_push(push, floor) for push in pushes),
        joints=tuple(joints),
        room=params.room,
        floor=floor,
        ending=Ending(max_frames=max_frames),
        settle_frames=settle_frames,
        parameters=as_record(params),
    )


def raised(thing: Any, height: float) -> Any:
    """A body or cloth that much higher, in metres."""
    x, y, z = thing.position
    return replace(thing, position=(x, y, z + height))


def _raised_push(push: Push, height: float) -> Push:
    if push.point is None:
        return push
    x, y, z = push.point
    return replace(push, point=(x, y, z + height))
