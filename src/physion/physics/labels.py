"""Labels of a trial: whether and when agent and patient touch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from physion.numerics.elementary import standard_normal
from physion.physics.cloth.solver import CLOTH_CONTACT_GAP
from physion.physics.trajectory import Ints, Trajectory
from physion.scenes.scene import OBSERVED_FRAMES, Scene, Vec3


@dataclass(frozen=True)
class Labels:
    """Contact between agent and patient in one trial.

    - ``contact``: they touch in some frame of the trial.
    - ``first_frame``: the first such frame, None without contact.
    - ``observed``: they touch within the observed frames, so that nothing is left to predict; None
      if that is not known, of an imported contact whose frame is not.
    - ``min_distance``: smallest gap between cloth and patient in metres, None without cloth.
    - ``robust``: fraction of jittered simulations with the same outcome, None if not measured.
    """

    contact: bool
    first_frame: int | None
    observed: bool | None
    min_distance: float | None = None
    robust: float | None = None


def contact_frames(scene: Scene, trajectory: Trajectory, start: int = 0) -> Ints:
    """Return the sorted frames of the trajectory in which agent and patient touch.

    Between bodies, those with a contact; between a cloth and a body, those with a gap below
    `CLOTH_CONTACT_GAP`. A body that is absent touches nothing; ``start`` is the frame of the scene
    that the trajectory begins with.
    """
    agent, patient = scene.index(scene.roles.agent), scene.index(scene.roles.patient)
    if max(agent, patient) < len(scene.bodies):
        frames = trajectory.contacts.frames_of(agent, patient)
    else:
        gaps = trajectory.cloth_distance
        frames = np.flatnonzero(gaps < CLOTH_CONTACT_GAP).astype(np.int32)
    if not scene.events:
        return frames
    present = [scene.present(start + frame) for frame in frames.tolist()]
    both = np.array([there[agent] and there[patient] for there in present], np.bool_)
    return np.asarray(frames[both])


def label_contact(scene: Scene, trajectory: Trajectory) -> Labels:
    """Return whether and when agent and patient of a scene touch.

    Parameters
    ----------
    scene
        The scene, which names agent and patient.
    trajectory
        Its motion, as `physion.simulate` gives it.

    Returns
    -------
    labels
        Contact or not, its first frame, and whether it lies in the observed part.

    Examples
    --------
    >>> from physion import sample_scene, simulate
    >>> scene = sample_scene("collide", 3)
    >>> label_contact(scene, simulate(scene)).contact
    True
    """
    frames = contact_frames(scene, trajectory)
    agent, patient = scene.index(scene.roles.agent), scene.index(scene.roles.patient)
    gaps = trajectory.cloth_distance
    with_cloth = max(agent, patient) >= len(scene.bodies)
    measured = with_cloth and bool(np.isfinite(gaps).any())
    first = int(frames[0]) if len(frames) else None
    return Labels(
        contact=first is not None,
        first_frame=first,
        observed=first is not None and first < OBSERVED_FRAMES,
        min_distance=float(np.nanmin(gaps)) if measured else None,
    )


# Perturb the initial positions of a scene slightly, to test whether its outcome is robust.


def jitter_scene(scene: Scene, distance: float, rng: np.random.Generator) -> Scene:
    """Return the scene with movable bodies and cloths shifted horizontally by normal noise.

    ``distance`` is the standard deviation in metres along x and along y. Joined bodies are shifted
    together, and the point of a push with its body.
    """
    leaders = {joint.child: joint.parent for joint in scene.joints}
    moving = [body.name for body in scene.bodies if not (body.kinematic or body.scenery)]
    moving += [cloth.name for cloth in scene.cloths]
    draws = (distance * standard_normal(rng, (len(moving), 2))).tolist()
    shifts = {name: (x, y, 0.0) for name, (x, y) in zip(moving, draws, strict=True)}

    def moved(name: str, position: Vec3) -> Vec3:
        visited = {name}
        # Joints may close a ring: stop before a body is met again.
        while name in leaders and leaders[name] not in visited:
            name = leaders[name]
            visited.add(name)
        dx, dy, dz = shifts.get(name, (0.0, 0.0, 0.0))
        return (position[0] + dx, position[1] + dy, position[2] + dz)

    return replace(
        scene,
        bodies=tuple(replace(b, position=moved(b.name, b.position)) for b in scene.bodies),
        cloths=tuple(replace(c, position=moved(c.name, c.position)) for c in scene.cloths),
        pushes=tuple(
            p if p.point is None else replace(p, point=moved(p.body, p.point)) for p in scene.pushes
        ),
    )


def pair_agreement(outcomes: np.ndarray) -> float:
    """Return the probability that two different runs of one scene have the same outcome.

    ``outcomes`` (R,) are bool, one for each run; NaN for fewer than two. With h of R runs True
    it is (h (h - 1) + (R - h) (R - h - 1)) / (R (R - 1)).
    """
    runs, hits = len(outcomes), int(np.count_nonzero(outcomes))
    if runs < 2:
        return float("nan")
    return (hits * (hits - 1) + (runs - hits) * (runs - hits - 1)) / (runs * (runs - 1))
