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
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from physion.compute.tasks import Executor, Progress, TaskOutcome, tracked
from physion.core.errors import BadInputError, BadSceneError, PhysionError
from physion.core.files import read_sealed, write_sealed
from physion.core.seeds import child_generator, stable_hash, trial_seed
from physion.physics.engine import Engine, make_engine, simulate_many
from physion.physics.labels import jitter_scene, label_contact
from physion.physics.trajectory import Trajectory
from physion.scenes.sampling.sample import get_preset, sample_scene
from physion.scenes.scene import Scene
from physion.trials.making.plan import GenerateSettings, TrialTask

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
SAVE_EVERY = 100
"""Outcomes after which the chosen scenes are saved; an interrupted run loses at most so many."""
JITTER = 0.001
"""Standard deviation in metres of the position noise with which robustness is measured."""


@dataclass(frozen=True)
class ChosenScene:
    """Scene that was chosen for a slot.

    Parameters
    ----------
    preset, attempt
        Parameter set and number of the attempt, which determine the scene.
    digest
        Physics digest of the scene.
    robust
        Fraction of jittered simulations with the same outcome; None if not measured.
    refused
        Number of scenes rejected before, by reason.
    """

    preset: str
    attempt: int
    digest: str
    robust: float | None
    refused: Mapping[str, int] = field(default_factory=dict)

    def fill(self, task: TrialTask) -> TrialTask:
        """Return ``task`` with this scene filled in."""
        return replace(
            task,
            preset=self.preset,
            attempt=self.attempt,
            robust=self.robust,
            scene_digest=self.digest,
        )


@dataclass(frozen=True)
class Slot:
    """Task whose scene is to be chosen; ``taken`` are `short` digests of physics already in use."""

    task: TrialTask
    settings: GenerateSettings
    taken: frozenset[int] = frozenset()


def split_of(digest: str) -> str:
    """Return the split that the physics with this digest belongs to."""
    part = int(digest[:8], 16) % 16
    return next((split for split, parts in SPLIT_PARTS.items() if part in parts), "familiarization")


def wanted_contact(task: TrialTask) -> bool | None:
    """Return the outcome that a slot requires; None if any outcome will do.

    Slots come in pairs, one with contact and one without, in pseudo-random order. The number of a
    trial alone does not reveal its outcome, but the outcome of one trial of a pair reveals that of
    the other.
    """
    if task.split not in BALANCED:
        return None
    pair, second = divmod(task.index, 2)
    first = stable_hash("contact first", task.dataset, task.scenario, task.split, pair) % 2 == 0
    return first != bool(second)


def choose(slot: Slot) -> ChosenScene:
    """Return the scene of a slot, a pure function of it; `PhysionError` if none is accepted."""
    task, refused = slot.task, Counter[str]()
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
        if short(digest) in slot.taken:
            refused["another trial has the same physics"] += 1
            continue
        reason, robust = judge(scene, seed, task, slot.settings)
        if reason is None:
            return ChosenScene(name, attempt, digest, robust, dict(refused))
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

    ``seed`` is that of the trial; without ``engine`` the default one is used.
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


class ChoiceRecord:
    """Chosen scenes of one split of one scenario, saved so that interrupted runs can continue."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.by_index: dict[int, ChosenScene] = {}
        if path.is_file():
            try:
                rows = read_sealed(path)
                self.by_index = {int(index): ChosenScene(**row) for index, row in rows.items()}
            except (BadInputError, ValueError, TypeError) as error:
                raise BadInputError(
                    f"{path} is not a record of chosen scenes ({error}); delete it to make it again"
                ) from error

    def save(self) -> None:
        """Write the file atomically."""
        rows = {str(index): asdict(self.by_index[index]) for index in sorted(self.by_index)}
        self.path.parent.mkdir(exist_ok=True)
        write_sealed(self.path, rows)

    def missing(self, tasks: Collection[TrialTask]) -> list[TrialTask]:
        """Return the tasks without a scene; drop scenes whose physics a lower index has too."""
        wanted = {task.index: task for task in tasks}
        first: dict[str, int] = {}
        for index in sorted(self.by_index):
            holder = first.setdefault(self.by_index[index].digest, index)
            if holder != index:
                del self.by_index[index]
        return [task for index, task in sorted(wanted.items()) if index not in self.by_index]

    def taken(self, below: int) -> frozenset[int]:
        """Return the `short` digests of the scenes of all lower indices."""
        return frozenset(
            short(choice.digest) for index, choice in self.by_index.items() if index < below
        )


def choose_all(
    groups: Mapping[Path, Collection[TrialTask]],
    settings: GenerateSettings,
    executor: Executor,
    progress: Progress | None = None,
) -> tuple[dict[str, ChosenScene], dict[str, TaskOutcome[ChosenScene]]]:
    """Choose the scenes of all tasks that have none yet.

    Slots are searched in parallel. If two slots find the same physics, the one with the higher
    index searches again, so that the result does not depend on the order of the work.

    Parameters
    ----------
    groups
        Tasks of one split of one scenario, by the file in which their scenes are recorded.
    settings
        Conditions for accepting a scene.
    executor
        Where to run.
    progress
        Shows the progress.

    Returns
    -------
    chosen, failed
        Scenes and failed outcomes by name of the trial.
    """
    records = {path: ChoiceRecord(path) for path in groups}
    failed: dict[str, TaskOutcome[ChosenScene]] = {}
    while todo := _slots(groups, records, settings, failed.keys()):
        outcomes = executor.map(choose, {name: slot for name, (_, slot) in todo.items()})
        unsaved: set[Path] = set()
        for done, outcome in enumerate(tracked(outcomes, "choosing", len(todo), progress), start=1):
            if outcome.error is not None:
                failed[outcome.key] = outcome
                continue
            path, slot = todo[outcome.key]
            records[path].by_index[slot.task.index] = outcome.value
            unsaved.add(path)
            if done % SAVE_EVERY == 0:
                _save(records, unsaved)
        _save(records, unsaved)
    chosen = {
        task.trial: records[path].by_index[task.index]
        for path, tasks in groups.items()
        for task in tasks
        if task.trial not in failed
    }
    return chosen, failed


def _slots(
    groups: Mapping[Path, Collection[TrialTask]],
    records: Mapping[Path, ChoiceRecord],
    settings: GenerateSettings,
    failed: Collection[str],
) -> dict[str, tuple[Path, Slot]]:
    """Return the open slots, with the files of their records, by name of the trial."""
    todo = {}
    for path, tasks in groups.items():
        for task in records[path].missing(tasks):
            if task.trial not in failed:
                taken = records[path].taken(task.index)
                todo[task.trial] = (path, Slot(task, settings, taken))
    return todo


def _save(records: Mapping[Path, ChoiceRecord], unsaved: set[Path]) -> None:
    for path in sorted(unsaved):
        records[path].save()
    unsaved.clear()
