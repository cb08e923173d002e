"""The rigid-body engine, written after PhysX 4.

See `physion.physics.rigid.step` for what happens in a step of 0.01 s, which is one frame. The same
scene gives the same bytes: nothing here is random or dependent on time, and threads only share
what does not change.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from physion.errors import BadInputError
from physion.golden import version_digest
from physion.physics.cloth.simulate import ClothSettings, add_cloth, settle_solids
from physion.physics.rigid.settings import RigidSettings
from physion.physics.rigid.simulate import simulate_rigid
from physion.physics.trajectory import State, Trajectory
from physion.scenes.scene import Scene

VERSION = 3
"""Version of the motion: to be raised, with the golden digests, when scenes move differently."""


class RigidEngine:
    """Simulator of rigid bodies, and of cloth that falls on them.

    Rigid bodies are moved first, by `simulate_rigid`; cloths then follow in
    `physion.physics.cloth.simulate`, without acting back on them. ``threads`` limits those of
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

        The digest is that of the golden motions: engines of the same name move scenes alike.
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
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
