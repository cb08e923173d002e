"""The same scene with one thing changed: which changes alter whether agent and patient touch?

A variant of a trial is a trial of its own in the same split, called ``TRIAL+KIND.WHAT``:

- ``remove``: without one body, for each body that is neither agent nor patient nor scenery;
- ``mass``: the agent with a quarter or four times its mass;
- ``friction``: all bodies but scenery with a quarter or four times their friction, at most 1,
  where it is not above 1 already;
- ``push``: half the push, or one and a half times it.

All else is equal: poses at the start, camera, colours. ``parameters`` of its scene hold ``whatif``
and, of the trial, ``base`` and ``base_contact``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

from physion.core.errors import BadInputError, UnknownNameError
from physion.scenes.looks import COLORS_OF
from physion.scenes.scene import Body, Cloth, Push, Scene
from physion.trials.dataset import Dataset
from physion.trials.making.plan import BASE_CONTACT, WHATIF, TrialTask

KINDS = ("remove", "mass", "friction", "push")
CUES = ("cue-mass", "cue-friction")
"""Kinds of `physion.trials.making.cues`: their variants are compared with each other."""
FACTORS = {"quarter": 0.25, "fourfold": 4.0}
"""Factors of mass and friction."""
PUSHES = {"weaker": 0.5, "stronger": 1.5}
MARK = "+"
"""Between the name of a trial and the change; no name of a sampled trial holds it."""
AFTER = 10**6
"""Added to the index of a trial for its variants, so that no scene that is chosen later is refused
because a variant has the same physics."""

Thing = TypeVar("Thing", Body, Cloth)


def variants(scene: Scene, kinds: Sequence[str] = KINDS) -> list[tuple[str, Scene]]:
    """Return the variants of a scene, each with its change as ``KIND.WHAT``.

    Raises `UnknownNameError` for a kind that is not one of `KINDS`. A kind that does not apply (a
    push in a scene without one) gives none.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise UnknownNameError("change", kind, KINDS)
    makers = {"remove": _removed, "mass": _masses, "friction": _frictions, "push": _pushes}
    return [
        (f"{kind}.{word}", changed) for kind in dict.fromkeys(kinds)
        for word, changed in makers[kind](scene)
    ]  # fmt: skip


def whatif_tasks(dataset: Dataset, trials: Sequence[str], kinds: Sequence[str]) -> list[TrialTask]:
    """Return a task for each variant of ``trials``, which have labels.

    Raises
    ------
    BadInputError
        If a trial has no label, or is a variant itself.
    """
    tasks = []
    for name in trials:
        trial = dataset.trial(name)
        if MARK in name:
            raise BadInputError(f"trial {name!r} is a variant: give trials that were sampled")
        for change, scene in variants(trial.scene, kinds):
            known = {
                WHATIF: change,
                "base": name,
                BASE_CONTACT: trial.known_labels().contact,
                COLORS_OF: trial.scene.physics_digest(),
            }
            called = name + MARK + re.sub(r"[^A-Za-z0-9._-]", "-", change)
            named = replace(scene, name=called, parameters={**scene.parameters, **known})
            meta = trial.metadata
            tasks.append(
                TrialTask(meta.dataset, meta.scenario, meta.split, AFTER + meta.index, scene=named)
            )
    return tasks


def parts_of(trial: str) -> tuple[str, str]:
    """Return the trial that a variant belongs to, and its change; the latter is empty for none."""
    base, _, change = trial.partition(MARK)
    return base, change


def pair_of(trial: str) -> tuple[str, bool]:
    """Return the name of the pair that a trial belongs to, and whether it is the variant of it.

    A variant is paired with its trial, whose name the pair has; it may have several variants. With
    a cue, the trials of the same test are a pair, the second of which counts as the variant.
    """
    base, change = parts_of(trial)
    if not change.startswith(tuple(f"{kind}." for kind in CUES)):
        return base, change != ""
    pair, _, value = trial.rpartition(".")
    return pair, value == "1"


def _removed(scene: Scene) -> Iterator[tuple[str, Scene]]:
    roles = (scene.roles.agent, scene.roles.patient)
    for body in scene.bodies:
        if body.scenery or body.name in roles:
            continue
        name = body.name
        probe = None if scene.roles.probe == name else scene.roles.probe
        yield (
            name,
            replace(
                scene,
                bodies=tuple(other for other in scene.bodies if other is not body),
                joints=tuple(j for j in scene.joints if name not in (j.parent, j.child)),
                pushes=tuple(push for push in scene.pushes if push.body != name),
                events=tuple(event for event in scene.events if event.body != name),
                roles=replace(scene.roles, probe=probe),
            ),
        )


def _masses(scene: Scene) -> Iterator[tuple[str, Scene]]:
    for word, factor in FACTORS.items():
        agent = _agent(scene)
        if not (isinstance(agent, Body) and agent.kinematic):
            yield word, _with_agent(scene, replace(agent, mass=agent.mass * factor))


def _frictions(scene: Scene) -> Iterator[tuple[str, Scene]]:
    for word, factor in FACTORS.items():
        bodies = tuple(body if body.scenery else _rubbed(body, factor) for body in scene.bodies)
        if bodies != scene.bodies:
            yield word, replace(scene, bodies=bodies)


def _rubbed(body: Body, factor: float) -> Body:
    old = body.contact
    pair = old.static_friction, old.dynamic_friction
    # At most 1, but no friction falls where it should rise: of zones it may be above 1 already.
    static, dynamic = (min(f * factor, max(f, 1.0)) for f in pair)
    return replace(body, contact=replace(old, static_friction=static, dynamic_friction=dynamic))


def _pushes(scene: Scene) -> Iterator[tuple[str, Scene]]:
    for word, factor in PUSHES.items() if scene.pushes else ():
        yield word, replace(scene, pushes=tuple(_scaled(p, factor) for p in scene.pushes))


def _scaled(push: Push, factor: float) -> Push:
    x, y, z = push.impulse
    return replace(push, impulse=(x * factor, y * factor, z * factor))


def _agent(scene: Scene) -> Body | Cloth:
    things: tuple[Body | Cloth, ...] = (*scene.bodies, *scene.cloths)
    return things[scene.index(scene.roles.agent)]


def _with_agent(scene: Scene, agent: Body | Cloth) -> Scene:
    def new(things: tuple[Thing, ...]) -> tuple[Thing, ...]:
        return tuple(agent if old.name == agent.name else old for old in things)  # type: ignore[misc]

    return replace(scene, bodies=new(scene.bodies), cloths=new(scene.cloths))
