"""The rigid-body engine, written after PhysX 4.

See `physion.physics.rigid.step` for what happens in a step of 0.01 s, which is one frame. The same
scene gives the same bytes: nothing here is random or dependent on time, and threads only share
what does not change.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from physion.compute.local import available_cores
from physion.core.errors import BadInputError
from physion.core.version import version_digest
from physion.numerics.linear_algebra import unit
from physion.physics.cloth.simulate import ClothSettings, add_cloth, settle_solids
from physion.physics.rigid.bodies import RigidSettings
from physion.physics.rigid.step import RigidRun
from physion.physics.trajectory import Contacts, State, Trajectory
from physion.scenes.scene import Scene

F64 = NDArray[np.float64]


# Simulation of a scene whose bodies may appear, vanish and be moved: one run for each stretch
# between such events.


def simulate_rigid(
    scene: Scene,
    settings: RigidSettings,
    engine: str,
    start: State | None,
    least: int,
    most: int,
    until_touch: bool,
) -> Trajectory:
    """Simulate rigid bodies until the scene ends.

    Parameters
    ----------
    scene, settings
        What is simulated, and how.
    engine : str
        Name to be stored with the result.
    start : State, optional
        Instant from which to continue; it becomes frame 0.
    least, most : int
        Frames: the scene ends when all bodies are at rest between them, and at the latest at
        ``most``.
    until_touch : bool
        Stop after the first frame in which agent and patient touch.
    """
    first = 0 if start is None else start.frame
    events = sorted({e.frame for e in scene.events if first < e.frame < first + most})
    if start is not None and scene.events:
        # Earlier events may have put bodies elsewhere that do not move by themselves.
        scene = _at_poses(scene, start.positions, unit(start.rotations))
    run = RigidRun(scene, settings, start, scene.present(first))
    if not events:
        run.run(least, most, until_touch)
        return run.trajectory(engine)
    # Between events the bodies that are there do not change: each stretch is a run of its own.
    parts: list[Trajectory] = []
    frames = 0
    for event, after in zip([None, *events], [*events, None], strict=True):
        if event is not None:
            scene, state = _take_events(scene, _last_state(parts[-1], event - 1), event)
            run = RigidRun(scene, settings, present=scene.present(event))
            run.restore(state)
            run.first_frame = event
        if after is None:
            run.run(least - frames, most - frames, until_touch)
        else:
            stretch = after - first - frames
            run.run(stretch, stretch, until_touch)
        parts.append(run.trajectory(engine))
        frames += len(parts[-1])
        if until_touch and run.touched:
            break
    return _join(parts)


def _last_state(part: Trajectory, frame: int) -> State:
    """Return the last state of a stretch, which is ``frame`` of the trial."""
    return replace(part.state(len(part) - 1), frame=frame)


def _take_events(scene: Scene, state: State, frame: int) -> tuple[Scene, State]:
    """Return scene and state after the events of ``frame``.

    The bodies of the scene are at the poses of the state, since joints hold from there on.
    """
    positions, rotations = state.positions.copy(), unit(state.rotations)
    velocities, spins = state.velocities.copy(), state.angular_velocities.copy()
    for event in scene.events:
        if event.frame != frame or event.body not in [body.name for body in scene.bodies]:
            continue
        i = scene.index(event.body)
        velocities[i] = spins[i] = 0.0
        if event.position is not None:
            positions[i] = event.position
        if event.rotation is not None:
            rotations[i] = unit(np.asarray(event.rotation))
    moved = replace(
        state,
        frame=frame,
        positions=positions,
        rotations=rotations,
        velocities=velocities,
        angular_velocities=spins,
    )
    return _at_poses(scene, positions, rotations), moved


def _at_poses(scene: Scene, positions: F64, rotations: F64) -> Scene:
    """Return the scene with its bodies at other poses (N, 3), (N, 4)."""
    bodies = tuple(
        replace(body, position=tuple(p.tolist()), rotation=tuple(q.tolist()))
        for body, p, q in zip(scene.bodies, positions, rotations, strict=True)
    )
    return replace(scene, bodies=bodies)


def _join(parts: list[Trajectory]) -> Trajectory:
    """Return stretches of one trial as one trajectory."""
    starts = np.cumsum([0, *(len(part) for part in parts)])
    contacts = [part.contacts for part in parts]

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    def joined_contacts(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in contacts])

    shifted = [part.frame + int(at) for part, at in zip(contacts, starts, strict=False)]
    return Trajectory(
        positions=joined("positions"),
        rotations=joined("rotations"),
        velocities=joined("velocities"),
        angular_velocities=joined("angular_velocities"),
        cloth_vertices=joined("cloth_vertices"),
        cloth_distance=joined("cloth_distance"),
        contacts=Contacts(
            frame=np.concatenate(shifted).astype(np.int32),
            bodies=joined_contacts("bodies"),
            point=joined_contacts("point"),
            normal=joined_contacts("normal"),
            impulse=joined_contacts("impulse"),
        ),
        completed=parts[-1].completed,
        engine=parts[-1].engine,
    )


VERSION = 3
"""Version of the motion: to be raised, with the golden digests, when scenes move differently."""


class RigidEngine:
    """Simulator of rigid bodies, and of cloth that falls on them.

    Rigid bodies are moved first, by `simulate_rigid`; cloths then follow in
    `physion.physics.cloth.simulate`, without acting back on them. ``threads`` limits the threads of
    `simulate_many`, by default to ``OMP_NUM_THREADS`` or the number of processor cores.
    """

    def __init__(
        self,
        settings: RigidSettings | None = None,
        cloth: ClothSettings | None = None,
        threads: int | None = None,
    ) -> None:
        self.threads = threads
        self.settings = settings if settings is not None else RigidSettings()
        self.cloth = cloth if cloth is not None else ClothSettings()

    @property
    def name(self) -> str:
        """``physion-<version>.<digest>.<settings>.<cloth settings>``.

        The digest covers the golden motions: engines of the same name move scenes alike.
        """
        tags = f"{self.settings.tag()}.{self.cloth.tag()}"
        return f"physion-{VERSION}.{version_digest('motion')}.{tags}"

    def simulate(
        self,
        scene: Scene,
        *,
        start: State | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> Trajectory:
        """Simulate ``scene`` until it ends; see `physion.physics.engine.Engine.simulate`."""
        least, most = scene.ending.frame_limits(frames)
        scene = settle_solids(scene, self.cloth)
        if scene.cloths:
            # Cloth does not sleep: with it a trial takes its whole time.
            least = most
        # With cloth, its contact is what is asked for, and bodies are needed until then.
        until_touch = until_contact and not scene.cloths
        rigid = simulate_rigid(scene, self.settings, self.name, start, least, most, until_touch)
        if not scene.cloths:
            return rigid
        return add_cloth(scene, rigid, self.cloth, start=start, until_contact=until_contact)

    def simulate_many(
        self,
        scenes: Sequence[Scene],
        *,
        starts: Sequence[State] | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> list[Trajectory]:
        """Simulate several scenes in threads; see `physion.physics.engine.SimulatesMany`.

        The compiled steps run without Python's lock, one thread for each processor core. Each run
        has arrays of its own, so that the number of threads does not change a byte.
        """

        if starts is not None and len(starts) != len(scenes):
            raise BadInputError(f"{len(scenes)} scenes need as many starts, not {len(starts)}")

        def run(index: int) -> Trajectory:
            start = None if starts is None else starts[index]
            return self.simulate(
                scenes[index], start=start, frames=frames, until_contact=until_contact
            )

        threads = min(self.threads or _default_threads(), len(scenes))
        if threads <= 1:
            return [run(index) for index in range(len(scenes))]
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(run, range(len(scenes))))


def _default_threads() -> int:
    """Return ``OMP_NUM_THREADS``, which worker processes have at 1, or the number of cores."""
    given = os.environ.get("OMP_NUM_THREADS", "")
    if given.isdigit() and int(given) > 0:
        return int(given)
    return available_cores()
