"""Draw docs/picture.png: three sampled trials in colour, and all passes of one frame of each.

python docs/picture.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from numpy.typing import NDArray

from physion.physics.engine import simulate
from physion.rendering.renderer import Frame, Renderer
from physion.scenes.looks import with_role_colors
from physion.scenes.scenarios import sample_scene
from physion.seeds import trial_seed

SCENARIOS = {"dominoes": 2, "collide": 0, "drop": 0}
"""Scenario and index of its trial."""
COLUMNS = ("frame 0", "moving", "last frame", "depth", "normals", "ids", "flow")
SIZE = 256


def painted(frame: Frame) -> list[NDArray[np.float64]]:
    """Depth, normals, ids and flow of a frame as colours in 0..1."""
    assert frame.depth is not None and frame.normals is not None
    assert frame.ids is not None and frame.flow is not None
    depth = plt.get_cmap("magma")(np.clip(1 - frame.depth / 10, 0, 1))[..., :3]
    ids = plt.get_cmap("tab20")(frame.ids % 20)[..., :3] * (frame.ids > 0)[..., None]
    strength = np.hypot(frame.flow[..., 0], frame.flow[..., 1])
    angle = np.arctan2(frame.flow[..., 1], frame.flow[..., 0]) / (2 * np.pi) % 1
    hue = np.stack([angle, np.ones_like(angle), np.clip(strength / 4, 0, 1)], -1)
    return [depth, frame.normals / 2 + 0.5, ids, mpl.colors.hsv_to_rgb(hue)]


def main() -> None:
    """Sample, simulate, render, draw."""
    plt.style.use("dark_background")
    figure, axes = plt.subplots(len(SCENARIOS), len(COLUMNS), figsize=(14, 6.1))
    for number, (name, index) in enumerate(SCENARIOS.items()):
        scene = with_role_colors(sample_scene(name, trial_seed("picture", name, "testing", index)))
        trajectory = simulate(scene)
        renderer = Renderer(scene, trajectory, SIZE, SIZE)
        speeds = np.linalg.norm(trajectory.velocities, axis=2).max(axis=1)
        busy = int(np.argmax(speeds[10:] * (np.arange(10, len(speeds)) < 120))) + 10
        moving = renderer.render(busy, ("color", "depth", "normals", "ids", "flow"))
        ends = [renderer.render(at, ("color",)).color for at in (0, len(trajectory) - 1)]
        pictures = [ends[0], moving.color, ends[1], *painted(moving)]
        for axis, title, picture in zip(axes[number], COLUMNS, pictures, strict=True):
            axis.imshow(picture)
            axis.set_axis_off()
            if number == 0:
                axis.set_title(title, fontsize=10)
    figure.subplots_adjust(0.005, 0.005, 0.995, 0.95, wspace=0.02, hspace=0.02)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=90)


if __name__ == "__main__":
    main()
