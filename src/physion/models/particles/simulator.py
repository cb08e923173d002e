"""Learned simulators of particles: GNS, GNS-RANSAC and DPI-Net.

Of every object a simulator knows the last two poses, of a cloth the last two positions of its
particles. If it keeps its motion, a particle at x moves by u (`networks`). The network predicts
what is added to this motion:

- GNS: a change a of the displacement of every particle, x' = x + u + a. Bodies deform in the size
  paper. In the size small the rigid motion that fits the x' of a body best keeps it rigid.
- GNS-RANSAC: the same network and the same training. In a rollout a rigid motion is fitted to the
  x' of those particles of a body that agree with one another, and keeps it rigid in every step.
- DPI-Net: changes of velocity and spin of every body, and of the displacements of the particles of
  cloths.

The loss is the squared distance of the predicted particles from where they went, in units of
`CHANGE`, averaged over the particles of an object, then over objects; above
``knee`` it grows linearly (`_softened`).

Source: paper, section 4 and supplement; docs/official-system.md, section 6. It differs from the
published code in what the module `networks` says, and in particles that lie on surfaces, where
contacts happen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from physion.clips.batch import (
    LAST_OBSERVED,
    Batch,
    Motion,
    Provenance,
    Rollout,
    Spec,
    cut_to_observed,
)
from physion.core.errors import BadInputError
from physion.core.seeds import generator
from physion.models.checkpoint import load_named
from physion.models.gaps import FAR
from physion.models.interface import RANDOM, LearnsFrom, SizedSettings, Sizes, TrainingSettings
from physion.models.noisy_simulation import best_threshold
from physion.models.particles.bodies import (
    CLOTH,
    KINEMATIC,
    RIGID,
    Poses,
    Sampling,
    SceneParticles,
    fit_rigid,
    fit_robust,
    join_poses_in_time,
    later_poses,
    mean_by,
    particle_positions,
    poses_of,
    put_by_events,
    rotation_from_vector,
    scene_particles,
    vector_from_rotation,
)
from physion.models.particles.networks import (
    Drift,
    Graph,
    MessageNetwork,
    ObjectNetwork,
    ObjectState,
    SceneLayout,
    drift_of,
    make_graph,
    move,
    move_loose,
)
from physion.models.particles.rollout import (
    Start,
    Window,
    disturbed,
    disturbed_start,
    point_distances,
    read_window,
    roll_out,
    rotated,
    smallest_distance,
    start_probabilities,
)
from physion.models.torch_model import TorchModel, initial_weights, weights_digest
from physion.physics.labels import label_contact
from physion.scenes.scene import FRAME_TIME

MESSAGES, OBJECTS = "messages", "objects"
"""Networks: messages between particles (GNS), and changes of whole objects (DPI-Net)."""

FREE, RANSAC, RELEASED, WHOLE = "free", "ransac", "released", "whole"
"""What keeps bodies rigid: nothing, a rigid motion fitted by RANSAC, one fitted to all particles as
in the released code of GNS-RANSAC, and a network that moves bodies as wholes (DPI-Net)."""
_RIGID = {
    "small": {"gns": RELEASED, "gns-ransac": RANSAC, "dpi": WHOLE},
    "paper": {"gns": FREE, "gns-ransac": RANSAC, "dpi": WHOLE},
}
"""By size and model. The shipped weights of the size small never saw a body that deforms."""

_SMALL: Mapping[str, Mapping[str, Any]] = {
    MESSAGES: {"rounds": 5, "limit": 50, "inner": 6},
    OBJECTS: {"rounds": 3},
}
_PAPER: Mapping[str, Mapping[str, Any]] = {
    MESSAGES: {"rounds": 10, "free_training": True},
    OBJECTS: {"rounds": 4},
}


@dataclass(frozen=True, kw_only=True)
class ParticleSettings(SizedSettings):
    """Settings of a particle model; also see `SizedSettings`. Some differ between GNS and DPI-Net.

    - ``swept``: whether particles that come close during a step are neighbours.
    - ``samples``: futures of a trial, and ``spread``: standard deviation of the noise on their
      initial velocities, m/s. One future has no noise.
    - ``stride``: frames of 0.01 s in one step, 3 or 1.
    - ``future``: steps of a rollout at most; None: to the end of the trial.
    - ``width``, ``rounds``: of the network.
    - ``rigid``: what keeps bodies rigid in a rollout: ``free`` (nothing), ``ransac``, ``released``
      (a fit to all particles), or ``whole`` for DPI-Net.
    - ``free_training``: whether bodies deform in the training of GNS and GNS-RANSAC, which are
      trained alike; otherwise a fit to all particles keeps them rigid there.
    - ``spacing``, ``limit``, ``still_limit``, ``cloth_step``, ``inner``, ``within``: how objects
      become particles (`Sampling`).
    - ``radius``: metres within which particles are neighbours, of different objects, and with
      ``within`` of the same; the paper's threshold of .08 in the size paper. In the size small
      particles are .10 m apart, so that .08 would join hardly any.
    - ``velocity_noise``, ``relative_noise``: metres a step, and fraction of the speed; standard
      deviations of the noise in training, drawn for every rigid body and for every particle of a
      cloth. Noise that is large compared with a slow motion teaches that it stops.
    - ``pushforward``: steps that follow the first one in training. They start from what the network
      predicted, without gradient, so that it learns to correct its own errors (Brandstetter et al.
      2022, section 3.1).
    - ``abrupt``: fraction of the training windows that are drawn from moments at which bodies
      change their velocity abruptly, as at contacts (`rollout.start_probabilities`); the others
      are drawn from all moments.
    - ``rest``: metres a step; in a rollout a body whose centre and rim would move less together
      stays where it is, as bodies sleep in physics engines. Otherwise small errors, which add up as
      a velocity, tip what stands.
    - ``knee``: errors of an object count squared up to this many units (`CHANGE`), and linearly
      beyond.
    - ``gap_spacing``, ``gap_limit``: of the points by which distances are measured. In the size
      paper they are the particles; in the size small particles would be too far apart.
    - ``calibrated``: whether the distance of the decision ``touch`` is fitted after a training, on
      the contacts of training trials. The paper's models see no such labels.
    """

    model: str = "gns"
    swept: bool = True
    samples: int = 1
    spread: float = 0.05
    stride: Literal[1, 3] = 3
    future: int | None = None
    width: int = 64
    rounds: int = 3
    rigid: Literal["free", "ransac", "released", "whole"] = "released"
    free_training: bool = False
    spacing: float = 0.10
    limit: int = 100
    still_limit: int = 600
    cloth_step: int = 3
    inner: int = 0
    within: bool = False
    radius: float = 0.12
    velocity_noise: float = 3e-4
    relative_noise: float = 0.02
    pushforward: int = 1
    abrupt: float = 0.5
    rest: float = 3e-4
    knee: float = 1.0
    gap_spacing: float = 0.04
    gap_limit: int = 300
    calibrated: bool = False

    sizes: ClassVar[Sizes] = {
        "small": {},
        "paper": {
            "width": 128, "spacing": 0.05, "limit": 1000, "cloth_step": 1, "radius": 0.08,
            "within": True, "swept": False, "gap_spacing": 0.05, "gap_limit": 1000,
        },
    }  # fmt: skip
    any_weights: ClassVar[frozenset[str]] = SizedSettings.any_weights | {
        "spread", "rigid", "calibrated", "future",
    }  # fmt: skip

    @classmethod
    def defaults(cls, model: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings of a size, a network, and a length of the step."""
        sized = dict(super().defaults(model, options))
        small = options.get("size", "small") == "small"
        sized |= (_SMALL if small else _PAPER)[network_of(model)]
        sized["rigid"] = _RIGID["small" if small else "paper"][model]
        if options.get("stride") == 1:
            # A shorter step: what is counted in metres a step is less. Nothing is shipped for it.
            sized |= {"velocity_noise": cls.velocity_noise / 3, "rest": cls.rest / 3}
        return sized

    @property
    def network(self) -> str:
        """Kind of the network, `MESSAGES` or `OBJECTS`."""
        return network_of(self.model)

    @property
    def sampling(self) -> Sampling:
        """How objects become particles."""
        return self._sampling(free=self.rigid == FREE)

    @property
    def training_sampling(self) -> Sampling:
        """How objects become particles in a training."""
        return self._sampling(free=self.free_training)

    def _sampling(self, *, free: bool) -> Sampling:
        return Sampling(
            self.spacing, self.limit, self.still_limit, self.cloth_step, self.inner,
            within=self.within, free=free,
        )  # fmt: skip

    @property
    def contact_distance(self) -> float:
        """Metres at which points of agent and patient count as touching; see `CONTACT_SPACINGS`."""
        return CONTACT_SPACINGS * self.gap_spacing

    def __post_init__(self) -> None:
        if (self.rigid == WHOLE) != (self.network == OBJECTS):
            raise BadInputError(f"{self.model}: rigid={self.rigid} is not for this model")
        self.at_least(1, "samples", "width", "rounds", "gap_limit")
        self.at_least(0, "spread", "pushforward", "velocity_noise", "relative_noise", "rest")
        if self.future is not None:
            self.at_least(1, "future")
        _ = self.sampling  # which checks its numbers


