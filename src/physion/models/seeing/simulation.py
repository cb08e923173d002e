"""Model `seeing-simulation`: from masks, with or without depth, to a scene, then noisy simulation.

The observed frames are seen as masks of the objects, the camera, and depth if it is given, an
oracle of perception: which pixel belongs to which object, and which object is agent and patient, is
known. `scenes.see_trial` fits shapes of the library to them, `hypotheses.see_uncertain` if depth is
not exact or not there; from the scene and the state at the last observed frame the engine simulates
with noise, as in `physion.models.noisy_simulation`. Nothing is fitted to outcomes, and nothing but
these inputs is known of a trial: no mass, friction, joint, scenario, or body that does not move.
"""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np

from physion.clips.batch import LAST_OBSERVED, Batch, Provenance, Rollout, Spec
from physion.core.errors import BadInputError
from physion.core.files import digest_of, json_digest
from physion.core.version import __version__
from physion.models.interface import Model, ModelSettings
from physion.models.noisy_simulation import (
    NOISE_VERSION,
    NoiseLevels,
    ObservedTrial,
    simulate_contacts,
)
from physion.models.seeing.scenes import SeenTrial, see_trial
from physion.physics.engine import DEFAULT_ENGINE, Engine, make_engine, simulate
from physion.rendering.renderer import Renderer

VERSION = 10
"""To be raised with every change of the code that can alter a prediction."""
KEPT = 16
"""Trials whose scenes are kept in memory, besides the last batch."""
LEAST_ERROR, MOST_ERROR = 0.005, 0.04
"""Relative errors of depth; what is expected of objects was learned with 0.02."""
EXPECTED_ERROR = 0.02
"""Relative error of the depth that is expected where none is seen."""
SHOWN_SIZE = 128
"""Pixels per side of the pictures for the viewer."""


@dataclass(frozen=True, kw_only=True)
class SeeingSettings(NoiseLevels, ModelSettings):
    """Settings of `SeeingSimulation`: the levels of the noise (`NoiseLevels`), and others.

    - ``samples``: simulations per trial. ``engine``: name of the engine. ``seed``: of the noise.
    - ``image_size``: pixels per side of the pictures that it sees.
    - ``depth_error``: relative error that depth has; 0 for exact depth. With an error a network
      says what is expected of the objects (`physion.models.seeing.expected`), and the observed
      frames are simulated, too (`physion.models.seeing.hypotheses`).
    - ``depth``: whether depth is seen. Without it a network says how far away masks are.
    """

    depth_error: float = 0.0
    depth: bool = True
    samples: int = 20
    engine: str = DEFAULT_ENGINE
    seed: int = 0
    image_size: int = 256

    def __post_init__(self) -> None:
        self.check(self.model)
        if self.samples < 1 or self.image_size < 64:
            raise BadInputError(
                f"{self.model} needs at least one sample, and pictures of at least 64 pixels"
            )
        if self.depth_error and not LEAST_ERROR <= self.depth_error <= MOST_ERROR:
            raise BadInputError(
                f"depth_error of {self.model} must be 0, or from {LEAST_ERROR} to {MOST_ERROR}, "
                f"not {self.depth_error:g}"
            )
        if self.depth_error and not self.depth:
            raise BadInputError(
                f"{self.model}: depth_error is for depth that is seen; leave out depth=false or "
                "depth_error"
            )


