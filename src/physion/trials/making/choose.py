"""Which draw becomes a trial: the first that its split can take.

Each trial of a split is a slot. Its draws have seeds of their own and are tried in order, so that
the same slot ends with the same scene in any process and any order. A draw is refused

- unless its physics belongs to the split: the digest of everything that decides the motion says
  to which, so that no two splits ever share a motion, wherever and whenever they are made;
- where another slot of the split has the same physics;
- where its outcome is not the one that the slot is to have (half of the slots of a balanced split
  have contact), where agent and patient touch already in the observed part, where the outcome is
  not robust enough, or where agent or patient cannot be seen in the first frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from physion.compute.executor import Executor, TaskOutcome
from physion.compute.progress import Track, tracked
from physion.errors import BadInputError, BadSceneError, PhysionError
from physion.physics.engine import simulate
from physion.physics.jitter import jitter_scene
from physion.physics.labels import label_contact
from physion.physics.trajectory import Trajectory
from physion.scenes.sampling.preset import get_preset
from physion.scenes.sampling.registry import sample_scene
from physion.scenes.scene import Scene
from physion.seeds import child_generator, stable_hash, trial_seed
from physion.trials.making.plan import GenerateSettings, TrialTask
from physion.trials.sealed import read_sealed, write_sealed

BALANCED = ("readout", "testing", "familiarization")
"""Splits of which half the trials end with contact, and where nothing may be seen too early."""
SPLIT_PARTS = {"training": range(0, 8), "readout": range(8, 12), "testing": range(12, 15)}
"""Which sixteenths of all physics a split takes; the last one is for familiarization."""
TRIES_EACH = 12
"""Draws of a preset before the next one is tried: some presets hardly ever end the other way."""
MAX_TRIES = 600
"""Draws of the right split before a slot is given up."""
MAX_ELSEWHERE = 600
"""Draws in a row that belong to other splits before a preset counts as one that hardly varies: by
chance that happens once in 10^16 to the rarest split."""
MAX_UNPLACED = 20
"""Draws in a row that could not be placed before a preset is given up."""
SAVE_EVERY = 100
"""Choices that a killed run may lose."""
JITTER = 0.001
"""Standard deviation in metres of the noise that measures robustness."""


@dataclass(frozen=True)
class ChosenScene:
    """What a slot took: its preset and attempt, and how robust its outcome is.

    ``digest`` is the scene's, ``refused`` counts refused draws by reason.
    """

    preset: str
    attempt: int
    digest: str
    robust: float | None
    refused: Mapping[str, int] = field(default_factory=dict)

    def fill(self, task: TrialTask) -> TrialTask:
        """The task with this choice in it."""
        return replace(
            task,
            preset=self.preset,
            attempt=self.attempt,
            robust=self.robust,
            scene_digest=self.digest,
        )


@dataclass(frozen=True)
class Slot:
    """A task whose draw is to be found; ``taken`` holds short digests of physics in use."""

    task: TrialTask
    settings: GenerateSettings
    taken: frozenset[int] = frozenset()


def split_of(digest: str) -> str:
    """The split to which a motion belongs, from the digest of its scene."""
    part = int(digest[:8], 16) % 16
    return next((split for split, parts in SPLIT_PARTS.items() if part in parts), "familiarization")


def wanted_contact(task: TrialTask) -> bool | None:
    """The outcome that a slot is to have; None where any will do.

    Slots come in pairs, one with contact and one without, in an order that chance decides. The
    number of a trial alone does not give its answer away; who knows the answer to one of a pair
    knows the other's.
    """
    if task.split not in BALANCED:
        return None
    pair, second = divmod(task.index, 2)
    first = stable_hash("contact first", task.dataset, task.scenario, task.split, pair) % 2 == 0
    return first != bool(second)


def choose(slot: Slot) -> ChosenScene:
    """Find the draw of a slot. A pure function; `PhysionError` says why there is none."""
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
        f"none of {sum(refused.values())} draws of {', '.join(task.presets[:3])}"
        f"{' ...' if len(task.presets) > 3 else ''} can be taken ({counts})"
    )


def judge(
    scene: Scene, seed: Any, task: TrialTask, settings: GenerateSettings
) -> tuple[str | None, float | None]:
    """Why a draw cannot be taken, or None; and its robustness, if it was measured."""
    trajectory = simulate(scene, until_contact=True)
    labels = label_contact(scene, trajectory)
    wanted = wanted_contact(task)
    if wanted is not None and labels.contact != wanted:
        return ("contact" if labels.contact else "no contact"), None
    if labels.observed and task.split in BALANCED and not settings.observed_contact:
        return "contact inside the observed part", None
    if settings.min_visible and not _visible(scene, trajectory, settings):
        return "agent or patient hardly visible in the first frame", None
    robust = robustness(scene, labels.contact, seed, settings.jitters) if settings.jitters else None
    if robust is not None and robust < settings.robust:
        return "outcome not robust", None
    return None, robust


def robustness(scene: Scene, contact: bool, seed: Any, runs: int) -> float:
    """Share of ``runs`` simulations, each with `JITTER` of noise, that end as ``contact`` says."""
    agree = 0
    for run in range(runs):
        moved = jitter_scene(scene, JITTER, child_generator(seed, f"robustness {run}"))
        again = label_contact(moved, simulate(moved, until_contact=True))
        agree += again.contact == contact
    return agree / runs


def short(digest: str) -> int:
    """64 bits of a digest: enough to tell trials apart, and small to send to workers."""
    return int(digest[:16], 16)


def _visible(scene: Scene, trajectory: Trajectory, settings: GenerateSettings) -> bool:
    # Compiled code, which is loaded by whoever renders.
    from physion.rendering.renderer import Renderer

    ids = Renderer(scene, trajectory, settings.width, settings.height).render(0, ("ids",)).ids
    assert ids is not None, "ids were asked for"
    roles = (scene.roles.agent, scene.roles.patient)
    return all((ids == scene.index(name) + 1).mean() >= settings.min_visible for name in roles)


class ChoiceRecord:
    """The choices of one split of one scenario, kept in a file so that a killed run goes on."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.by_index: dict[int, ChosenScene] = {}
        if path.is_file():
            try:
                rows = read_sealed(path)
                self.by_index = {int(index): ChosenScene(**row) for index, row in rows.items()}
            except (BadInputError, ValueError, TypeError) as error:
                raise BadInputError(
                    f"{path} is no record of choices ({error}); delete it to have it made again"
                ) from error

    def save(self) -> None:
        """Write the file, whole."""
        rows = {str(index): asdict(self.by_index[index]) for index in sorted(self.by_index)}
        self.path.parent.mkdir(exist_ok=True)
        write_sealed(self.path, rows)

    def missing(self, tasks: Collection[TrialTask]) -> list[TrialTask]:
        """Tasks without a choice, and those whose physics a task of lower index has."""
        wanted = {task.index: task for task in tasks}
        first: dict[str, int] = {}
        for index in sorted(self.by_index):
            holder = first.setdefault(self.by_index[index].digest, index)
            if holder != index:
                del self.by_index[index]
        return [task for index, task in sorted(wanted.items()) if index not in self.by_index]

    def taken(self, below: int) -> frozenset[int]:
        """Short digests of the choices of all lower indices."""
        return frozenset(
            short(choice.digest) for index, choice in self.by_index.items() if index < below
        )


def choose_all(
    groups: Mapping[Path, Collection[TrialTask]],
    settings: GenerateSettings,
    executor: Executor,
    track: Track | None = None,
) -> tuple[dict[str, ChosenScene], dict[str, TaskOutcome[ChosenScene]]]:
    """Choices by trial name, and failures by name, for tasks by the file of their choices.

    Each group is one split of one scenario. Slots are searched side by side, and those that found
    the physics of a slot before them search on, so that the result does not depend on who was
    first.
    """
    records = {path: ChoiceRecord(path) for path in groups}
    failed: dict[str, TaskOutcome[ChosenScene]] = {}
    while todo := _slots(groups, records, settings, failed.keys()):
        outcomes = executor.map(choose, {name: slot for name, (_, slot) in todo.items()})
        unsaved: set[Path] = set()
        for done, outcome in enumerate(tracked(outcomes, "choosing", len(todo), track), start=1):
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
    """What is still to be chosen, by trial name; choices that came twice are dropped before."""
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