def network_of(model: str) -> str:
    """Return the network of a model by its name."""
    return OBJECTS if model == "dpi" else MESSAGES


_SMALL_TRAINING = TrainingSettings(
    steps=7000,
    batch=24,
    learning_rate=2e-3,
    schedule="cosine",
    warmup=100,
    clip=0.0,
    validate_every=500,
    log_every=50,
    checkpoint_every=500,
)
_PAPER_TRAINING = replace(
    _SMALL_TRAINING,
    steps=1_500_000,
    batch=2,
    learning_rate=1e-4,
    schedule="plateau",
    warmup=0,
    validate_every=5000,
)
"""Adam from 1e-4 for 1.5 million steps, as in the paper; batch and schedule as released. The size
small has a rate of 2e-3, since it learns for a hundredth of these steps."""


def training_of(settings: ParticleSettings) -> TrainingSettings:
    """Return optimiser and schedule; the small size made the shipped weights."""
    if settings.size != "small":
        return _PAPER_TRAINING
    small = _SMALL_TRAINING
    return replace(small, steps=16_000) if settings.network == OBJECTS else small


# Imagined motions of trials: their start, how near agent and patient come, and what is shown.

F64 = NDArray[np.float64]
Futures = list[tuple[SceneParticles, Poses]]
"""Particles and motion of every sample of a trial."""


