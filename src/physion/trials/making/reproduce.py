"""Check that this machine reproduces the golden trials, one known trial of each scenario."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from physion.core.files import digest_of
from physion.core.seeds import trial_seed
from physion.core.version import FILE, golden_digests
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.physics.particles import particles_over_time
from physion.rendering.renderer import PASSES, Renderer
from physion.scenes.sampling.build import scenarios
from physion.scenes.sampling.sample import sample_scene
from physion.trials.making.choose import robustness

DATASET = "golden"
RUNS = 2
"""Number of jittered simulations of the robustness."""
SIZE = 96
"""Width and height of the rendered frame in pixels."""


def trial_digests(scenario: str) -> dict[str, str]:
    """Sample, simulate and render the golden trial of a scenario; return a digest of each part.

    Parts are ``scene``; ``motion`` (poses, velocities, cloth, contacts); ``label``; ``robust``
    (outcomes of jittered simulations); ``particles``; and each image pass of the middle frame.
    """
    seed = trial_seed(DATASET, scenario, "testing", 0)
    scene = sample_scene(scenario, seed)
    trajectory = simulate(scene)
    labels = label_contact(scene, trajectory)
    middle = len(trajectory) // 2
    particles = particles_over_time(scene, trajectory, frames=[0, middle])
    frame = Renderer(scene, trajectory, SIZE, SIZE).render(middle, PASSES)
    return {
        "scene": digest_of(scene.to_json()),
        "motion": trajectory.digest(),
        "label": f"{labels.contact} {labels.first_frame} {labels.observed} {labels.min_distance}",
        "robust": f"{robustness(scene, labels.contact, seed, RUNS)}",
        "particles": _digest(particles.positions),
        **{name: _digest(getattr(frame, name)) for name in PASSES},
    }


def _digest(array: Any) -> str:
    data = np.ascontiguousarray(array)
    return digest_of(repr((data.shape, data.dtype.str)).encode() + data.tobytes())


def differences(scenario: str) -> list[str]:
    """Return the parts of a scenario's golden trial that this machine does not reproduce."""
    golden = golden_digests().get(scenario, {})
    found = trial_digests(scenario)
    return [name for name, digest in found.items() if golden.get(name) != digest]


def main() -> None:
    """Print digests, by default of all scenarios, as JSON; with ``--write`` store them.

    Store them only after a change that is meant to alter scenes, motions or pictures, and increase
    `physion.physics.rigid.engine.VERSION` or `physion.rendering.renderer.VERSION` at the same time.
    """
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("scenario", nargs="*", default=sorted(scenarios.names()))
    options = parser.parse_args()
    found = {name: trial_digests(name) for name in options.scenario}
    if options.write:
        text = json.dumps({**golden_digests(), **found}, indent=1)
        (Path(__file__).parents[2] / "core" / FILE).write_text(text + "\n")
    else:
        print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
