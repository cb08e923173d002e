"""Rejection sampling: for each trial, take the first sampled scene that its split accepts.

Each trial of a split is a slot. The scenes sampled for a slot have seeds of their own and are tried
in order, so a slot gets the same scene in any process and any order. A scene is rejected if

- its physics belongs to another split. The split is computed from the digest of everything that
  determines the motion, so two splits never share a motion, wherever and whenever they are made;
- another slot of the split has the same physics;
- it has not the outcome that the slot requires (half of the slots of a balanced split have
  contact), agent and patient touch already in the observed part, the outcome is not robust enough,
  or agent or patient are hardly visible in the first frame.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

from physion.core.errors import BadSceneError, PhysionError
from physion.core.seeds import child_generator, stable_hash, trial_seed
from physion.physics.engine import Engine, make_engine, simulate_many
from physion.physics.labels import jitter_scene, label_contact
from physion.physics.trajectory import Trajectory
from physion.scenes.sampling.sample import get_preset, sample_scene
from physion.scenes.scene import Scene
from physion.trials.making.plan import GenerateJob, GenerateSettings, TrialTask

BALANCED = ("readout", "testing", "familiarization")
"""Splits in which half of the trials have contact, and none of them in the observed part."""
SPLIT_PARTS = {"training": range(0, 8), "readout": range(8, 12), "testing": range(12, 15)}
"""Sixteenths of the range of digests that belong to each split; familiarization has the last."""
TRIES_EACH = 12
"""Scenes rejected with one preset before the next is tried: some rarely have the other outcome."""
MAX_TRIES = 600
"""Rejected scenes of the right split after which a slot fails."""
MAX_ELSEWHERE = 600
"""Consecutive scenes of other splits after which a preset counts as one without variation; for a
preset with variation, the probability is at most 10^-16."""
MAX_UNPLACED = 20
"""Consecutive failures to place the objects of a scene after which a preset is abandoned."""
JITTER = 0.001
"""Standard deviation in metres of the position noise with which robustness is measured."""


def split_of(digest: str) -> str:
    """Return the split that the physics with this digest belongs to."""
    part = int(digest[:8], 16) % 16
    return next((split for split, parts in SPLIT_PARTS.items() if part in parts), "familiarization")


def wanted_contact(task: TrialTask) -> bool | None:
    """Return the outcome that a slot requires; None if any outcome will do.

    Slots come in pairs, one with contact and one without, in pseudo-random order. The number of a
    trial does not reveal its outcome, but the outcome of one trial of a pair reveals the other's.
    """
    if task.split not in BALANCED:
        return None
    pair, second = divmod(task.index, 2)
    first = stable_hash("contact first", task.dataset, task.scenario, task.split, pair) % 2 == 0
    return first != bool(second)


def choose(job: GenerateJob) -> tuple[TrialTask, Scene]:
    """Return the scene chosen for a trial, and its task with preset, attempt and robustness of it.

    A pure function of the job. Scenes are simulated only until agent and patient touch; the chosen
    one is simulated as a whole when its trial is made. Raises `PhysionError` if none is accepted.
    """
    task, refused = job.task, Counter[str]()
    params = {name: get_preset(task.scenario, name).params for name in task.presets}
    unplaced, elsewhere = Counter[str](), Counter[str]()
    attempt = -1
    while params and sum(refused.values()) < MAX_TRIES:
        attempt += 1
        tries, names = sum(refused.values()), list(params)
        name = names[(task.index // 2 + tries // TRIES_EACH) % len(names)]
        seed = trial_seed(task.dataset, task.scenario, task.split, task.index, attempt)
        try:
            scene = sample_scene(task.scenario, seed, params[name])
        except BadSceneError as error:
            refused[f"{name}: {error}"] += 1
            unplaced[name] += 1
            if unplaced[name] >= MAX_UNPLACED:
                del params[name]
            continue
        unplaced[name] = 0
        digest = scene.physics_digest()
        if split_of(digest) != task.split:
            elsewhere[name] += 1
            if elsewhere[name] >= MAX_ELSEWHERE:
                refused[f"{name} hardly varies, and its physics belongs to other splits"] += 1
                del params[name]
            continue
        elsewhere[name] = 0
        if job.taken.get(short(digest), task.index) < task.index:
            refused["another trial has the same physics"] += 1
            continue
        reason, robust = judge(scene, seed, task, job.settings)
        if reason is None:
            chosen = replace(task, presets=(), preset=name, attempt=attempt, robust=robust)
            return chosen, replace(scene, name=task.trial)
        refused[reason] += 1
    counts = "; ".join(f"{reason}: {count}" for reason, count in refused.most_common(4))
    raise PhysionError(
        f"none of {sum(refused.values())} scenes sampled from {', '.join(task.presets[:3])}"
        f"{' ...' if len(task.presets) > 3 else ''} is accepted ({counts})"
    )


def judge(
    scene: Scene, seed: Any, task: TrialTask, settings: GenerateSettings
) -> tuple[str | None, float | None]:
    """Return the reason to reject a scene, or None, and its robustness if it was measured."""
    engine = make_engine(settings.engine)
    trajectory = engine.simulate(scene, until_contact=True)
    labels = label_contact(scene, trajectory)
    wanted = wanted_contact(task)
    if wanted is not None and labels.contact != wanted:
        return ("contact" if labels.contact else "no contact"), None
    if labels.observed and task.split in BALANCED and not settings.observed_contact:
        return "contact inside the observed part", None
    if settings.min_visible and not _visible(scene, trajectory, settings):
        return "agent or patient hardly visible in the first frame", None
    robust = None
    if settings.jitters:
        robust = robustness(scene, labels.contact, seed, settings.jitters, engine)
    if robust is not None and robust < settings.robust:
        return "outcome not robust", None
    return None, robust


def robustness(
    scene: Scene, contact: bool, seed: Any, runs: int, engine: Engine | None = None
) -> float:
    """Return the fraction of ``runs`` simulations with noise `JITTER` that end as ``contact``.

    ``seed``: of the trial; without ``engine`` the default one is used.
    """
    moved = [
        jitter_scene(scene, JITTER, child_generator(seed, f"robustness {run}"))
        for run in range(runs)
    ]
    again = zip(moved, simulate_many(moved, engine=engine, until_contact=True), strict=True)
    return sum(label_contact(*one).contact == contact for one in again) / runs


def short(digest: str) -> int:
    """Return 64 bits of a digest, enough to tell trials apart and small to send to workers."""
    return int(digest[:16], 16)


def _visible(scene: Scene, trajectory: Trajectory, settings: GenerateSettings) -> bool:
    """Return whether agent and patient cover enough of the first frame."""
    # Imported late: loading the compiled renderer takes time.
    from physion.rendering.renderer import Renderer

    ids = Renderer(scene, trajectory, settings.width, settings.height).render(0, ("ids",)).ids
    assert ids is not None, "ids were asked for"
    roles = (scene.roles.agent, scene.roles.patient)
    return all((ids == scene.index(name) + 1).mean() >= settings.min_visible for name in roles)
