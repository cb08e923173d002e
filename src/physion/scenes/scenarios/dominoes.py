"""Dominoes: a pushed domino may topple a row of others; does the last one reach the zone?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from physion.core.seeds import child_generator
from physion.numerics.elementary import arctan2
from physion.numerics.rotations import rotate_vectors
from physion.scenes.sampling.build import Palette, build_scene, scenario
from physion.scenes.sampling.parameters import Count, Fraction, Length, Room, retry, uniform
from physion.scenes.sampling.placement import (
    BodyRule,
    CameraRule,
    PushRule,
    SceneryRule,
    ZoneRule,
    draw_body,
    draw_push,
    draw_zone,
    raise_to_floor,
    require_apart,
    world_bounds,
)
from physion.scenes.scene import Body, Look, Roles, Scene

MAX_FRAMES = 302
ZONE_GAP = 0.1
"""Gap between target and zone, metres (docs/official-system.md, section 3.1)."""
BODY_GAP = 0.01
"""Smallest gap between neighbours, metres. Officially they may start inside each other."""
ROW_TRIES = 100

DOMINO = ((0.1, 0.1), (0.25, 0.25), (0.5, 0.5))
"""Width along the row, width across, height: metres."""
TARGET = BodyRule(scale=DOMINO)
MIDDLE = BodyRule(scale=DOMINO, turn_deg=(-30.0, 30.0))
PROBE = BodyRule(scale=DOMINO, static_friction=(0.01, 0.01), dynamic_friction=(0.01, 0.01))
ZONE = ZoneRule()
PUSH = PushRule(speed=(0.75, 0.75), frame=(0.0, 15.0))
CAMERA, SCENERY = CameraRule(), SceneryRule()


@dataclass(frozen=True)
class DominoesParameters:
    """Parameters of the scenario dominoes (docs/official-system.md, 2.1, 3.0 and 3.1).

    Defaults are the official configuration `pilot_dominoes_2mid_J025R30`, in which every second
    trial ends in contact; the defaults of the official class are the preset `default_boxroom`.

    - ``length``: metres from probe to target. ``middles``: number of dominoes between them.
    - ``spacing_jitter``: largest relative change of each distance along the row; changes add up.
      ``lateral_jitter``: largest displacement across the row, as a fraction of the width.
    - ``remove_middle``: leave out one of the dominoes between, so that there is a gap.
    - ``turned_push``: rotate the push with the probe, as officially.
    - ``monochrome``: the dominoes between have one colour.
    """

    length: Length = 1.5
    middles: Count = 2
    target: BodyRule = TARGET
    middle: BodyRule = MIDDLE
    probe: BodyRule = PROBE
    zone: ZoneRule = ZONE
    spacing_jitter: Fraction = 0.25
    lateral_jitter: Fraction = 0.25
    remove_middle: bool = False
    push: PushRule = PUSH
    turned_push: bool = True
    monochrome: bool = True
    room: Room = "box"
    camera: CameraRule = CAMERA
    scenery: SceneryRule = SCENERY


@scenario("dominoes", DominoesParameters)
def sample(params: DominoesParameters, seed: np.random.SeedSequence) -> Scene:
    """Sample a row of dominoes along x with the probe at -x, and the zone behind the target."""
    rng, palette = child_generator(seed, "placement"), Palette.of(seed)
    half = params.length / 2
    zone = draw_zone(rng, params.zone, palette.look(params.zone.textures), (half + ZONE_GAP, 0.0))
    x, y, _ = zone.position
    zone = replace(zone, position=(x + zone.scale[0], y, 0.0))
    look = palette.agent_look(params.target.textures)
    target = raise_to_floor(draw_body(rng, params.target, "target", (half, 0.0, 0.0), look))
    push_rng = child_generator(seed, "push")
    look = palette.look(params.probe.textures)
    probe = raise_to_floor(
        draw_body(push_rng, params.probe, "probe", (-half, 0.0, 0.0), look, angular_drag=0.0)
    )
    require_apart(probe, target)
    require_apart(target, zone)
    row = _row(params, rng, palette, probe, target)
    push = draw_push(push_rng, params.push, probe, heading(probe) if params.turned_push else 0.0)
    return build_scene(
        "dominoes",
        seed,
        params,
        bodies=(zone, target, probe, *row),
        roles=Roles("target", "zone", "probe"),
        max_frames=MAX_FRAMES,
        pushes=(push,),
    )


def heading(body: Body) -> float:
    """Return the direction of the body's x axis: radians from +x towards +y."""
    x, y, _ = rotate_vectors(body.rotation, (1.0, 0.0, 0.0))
    return arctan2(float(y), float(x))


def _row(
    params: DominoesParameters,
    rng: np.random.Generator,
    palette: Palette,
    probe: Body,
    target: Body,
) -> list[Body]:
    """Draw the dominoes between probe and target, again until all of them fit."""
    removed = int(rng.integers(max(params.middles, 1))) if params.remove_middle else -1
    looks = [palette.look(params.middle.textures, params.monochrome) for _ in range(params.middles)]
    free = float(world_bounds(probe)[1, 0]), float(world_bounds(target)[0, 0])
    row: list[Body] = []

    def attempt() -> str | None:
        row[:] = _draw_row(params, rng, looks, *free)
        if len(row) < params.middles:
            return f"no room for {params.middles} dominoes between probe and target"
        return None

    retry(ROW_TRIES, f"a row of dominoes {params.length:g} m long", attempt)
    return [body for i, body in enumerate(row) if i != removed]


def _draw_row(
    params: DominoesParameters,
    rng: np.random.Generator,
    looks: list[Look],
    start: float,
    end: float,
) -> list[Body]:
    """Draw dominoes from ``start`` to ``end`` (x in metres), at most as many as fit."""
    spacing = params.length / (params.middles + 1)
    x, taken, row = -params.length / 2, start, []
    for i, look in enumerate(looks):
        jitter = params.spacing_jitter
        x += spacing * uniform(rng, (1 - jitter, 1 + jitter))
        aside = uniform(rng, (-params.lateral_jitter, params.lateral_jitter))
        body = raise_to_floor(draw_body(rng, params.middle, f"middle_{i}", (0.0, 0.0, 0.0), look))
        low, high = (float(bound) for bound in world_bounds(body)[:, 0])
        first, last = taken + BODY_GAP - low, end - BODY_GAP - high
        if first > last:
            break
        at = max(min(x, last), first)
        taken = at + high
        row.append(replace(body, position=(at, aside * body.scale[1], body.position[2])))
    return row