class SeeingSimulation(Model):
    """Fit bodies to masks and depth, then simulate the rest of the trial several times with noise.

    P(contact) is the fraction of simulations in which agent and patient touch. If one of them was
    never seen, every second simulation counts as a contact.
    """

    decision = "touch"
    settings: SeeingSettings

    def __init__(self, settings: SeeingSettings) -> None:
        self.settings = settings
        # Exact depth tells the velocity of the last step, from the last two frames.
        stride = 2 if self._uncertain else 1
        self.spec = Spec(
            inputs=("ids", *("depth",) * settings.depth, "camera"),
            image_size=settings.image_size,
            stride=stride,
            context=LAST_OBSERVED // stride + 1,
        )
        self.samples, self.seed = settings.samples, settings.seed
        self._engine: Engine | None = None
        self._seen: OrderedDict[str, SeenTrial] = OrderedDict()

    def see(self, context: Batch) -> list[SeenTrial]:
        """Return scene and state of every trial, and what could not be seen."""
        if any(getattr(context, name) is None for name in self.spec.inputs):
            raise BadInputError(
                f"{self.settings.model} needs masks{', depth' * self.settings.depth} and camera of "
                f"every trial (inputs {', '.join(self.spec.inputs)})"
            )
        seen = [self._see(context, row) for row in range(len(context))]
        while len(self._seen) > max(KEPT, len(seen)):
            self._seen.popitem(last=False)
        return seen

    def notes(self, batch: Batch) -> list[str]:
        """Return what was not seen, or not well, of each trial."""
        return [one.note for one in self.see(batch)]

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Simulate every trial ``samples`` times; ``contact`` says whether agent and patient touch.

        With the argument ``show`` pictures of the first trial without noise are drawn, too.
        """
        seen = self.see(context)
        contact = np.zeros((len(seen), samples), np.bool_)
        for row, one in enumerate(seen):
            if one.trial is None:
                contact[row, ::2] = True
                continue
            contact[row] = [
                touched
                for trial, count in one.shared(samples)
                for touched in simulate_contacts(
                    trial, self.settings, 1.0, count, seed, self.engine
                )
            ]
        shown: dict[str, Any] = {}
        if arguments.get("show"):
            pictures = np.stack([self._pictures(one.trial, context.future) for one in seen])
            shown["rgb"] = np.repeat(pictures[:, None], samples, axis=1)
        return Rollout(contact=contact, shown=shown)

    @property
    def engine(self) -> Engine:
        """The engine that simulates."""
        if self._engine is None:
            self._engine = make_engine(self.settings.engine)
        return self._engine

    def digest(self) -> str:
        """Return the SHA-256 of code version, engine, noise, size of pictures, and weights."""
        settings = dataclasses.asdict(self.settings)
        levels = {field.name: settings[field.name] for field in dataclasses.fields(NoiseLevels)}
        error = [self.settings.depth_error, self._weights()] if self._uncertain else []
        size = self.settings.image_size
        return json_digest([VERSION, NOISE_VERSION, self.engine.name, levels, size, *error])

    @property
    def _uncertain(self) -> bool:
        """Whether a network says what is expected of the objects."""
        return self.settings.depth_error > 0 or not self.settings.depth

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return Provenance(
            model=self.settings.model,
            init=f"shipped:{self._weights()[:12]}" if self._uncertain else "none",
            encoder_type=f"bodies fitted to {self._given()}",
            dynamics_type="physics engine",
            versions=f"{self.engine.name}, physion {__version__}",
        )

    def _given(self) -> str:
        """Return what is seen of the objects."""
        if not self.settings.depth:
            return "true masks"
        error = self.settings.depth_error
        return "true masks and depth" + f" with an error of {error:g}" * (error > 0)

    def _weights(self) -> str:
        """Return the SHA-256 of the weights that fits without exact depth need."""
        # Imported late: they need torch, which exact depth does not.
        from physion.models.checkpoint import packaged_sha256
        from physion.models.seeing.expected import FOLDER, WEIGHTS

        return packaged_sha256(FOLDER, WEIGHTS[self.settings.depth])

    def _see(self, context: Batch, row: int) -> SeenTrial:
        """Return what is seen of a trial; the last ones are remembered."""
        ids, camera = context.ids[row], context.camera[row]
        depth = context.depth[row] if self.settings.depth else None
        seen = (ids, camera) if depth is None else (ids, depth, camera)
        pixels = digest_of(b"".join(array.tobytes() for array in seen))
        key = f"{context.trials[row]} {pixels}"
        if key not in self._seen:
            name, frames = context.trials[row], context.frames[row]
            if depth is None or self.settings.depth_error:
                # Imported late: it needs torch, which exact depth does not.
                from physion.models.seeing.hypotheses import see_uncertain

                numbers = [int(frame) for frame in frames]
                error = self.settings.depth_error or EXPECTED_ERROR
                self._seen[key] = see_uncertain(numbers, ids, depth, camera, error, self.engine)
            else:
                self._seen[key] = see_trial(name, frames, ids, depth, camera, self.engine)
        return self._seen[key]

    def _pictures(self, trial: ObservedTrial | None, steps: int) -> Any:
        """Return pictures (steps, H, W, 3) of the simulation without noise; grey if unknown."""
        if trial is None:
            return np.full((steps, SHOWN_SIZE, SHOWN_SIZE, 3), 128, np.uint8)
        frames = 1 + self.spec.stride * steps
        path = simulate(trial.scene, engine=self.engine, start=trial.state, frames=frames)
        renderer = Renderer(trial.scene, path, SHOWN_SIZE, SHOWN_SIZE)
        chosen = range(self.spec.stride, frames, self.spec.stride)
        drawn = (renderer.render(frame, ("color",)).color for frame in chosen)
        return np.stack([color for color in drawn if color is not None])

    def __getstate__(self) -> dict[str, Any]:
        """Leave the engine and what was seen behind; another process makes its own."""
        return {**self.__dict__, "_engine": None, "_seen": OrderedDict()}