def observed_start(motion: Motion, frames: range, sampling: Sampling) -> Start:
    """Return the observed motion of a scene in these frames, and the steps to its end."""
    scene = motion.scene
    own = scene_particles(scene, sampling, scene.present(LAST_OBSERVED))
    poses = poses_of(own, motion, frames)
    # What was put somewhere between the last two steps did not move there.
    put = np.isin(own.things, put_by_events(scene, frames[-2], frames[-1]))
    loose = put[own.owners[own.loose]]
    poses.centers[-2, put], poses.rotations[-2, put], poses.loose[-2, loose] = (
        poses.centers[-1, put],
        poses.rotations[-1, put],
        poses.loose[-1, loose],
    )
    limit = scene.ending.frame_limits()[1] - 1 - LAST_OBSERVED
    return Start(own, poses, limit // frames.step)


def unseen_outcomes(
    motions: Sequence[Motion],
) -> tuple[list[Motion], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the trials (n) whose outcome follows the observed part, of whole motions.

    Returns
    -------
    observed : list of Motion
        Their observed parts.
    contact : ndarray
        Whether agent and patient touch (n,).
    cloth : ndarray
        Whether one of them is a cloth (n,).
    """
    observed, contact, cloth = [], [], []
    for motion in motions:
        scene, trajectory = motion.scene, motion.trajectory
        if len(trajectory) <= LAST_OBSERVED:
            continue
        label = label_contact(scene, trajectory)
        if not label.observed:
            observed.append(Motion(scene, cut_to_observed(scene, trajectory)))
            contact.append(label.contact)
            things = [scene.index(name) for name in (scene.roles.agent, scene.roles.patient)]
            cloth.append(max(things) >= len(scene.bodies))
    return observed, np.array(contact, np.bool_), np.array(cloth, np.bool_)


def join_futures(
    observed: Sequence[Start], imagined: Sequence[Poses], samples: int
) -> list[Futures]:
    """Return whole motions of ``samples`` futures of each trial, which follow one another."""
    joined = [
        (start.particles, join_poses_in_time(start.poses, later))
        for start, later in zip(observed, imagined, strict=True)
    ]
    return [joined[row : row + samples] for row in range(0, len(joined), samples)]


def shown_particles(futures: Sequence[Futures], observed: int) -> dict[str, NDArray[np.generic]]:
    """Return the particles of the frames after the first ``observed`` ones.

    They are ``particles`` (B, S, F, P, 3) in metres and ``things`` (B, P), the index of the object
    of each in `Scene.names`; NaN and -1 where a trial has fewer frames or particles than another.
    """
    clouds = [
        [particle_positions(particles, poses)[observed:] for particles, poses in own]
        for own in futures
    ]
    samples, parts = len(futures[0]), [cloud for own in clouds for cloud in own]
    frames, count = (max(cloud.shape[axis] for cloud in parts) for axis in (0, 1))
    shape = (len(futures), samples, frames, count, 3)
    positions = np.full(shape, np.nan, np.float32)
    things = np.full((len(futures), count), -1, np.int64)
    for row, own in enumerate(clouds):
        particles = futures[row][0][0]
        things[row, : len(particles.owners)] = particles.things[particles.owners]
        for sample, cloud in enumerate(own):
            positions[row, sample, : cloud.shape[0], : cloud.shape[1]] = cloud
    return {"particles": positions, "things": things}


VERSIONS = {MESSAGES: 3, OBJECTS: 4}
"""By network; to be raised with every change of what equal weights predict, or of the training."""
UNIT, CHANGE = 0.06, 0.02
"""Metres a step of 3 frames: units of displacements, and of their changes. A body that falls for
0.03 s changes its displacement by 0.009 m, one that moves at 1 m/s moves 0.03 m. In steps of s
frames the units are those times s / 3 and (s / 3)²."""
_DISTANCES = 1
"""To be raised with every change of the distances that equal motions have."""
_AT_ONCE = 32
"""Scenes of one graph when the distances are fitted."""
_TOGETHER = 4
"""Scenes of one graph on a CPU. The published scores were computed with 4; another number changes
rounding, and with it the rollouts of a few scenes."""
CONTACT_SPACINGS = 1.5
"""Distance in spacings at which points of two objects count as touching. The points of a surface
are at least a spacing apart, and every place on it has one within a spacing. Where two surfaces
touch, points of both are thus within two spacings of each other; 1.5 is what the released code
has, .075 m at .05 m."""
_HYPOTHESES = 16
"""Random choices of particles in a robust fit."""
_INLIER = 0.1
"""Distance in spacings within which a particle agrees with a rigid motion."""


class ParticleSimulator(TorchModel):
    """GNS, GNS-RANSAC or DPI-Net, by name: a graph network that learns how particles move.

    It imagines by moving them step by step.

    ``touch`` (2,): metres; agent and patient touch if they come at most this close, two bodies and
    a cloth and a body. It is fitted after training (`calibrate`) and stored with the weights.
    """

    learns_from: LearnsFrom = "states"
    calibration_trials = 256
    touch: Tensor

    settings: ParticleSettings

    def __init__(self, settings: ParticleSettings) -> None:
        super().__init__()
        settings.check_shipped()
        self.settings = settings
        self.name = f"{settings.model}-{settings.size}"
        self.training_settings = training_of(settings)
        self.window = 3 + settings.pushforward
        self.samples, self.seed = settings.samples, settings.seed
        stride = settings.stride
        self._unit, self._change = UNIT * (stride / 3), CHANGE * (stride / 3) ** 2
        self.spec = Spec(
            inputs=("state",),
            stride=stride,
            context=LAST_OBSERVED // stride + 1,
            future=0,
            context_at="end",
        )
        with initial_weights("particle model", settings.seed):
            kind = MessageNetwork if settings.network == MESSAGES else ObjectNetwork
            self.network: nn.Module = kind(settings.width, settings.rounds)
        self.register_buffer("touch", torch.zeros(2, dtype=torch.float64))
        load_named(self, settings.weights)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how another process makes the same model, on its CPU.

        Weights go there as arrays: torch would share their memory, which needs an open file for
        every tensor and task.
        """
        weights = {name: value.detach().cpu().numpy() for name, value in self.state_dict().items()}
        return _made_again, (self.settings, weights, self.init, self.trained)

    @property
    def trials_together(self) -> int:
        """Scenes that a process moves in one graph; 0 on a GPU, which is not shared."""
        return _TOGETHER if self.device.type == "cpu" else 0

    @property
    def decision(self) -> str:
        """Name of the decision, a fixed distance at the end of the rollout."""
        return "end"

    def provenance(self) -> Provenance:
        """Return name, size and origin of the weights; the name has a ``rigid`` of one's own."""
        settings = self.settings
        usual = settings.rigid == _RIGID[settings.size][settings.model]
        return Provenance(
            model=self.name if usual else f"{self.name}-{settings.rigid}",
            init=self.init,
            encoder_type="true state",
            dynamics_type="particles",
            dynamics_training_task="next positions",
            versions=f"torch {torch.__version__}",
        )

    @property
    def _weights_version(self) -> int:
        # Before, steps of one frame had the units of steps of three.
        return VERSIONS[self.settings.network] + (self.settings.stride == 1)

    def digest(self) -> str:
        """Return the SHA-256 of settings and weights; without the number of futures."""
        settings = asdict(self.settings)
        for name in ("weights", "seed", "samples", "calibrated"):
            settings.pop(name)
        if settings["future"] is None:
            del settings["future"]  # as before there was this setting
        parts = [self._weights_version, _DISTANCES, settings, torch.__version__]
        return weights_digest(parts, self.state_dict().items())

    def built_as(self) -> dict[str, Any]:
        """Return what the weights were made for: name, version, step, edges."""
        return {
            "model": self.name,
            "version": self._weights_version,
            "stride": self.settings.stride,
            "swept": self.settings.swept,
        }

    def start_probabilities(self, motion: Motion) -> F64:
        """Return how often a training window starts at each frame; see ``abrupt``."""
        return start_probabilities(
            motion.trajectory, self.settings.stride, self.window, self.settings.abrupt
        )

    # Nothing is prepared: units do not depend on clips. A few collisions decide the standard
    # deviation of changes, so that a sample of clips would give another loss for every seed.

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss of a batch of windows, the mean over the steps that are predicted.

        All steps but the first start from what the network predicted, without gradient.
        """
        settings = self.settings
        window = read_window(batch, settings.training_sampling, self.device)
        if not self.training:
            # A validation is without noise, as the loss of the trivial predictor is.
            return {"loss": self._loss(window, window.later[:1])}
        window = disturbed(rotated(window), settings.velocity_noise, settings.relative_noise)
        return {"loss": self._loss(window, window.later)}

    def baseline(self, batch: Batch) -> Tensor:
        """Return the loss of a prediction in which every object keeps its velocity."""
        window = read_window(batch, self.settings.sampling, self.device)
        drift = drift_of(window.layout, window.before, window.now)
        return self._error(window.layout, window.later[0], drift.positions + drift.moves)

    @torch.no_grad()
    def calibrate(self, whole: Batch) -> None:
        """Fit ``touch`` on rollouts of training trials, which start from the observed part.

        It uses the contacts of these trials, and does nothing without the option ``calibrated``.
        Trials with a contact in the observed part do not count.
        """
        self.touch.zero_()
        if not self.settings.calibrated:
            return
        motions, labels, cloth = unseen_outcomes(whole.state or ())
        if not motions:
            return
        parts = [motions[row : row + _AT_ONCE] for row in range(0, len(motions), _AT_ONCE)]
        gaps = np.concatenate([self.gaps(part, self.futures(part, 1, 0))[:, 0] for part in parts])
        for row, which in enumerate((~cloth, cloth)):
            self.touch[row] = best_threshold(gaps[which], labels[which])

    @torch.no_grad()
    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Return distances (B, S) of agent and patient in the imagined steps.

        ``gap`` is the smallest, less ``touch``, between steps too (`gaps`); ``end`` is the distance
        of points at the end, ``closest`` their smallest, both less `contact_distance`
        (`point_gaps`). With the argument ``show`` above 0, ``shown`` holds the imagined particles
        and their objects (`shown_particles`). The frames are 44 + s, 44 + 2 s, ... with the stride
        s.
        """
        if context.state is None:
            raise BadInputError("a particle model imagines from motions, which the batch lacks")
        futures = self.futures(context.state, samples, seed)
        shown = shown_particles(futures, self.spec.context) if arguments.get("show", 0) > 0 else {}
        end, closest = self.point_gaps(context.state, futures)
        gap = self.gaps(context.state, futures)
        return Rollout(gap=gap, end=end, closest=closest, shown=shown)

    @torch.no_grad()
    def futures(self, motions: Sequence[Motion], samples: int, seed: int) -> list[Futures]:
        """Return particles, and motion from frame 0 to the end, of every motion and sample.

        Rows are ``spec.stride`` frames apart; the last observed one is frame 44.
        """
        stride = self.settings.stride
        frames = range(LAST_OBSERVED % stride, LAST_OBSERVED + 1, stride)
        observed: list[Start] = []
        starts: list[Start] = []
        for motion in motions:
            start = observed_start(motion, frames, self.settings.sampling)
            if self.settings.future is not None:
                start = replace(start, steps=min(start.steps, self.settings.future))
            observed += [start] * samples
            for sample in range(samples):
                rng = generator("particle future", seed, motion.scene.name, sample)
                spread = self.settings.spread * FRAME_TIME * stride if samples > 1 else 0.0
                starts.append(disturbed_start(start, spread, rng))
        was_training = self.training
        self.eval()
        imagined = roll_out(starts, self.step, self.device, FRAME_TIME * stride)
        self.train(was_training)
        return join_futures(observed, imagined, samples)

    @torch.no_grad()
    def surprise(self, batch: Batch) -> F64:
        """Return how far an object is from where it was predicted (B, T), metres, the worst one.

        The distance is the root mean square over its particles, after the two steps before; the
        first two frames have 0. Objects that come or go do not count.
        """
        assert batch.state is not None, "the spec asks for states"
        frames = torch.as_tensor(batch.frames).cpu().numpy()
        found = np.zeros(frames.shape)
        for row, motion in enumerate(batch.state):
            for first in range(2, frames.shape[1], _AT_ONCE):
                steps = range(first, min(first + _AT_ONCE, frames.shape[1]))
                shown = np.stack([frames[row, step - 2 : step + 1] for step in steps])
                windows = Batch(
                    trials=(batch.trials[row],) * len(steps),
                    frames=shown,
                    valid=np.ones(shown.shape, np.bool_),
                    state=(motion,) * len(steps),
                )
                window = read_window(windows, self.settings.sampling, self.device)
                found[row, steps.start : steps.stop] = self._misses(window, len(steps))
        return found

    def _misses(self, window: Window, scenes: int) -> F64:
        """Return the largest distance of an object from its prediction, by scene."""
        layout = window.layout
        drift = drift_of(layout, window.before, window.now)
        robust = self.settings.rigid == RANSAC
        predicted, _ = self._predict_next(layout, window.now, drift, robust=robust)
        squares = (predicted - window.later[0].positions(layout)).pow(2).sum(-1)
        misses = mean_by(squares, layout.owners, layout.objects).sqrt()
        misses = misses * (layout.kinds != KINEMATIC)
        worst = misses.new_zeros(scenes).scatter_reduce(0, layout.scene, misses, "amax")
        return np.asarray(worst.double().cpu().numpy())

    def step(self, layout: SceneLayout, before: ObjectState, now: ObjectState) -> ObjectState:
        """Return the state after the next step."""
        drift = drift_of(layout, before, now)
        _, after = self._predict_next(layout, now, drift, robust=self.settings.rigid == RANSAC)
        return self._rested(layout, now, after)

    def _loss(self, window: Window, later: Sequence[ObjectState]) -> Tensor:
        layout, before, now = window.layout, window.before, window.now
        total = torch.zeros((), device=layout.shape.device)
        for target in later:
            drift = drift_of(layout, before, now)
            # Without RANSAC: GNS and GNS-RANSAC are trained alike.
            predicted, after = self._predict_next(layout, now, drift, robust=False)
            total = total + self._error(layout, target, predicted)
            before, now = now, self._rested(layout, now, after.detached())
        return total / len(later)

    def _predict_next(
        self, layout: SceneLayout, now: ObjectState, drift: Drift, *, robust: bool
    ) -> tuple[Tensor, ObjectState]:
        """Return the next positions of particles (P, 3), and the next state.

        Bodies that are not free in ``layout`` are rigid in it. The state of GNS has no gradient.
        """
        graph = self._graph(layout, drift)
        if not isinstance(self.network, MessageNetwork):
            state = self._move_objects(layout, now, drift, graph)
            return state.positions(layout), state
        changes = self._of_particles(graph, cast("Tensor", self.network(graph)))
        goal = drift.positions + drift.moves + changes
        with torch.no_grad():
            rigid = layout.kinds == RIGID
            centers, rotations = now.centers, rotation_from_vector(drift.spin) @ now.rotations
            if not bool(layout.soft_bodies.any()):
                fitted, centers = self._fit(layout, goal, robust=robust)
                # Fewer than three particles determine no rotation: such a body keeps its spin.
                few = (_counts(layout) < 3)[:, None, None]
                rotations = torch.where(few, rotations, fitted)
            state = ObjectState(
                torch.where(rigid[:, None], centers, now.centers),
                torch.where(rigid[:, None, None], rotations, now.rotations),
                now.loose,
            )
            return goal, move_loose(layout, state, drift, changes[layout.loose])

    def _rested(self, layout: SceneLayout, now: ObjectState, after: ObjectState) -> ObjectState:
        """Return the next state, but bodies that hardly move stay where they are."""
        turn = vector_from_rotation(after.rotations @ now.rotations.transpose(-1, -2))
        moved = (after.centers - now.centers).norm(dim=-1) + turn.norm(dim=-1) * layout.size
        rests = ((layout.kinds == RIGID) & (moved < self.settings.rest))[:, None]
        return ObjectState(
            torch.where(rests, now.centers, after.centers),
            torch.where(rests[:, None], now.rotations, after.rotations),
            torch.where(rests[layout.owners[layout.loose]], now.loose, after.loose),
        )

    def gaps(self, motions: Sequence[Motion], futures: Sequence[Futures]) -> F64:
        """Return the smallest gaps (B, S) of agent and patient, metres, less ``touch``.

        They count from frame 44 on. After a contact that was observed, by the rule of the label,
        they are -`FAR`, below every threshold that a decision can fit.
        """
        settings, touch = self.settings, self.touch.cpu().numpy()
        gaps = np.zeros((len(motions), len(futures[0])))
        for row, (motion, own) in enumerate(zip(motions, futures, strict=True)):
            for column, (particles, poses) in enumerate(own):
                later = later_poses(poses, self.spec.context - 1)
                distance = smallest_distance(
                    motion.scene, particles, later, settings.gap_spacing, settings.gap_limit
                )
                pair = [particles.agent, particles.patient]
                soft = min(pair) >= 0 and CLOTH in particles.kinds[pair]
                gaps[row, column] = distance - touch[int(soft)]
            if label_contact(motion.scene, motion.trajectory).observed:
                gaps[row] = -FAR
        return gaps

    def point_gaps(self, motions: Sequence[Motion], futures: Sequence[Futures]) -> tuple[F64, F64]:
        """Return the distances (B, S) of points of agent and patient, less `contact_distance`.

        The first is the distance at the end of the imagined motion. The second is the smallest from
        frame 44 on; after a contact that was observed it is -`FAR`.
        """
        settings = self.settings
        shape = (len(motions), len(futures[0]))
        end, closest = np.zeros(shape), np.zeros(shape)
        for row, (motion, own) in enumerate(zip(motions, futures, strict=True)):
            for column, (particles, poses) in enumerate(own):
                later = later_poses(poses, self.spec.context - 1)
                closest[row, column], end[row, column] = point_distances(
                    motion.scene, particles, later, settings.gap_spacing, settings.gap_limit
                )
            if label_contact(motion.scene, motion.trajectory).observed:
                closest[row] = -FAR
        return end - settings.contact_distance, closest - settings.contact_distance

    def _graph(self, layout: SceneLayout, drift: Drift) -> Graph:
        settings = self.settings
        return make_graph(
            layout,
            drift,
            settings.radius,
            self._unit,
            swept=settings.swept,
            within=settings.within,
            roots=settings.network == OBJECTS,
        )

    def _of_particles(self, graph: Graph, values: Tensor) -> Tensor:
        """Return values of nodes (N, 3), in units of changes, as metres of particles (P, 3)."""
        metres = values.double() * self._change
        return metres.new_zeros(graph.particles, 3).index_copy(0, graph.rows, metres)

    def _move_objects(
        self, layout: SceneLayout, now: ObjectState, drift: Drift, graph: Graph
    ) -> ObjectState:
        """Return the next state as DPI-Net predicts it."""
        velocity, rim, changes = self.network(graph)
        linear, angular = (value.double() * self._change for value in (velocity, rim))
        # A single particle has no rim, by which rotations are measured.
        spin = torch.where((_counts(layout) > 1)[:, None], angular / layout.size[:, None], 0.0)
        state = move(layout, now, drift, linear, spin)
        loose = self._of_particles(graph, changes)[layout.loose]
        return move_loose(layout, state, drift, loose)

    def _fit(self, layout: SceneLayout, goal: Tensor, *, robust: bool) -> tuple[Tensor, Tensor]:
        """Return the rotations and centres of the rigid motions that fit the particles."""
        if not robust:
            return fit_rigid(layout.shape, goal, layout.owners, layout.objects)
        draws = torch.rand(_HYPOTHESES, 4, generator=torch.Generator().manual_seed(0))
        tolerance = _INLIER * self.settings.spacing
        rotations, centers, _ = fit_robust(
            layout.shape, goal, layout.owners, layout.objects, tolerance, draws.to(goal.device)
        )
        return rotations, centers

    def _error(self, layout: SceneLayout, target: ObjectState, predicted: Tensor) -> Tensor:
        squares = ((predicted - target.positions(layout)) / self._change).pow(2).sum(-1)
        errors = _softened(mean_by(squares, layout.owners, layout.objects), self.settings.knee)
        free = (layout.kinds != KINEMATIC).double()
        return ((errors * free).sum() / free.sum().clamp_min(1)).float()


def _counts(layout: SceneLayout) -> Tensor:
    """Return the number of particles of every object (K,)."""
    return torch.bincount(layout.owners, minlength=layout.objects)


def _made_again(
    settings: ParticleSettings,
    weights: Mapping[str, NDArray[np.generic]],
    init: str,
    trained: bool,
) -> ParticleSimulator:
    model = ParticleSimulator(replace(settings, weights=RANDOM))
    model.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    model.init, model.trained = init, trained
    return model.eval()


def _softened(squares: Tensor, knee: float) -> Tensor:
    """Return 2 k^2 (sqrt(1 + s / k^2) - 1): about s for s << k^2, about 2 k sqrt(s) beyond."""
    return 2 * knee**2 * ((1 + squares / knee**2).sqrt() - 1)
