"""Sampling shared by contain and link: a ball hits a stand that carries a stack of bodies."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from physion.scenes.sampling.build import Palette, SceneParams, build_scene
from physion.scenes.sampling.clearance import is_clear_of, raise_above
from physion.scenes.sampling.parameters import retry
from physion.scenes.sampling.rules import (
    BodyRule,
    PushRule,
    ZoneRule,
    draw_body,
    draw_push,
    draw_zone,
)
from physion.scenes.sampling.stacks import (
    FilledStackRule,
    Stand,
    StandRule,
    choose_position,
    draw_looks,
    draw_stack,
    draw_stand,
    height_of_top,
    lower_below_cap,
)
from physion.scenes.scene import Body, Look, Roles, Scene, Vec3
from physion.seeds import child_generator

TRIES = 100
MAX_FRAMES = 452
STACK_MASS = 0.25
"""Factor of the masses of the stack's bodies (docs/official-system.md, 3.4)."""


class StandParams(SceneParams, Protocol):
    """Parameters that a scenario with a stand has."""

    @property
    def length(self) -> float:
        """Distance in metres; the probe starts at x = -length / 2."""
        ...

    @property
    def stand(self) -> StandRule:
        """Rule of the stand in the centre."""
        ...

    @property
    def stack(self) -> FilledStackRule:
        """Rule of the stack on or in it."""
        ...

    @property
    def choice(self) -> tuple[int, int]:
        """First and last index in the stack at which the agent may be."""
        ...

    @property
    def zone(self) -> ZoneRule:
        """Rule of the patient."""
        ...

    @property
    def probe(self) -> BodyRule:
        """Rule of the body that is pushed."""
        ...

    @property
    def push(self) -> PushRule:
        """Rule of the push."""
        ...

    @property
    def monochrome(self) -> bool:
        """Whether the bodies of the stack have one colour."""
        ...


@dataclass
class _DrawnStand:
    stand: Stand
    stack: list[Body]
    probe: Body


def sample_standing(
    scenario: str,
    params: StandParams,
    seed: np.random.SeedSequence,
    base_color: Vec3 | None,
    attachment_color: Vec3,
) -> Scene:
    """Sample a stand in the centre, a stack in or on it, and a ball at -x pushed towards its foot.

    ``base_color`` and ``attachment_color`` are fixed in the official configurations; None draws
    the colour.
    """
    rng, palette = child_generator(seed, "placement"), Palette.of(seed)
    member = params.stack.member
    agent_look = palette.agent_look(member.textures)
    base_look = _set_look_color(palette.look(params.stand.base.textures), base_color)
    attachment_look = _set_look_color(
        palette.look(params.stand.attachment.textures), attachment_color
    )
    probe_look = palette.look(params.probe.textures)
    zone = draw_zone(rng, params.zone, palette.look(params.zone.textures))
    looks = draw_looks(rng, params.stack, palette, params.monochrome)
    agent = choose_position(rng, len(looks), params.choice)
    looks[agent] = agent_look
    push_rng = child_generator(seed, "push")
    drawn: list[_DrawnStand] = []

    def attempt() -> str | None:
        stand = draw_stand(rng, params.stand, zone, base_look, attachment_look)
        obstacles = (zone, *stand.holders)
        stack = draw_stack(rng, params.stack, stand.start, obstacles, looks, "member", STACK_MASS)
        fitting = lower_below_cap(stack, stand)
        start = (-params.length / 2, 0.0, 0.0)
        probe = draw_body(push_rng, params.probe, "probe", start, probe_look, angular_drag=0.0)
        probe = raise_above(probe, (zone,))
        if fitting is None:
            return "the stack does not fit under the cap"
        if not is_clear_of(probe, (*stand.bodies, *fitting)):
            return "the probe would start inside the stand"
        drawn.append(_DrawnStand(stand, fitting, probe))
        return None

    retry(TRIES, scenario, attempt)
    result = drawn[0]
    target = replace(result.stack[agent], name="target")
    others = [body for i, body in enumerate(result.stack) if i != agent]
    return build_scene(
        scenario,
        seed,
        params,
        bodies=(zone, target, result.probe, *result.stand.bodies, *others),
        roles=Roles("target", "zone", "probe"),
        max_frames=MAX_FRAMES,
        aim_height=height_of_top(result.stack[-1]) / 2,
        pushes=(draw_push(push_rng, params.push, result.probe),),
        joints=result.stand.joints,
    )


def _set_look_color(look: Look, color: Vec3 | None) -> Look:
    return look if color is None else replace(look, color=color)
