"""Import of official command logs as scenes. They are left-handed with y up; our scenes are not.

A configuration is a folder with ``tdw_commands.json`` (or ``.json.gz``) and ``metadata.json``.
Each line of the log is a JSON list of commands followed by ``trial N``. The lists of a trial are
its frames; ``trial None`` prepares the room (docs/official-system.md, section 8).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError, PhysionError, UnknownNameError
from physion.core.names import CONTROLLERS
from physion.core.seeds import generator
from physion.numerics.rotations import rotate_vectors
from physion.scenes.looks import prop_look
from physion.scenes.scene import (
    FLOORS,
    Body,
    BodyEvent,
    Camera,
    Cloth,
    Ending,
    Joint,
    Look,
    Push,
    Roles,
    Scene,
    Vec3,
)
from physion.scenes.shapes.primitives import ModelBounds, prop_for, read_model_bounds, shapes
from physion.scenes.tdw.commands import (
    CommandReader,
    ImportFailure,
    LoggedObject,
    find_logs,
    read_command_log,
    read_metadata,
    vector,
)

SCENARIOS = {controller: scenario for scenario, controller in CONTROLLERS.items()}
"""Scenario by ``controller_name`` of the official metadata. Some Roll trials were made by the
Collide controller: a folder whose name contains ``rolling`` is Roll."""

MAX_FRAMES = {"collide": 152, "contain": 452, "link": 452, "support": 602, "drape": 151}
"""Frames of the longest trial, frame 0 included; 302 for others (docs/official-system.md, 2.6)."""

FLEX_SETTLE_FRAMES = 100


@dataclass(frozen=True)
class RecordedOutcome:
    """Outcome that the official simulator recorded for a trial in ``metadata.json``.

    - ``first_frame``: first frame with contact, counted from 0.
    - ``displacement``: as recorded, in our axes, metres: the final position of the agent minus the
      initial one of object 2, or, in Drop, minus the origin.
    - ``final_position``: of the agent in the last frame, in our axes, metres.
    - ``min_distance``: between cloth and zone, for cloth trials only.
    """

    contact: bool
    first_frame: int | None
    frames: int
    displacement: Vec3 | None = None
    min_distance: float | None = None
    final_position: Vec3 | None = None


@dataclass(frozen=True)
class ImportedTrial:
    """Imported scene with its recorded outcome. ``notes`` tell what was left out of the scene."""

    scene: Scene
    outcome: RecordedOutcome
    notes: tuple[str, ...] = ()


@dataclass
class TrialSet:
    """Result of importing a folder.

    ``unknown`` counts the commands that the importer does not know, ``logs`` are the files of the
    trials by name. Trials without an outcome in ``metadata.json`` are left out.
    """

    trials: list[ImportedTrial] = field(default_factory=list)
    logs: dict[str, list[Path]] = field(default_factory=dict)
    failures: list[ImportFailure] = field(default_factory=list)
    unknown: Counter[str] = field(default_factory=Counter)

    def require_trials(self) -> None:
        """Raise `BadInputError` with the first failure if nothing was imported."""
        if not self.trials:
            why = str(self.failures[0]) if self.failures else "no trial of this scenario"
            raise BadInputError(f"no trial could be imported: {why}")

    def unique(self) -> tuple[list[ImportedTrial], int]:
        """Return the trials with different physics, and the number of duplicates left out."""
        first: dict[str, ImportedTrial] = {}
        for trial in self.trials:
            first.setdefault(trial.scene.physics_digest(), trial)
        return list(first.values()), len(self.trials) - len(first)


def read_scenes(root: Path, scenario: str | None = None, limit: int | None = None) -> TrialSet:
    """Import all command logs in the folder ``root``.

    Parameters
    ----------
    root
        Folder that is searched for logs.
    scenario
        Import trials of this scenario only.
    limit
        Import at most this many trials of each scenario.

    Raises
    ------
    BadInputError
        If there is no log. A broken log or trial is a failure in the result instead.
    UnknownNameError
        For an unknown scenario.
    """
    if scenario is not None and scenario not in SCENARIOS.values():
        raise UnknownNameError("scenario", scenario, SCENARIOS.values())
    if limit is not None and limit < 1:
        raise BadInputError(f"the limit of trials must be 1 or more, not {limit}")
    result = TrialSet()
    bounds = _find_model_bounds(root)
    counts: Counter[str] = Counter()
    for log in find_logs(root):
        for trial in read_log(log, result, bounds):
            name = trial.scene.scenario
            if scenario not in (None, name) or (limit is not None and counts[name] >= limit):
                continue
            counts[name] += 1
            result.trials.append(trial)
            result.logs.setdefault(trial.scene.name, []).append(log)
    return result


def read_log(
    path: Path, result: TrialSet, bounds: Mapping[str, ModelBounds] | None = None
) -> Iterator[ImportedTrial]:
    """Yield the trials of one log; add failures and unknown commands to ``result``."""
    try:
        records = read_metadata(path.parent / "metadata.json")
        log = read_command_log(path)
    except PhysionError as error:
        result.failures.append(ImportFailure(str(path), None, str(error)))
        return
    result.failures += log.failures
    for tag, frames in log.trials.items():
        try:
            if tag not in records:
                # Logs of familiarization trials contain more trials than were used.
                continue
            commands = CommandReader(result.unknown)
            commands.read(log.setup, frames)
            builder = _SceneBuilder(commands, records[tag], path.parent, bounds or {})
            yield ImportedTrial(builder.scene(), builder.outcome(), tuple(builder.notes))
        except PhysionError as error:
            result.failures.append(ImportFailure(str(path), tag, str(error)))


def _find_model_bounds(root: Path) -> Mapping[str, ModelBounds]:
    for folder in (root, *root.resolve().parents[:3]):
        if (folder / "model_bounds.json").is_file():
            return read_model_bounds(folder / "model_bounds.json")
    packaged = Path(str(files("physion") / "data" / "official_study" / "model_bounds.json"))
    return read_model_bounds(packaged) if packaged.is_file() else {}


class _SceneBuilder:
    """Builder of the scene and the outcome of one trial from its executed commands."""

    def __init__(
        self,
        read: CommandReader,
        record: Mapping[str, Any],
        folder: Path,
        bounds: Mapping[str, ModelBounds],
    ) -> None:
        self.commands, self.record, self.folder, self.bounds = read, record, folder, bounds
        self.notes = read.notes

    def scene(self) -> Scene:
        kept: list[LoggedObject] = []
        for thing in (*self.commands.replaced, *self.commands.objects.values()):
            if thing.gone:
                continue
            if thing.vanishing:
                self.notes.append(f"{thing.name} has no size or no mass and is left out")
                continue
            kept.append(thing)
        by_name = {thing.name: thing for thing in kept}
        scenario = self._scenario()
        pushes = tuple(push for push in self.commands.pushes if push.body in by_name)
        index = self.record.get("trial_num", self.record.get("stimulus_name"))
        return Scene(
            name=str(self.record.get("stimulus_name") or f"{self.folder.name}_{index}"),
            scenario=scenario,
            bodies=tuple(self._body(thing) for thing in kept if thing.cloth is None),
            cloths=tuple(self._cloth(thing) for thing in kept if thing.cloth is not None),
            pushes=pushes,
            joints=tuple(
                Joint(a, b) for a, b in self.commands.joints if a in by_name and b in by_name
            ),
            roles=self._roles(kept, pushes),
            camera=Camera(self.commands.eye, self.commands.target, self.commands.fov),
            room=self.commands.room,
            floor=FLOORS[self.commands.room],
            ending=Ending(151, self._max_frames(scenario)),
            settle_frames=FLEX_SETTLE_FRAMES if self.commands.settles else 0,
            events=tuple(
                self._event(event, by_name[event.body])
                for event in self.commands.events
                if event.body in by_name
            ),
            parameters={
                "source": "official command log",
                "configuration": self.folder.name,
                "trial_seed": self.record.get("trial_seed"),
            },
        )

    def _scenario(self) -> str:
        controller = str(self.record.get("controller_name"))
        if "rolling" in self.folder.name.lower():
            return "roll"
        if controller not in SCENARIOS:
            raise BadInputError(
                f"metadata.json names the controller {controller!r}; known: {sorted(SCENARIOS)}"
            )
        return SCENARIOS[controller]

    def _max_frames(self, scenario: str) -> int:
        by_collision = self.record.get("controller_name") == "Collision"
        return MAX_FRAMES["collide"] if by_collision else MAX_FRAMES.get(scenario, 302)

    def _roles(self, kept: list[LoggedObject], pushes: tuple[Push, ...]) -> Roles:
        """Find the roles: the lowest id is the zone, 2 the target (or the last of its colour).

        The latter where another object of its colour takes its place."""
        by_id = {thing.id: thing for thing in kept}
        if not kept:
            raise BadInputError("no object is left in the trial")
        zone = by_id[min(by_id)]
        first = self.commands.objects.get(2)
        if first is None or zone.id == 2:
            raise BadInputError("there is no object with id 2, the target")
        agent: LoggedObject | None = first
        alike = [t for t in kept if t.id > 2 and t.color == first.color]
        if first.gone or any(t.created == first.destroyed for t in alike):
            agent = max(alike, key=lambda t: t.id) if alike else None
        if agent is None or agent.id not in by_id:
            raise BadInputError("the target was removed and no other object has its colour")
        probe = pushes[0].body if pushes else None
        return Roles(agent=agent.name, patient=zone.name, probe=probe)

    def _look(self, thing: LoggedObject) -> Look:
        if thing.color is None and thing.model not in shapes:
            # Library models have their own textures: a model looks the same in every trial.
            rng = generator("library model", thing.model)
            return prop_look(rng, prop_for(thing.category, thing.model))
        return Look(thing.color or (0.8, 0.8, 0.8), thing.texture)

    def _body(self, thing: LoggedObject) -> Body:
        primitive = thing.model in shapes
        shape, scale, position = thing.model, thing.scale, thing.position
        if not primitive:
            shape, scale, position = self._prop(thing)
        return Body(
            name=thing.name,
            shape=shape,
            position=position,
            scale=scale,
            rotation=thing.rotation,
            mass=1.0 if thing.mass is None else thing.mass,
            contact=thing.contact,
            # Solids of Flex rest on the floor and do not move after settling.
            kinematic=thing.kinematic or thing.mass is None or thing.flex,
            scenery=thing.mass is None,
            drag=thing.drag,
            angular_drag=thing.angular_drag,
            look=self._look(thing),
        )

    def _event(self, event: BodyEvent, thing: LoggedObject) -> BodyEvent:
        """Return an event with the position of the pivot, which for props is not the log's."""
        if event.position is None or thing.model in shapes:
            return event
        moved = replace(thing, position=event.position, rotation=event.rotation or thing.rotation)
        return replace(event, position=self._prop(moved)[2])

    def _prop(self, thing: LoggedObject) -> tuple[str, Vec3, Vec3]:
        """Return shape, scale and position of the prop that fills the bounds of a library model."""
        bounds = self.bounds.get(thing.model)
        if bounds is None:
            self.notes.append(f"no bounds are known for {thing.model!r}; it gets a size of 0.5 m")
            bounds = ModelBounds((0.0, 0.0, 0.0), (0.5, 0.5, 0.5))
        size = tuple(a * b for a, b in zip(bounds.size, thing.scale, strict=True))
        shift = tuple(a * b for a, b in zip(bounds.bottom, thing.scale, strict=True))
        x, y, z = rotate_vectors(thing.rotation, shift).tolist()
        px, py, pz = thing.position
        return prop_for(thing.category, thing.model), size, (px + x, py + y, pz + z)  # type: ignore[return-value]

    def _cloth(self, thing: LoggedObject) -> Cloth:
        assert thing.cloth is not None
        stretch, bend, tether = thing.cloth
        return Cloth(
            name=thing.name,
            position=thing.position,
            size=(2.0 * thing.scale[0], 2.0 * thing.scale[1], 0.0),
            rotation=thing.rotation,
            mass=0.5 if thing.mass is None else thing.mass,
            stretch=stretch,
            bend=bend,
            tether=tether,
            look=replace(self._look(thing), texture="cloth"),
        )

    def outcome(self) -> RecordedOutcome:
        record = self.record
        contact = record.get("does_target_contact_zone")
        if not isinstance(contact, bool):
            raise BadInputError(
                "metadata.json has no does_target_contact_zone (true or false) for it"
            )
        first = record.get("first_target_contact_zone_frame")
        moved = record.get("final_target_displacement")
        displacement = vector(moved) if isinstance(moved, dict) else None
        return RecordedOutcome(
            contact=contact,
            first_frame=int(first) if isinstance(first, int) else None,
            frames=int(record.get("num_frames") or 0),
            displacement=displacement,
            min_distance=record.get("minimum_distance_target_to_zone"),
            final_position=self._final_position(displacement),
        )

    def _final_position(self, displacement: Vec3 | None) -> Vec3 | None:
        """Return where the agent was in the last frame, from what the log's displacement is of.

        It is of object 2, also where the controller has replaced that one by another agent; the
        controller of Drop records the position itself.
        """
        first = self.commands.objects.get(2)
        if displacement is None or first is None:
            return None
        origin = (0.0, 0.0, 0.0) if self._scenario() == "drop" else first.position
        x, y, z = (a + b for a, b in zip(origin, displacement, strict=True))
        return (x, y, z)
