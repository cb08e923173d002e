"""Draw docs/picture.jpg: one trial of each scenario, and every pass of one of them.

    python docs/picture.py [OFFICIAL_FRAME.png]
    python docs/picture.py --gallery

If the published picture of the eight official scenarios is given, it is put on the right. With
--gallery, draw docs/gallery/SCENARIO.jpg instead: three frames of each trial in red and yellow.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from numpy.typing import NDArray
from PIL import Image

from physion.core.seeds import trial_seed
from physion.physics.engine import simulate
from physion.rendering.renderer import Frame, Renderer, role_map
from physion.scenes.looks import with_role_colors
from physion.scenes.sampling.sample import get_preset, sample_scene
from physion.scenes.scene import OBSERVED_FRAMES

TRIALS = {
    "dominoes": ("2mid_J020R15_d3chairs_o1plants_tdwroom", 0, 60),
    "drop": ("all_bowls_box_1_dis_1_occ", 0, 45),
    "roll": ("ledge_box", 0, 45),
    "contain": ("torus", 0, 40),
    "collide": ("simple_box_1_dis_1_occ", 0, 40),
    "support": ("nb4_fr015_SJ000_gr01_mono0_dis1_occ1_tdwroom", 0, 30),
    "link": ("nl1-8_mg000_aCylcap_bCyl_tdwroom", 0, 45),
    "drape": ("test15", 0, 60),
}
"""Preset, index and frame of each scenario, in the order of the official picture."""
LATER = {
    "dominoes": 160, "support": 300, "collide": 150, "contain": 340, "drop": 150, "link": 440,
    "roll": 150, "drape": 150,
}  # fmt: skip
"""Last frame of each scenario in the gallery."""
PASSES = ("contain", ("color", "depth", "normals", "ids", "flow"))
SIZE, GAP = 256, 6


def color_passes(frame: Frame) -> list[NDArray[np.uint8]]:
    """Return depth, normals, ids and flow of a frame as colour images (H, W, 3), uint8."""
    assert frame.depth is not None and frame.normals is not None
    assert frame.ids is not None and frame.flow is not None
    depth = plt.get_cmap("magma")(np.clip(1 - frame.depth / 10, 0, 1))[..., :3]
    ids = plt.get_cmap("tab20")(frame.ids % 20)[..., :3] * (frame.ids > 0)[..., None]
    strength = np.hypot(frame.flow[..., 0], frame.flow[..., 1])
    angle = np.arctan2(frame.flow[..., 1], frame.flow[..., 0]) / (2 * np.pi) % 1
    hue = np.stack([angle, np.ones_like(angle), np.clip(strength / 4, 0, 1)], -1)
    pictures = (depth, frame.normals / 2 + 0.5, ids, mpl.colors.hsv_to_rgb(hue))
    return [(np.clip(picture, 0, 1) * 255).astype(np.uint8) for picture in pictures]


def renderer_of(name: str, cues: bool = False) -> Renderer:
    """Return the renderer of the trial of a scenario, in free colours or with red and yellow."""
    preset, index, _ = TRIALS[name]
    seed = trial_seed("picture", name, "testing", index)
    scene = sample_scene(name, seed, get_preset(name, preset).params)
    return Renderer(with_role_colors(scene) if cues else scene, simulate(scene), SIZE, SIZE)


def grid(tiles: list[NDArray[np.uint8]], columns: int) -> NDArray[np.uint8]:
    """Return one image with square tiles in rows, separated by black."""
    rows = -(-len(tiles) // columns)
    side = SIZE + GAP
    sheet = np.zeros((rows * side + GAP, columns * side + GAP, 3), np.uint8)
    for number, tile in enumerate(tiles):
        top, left = (GAP + side * part for part in divmod(number, columns))
        sheet[top : top + SIZE, left : left + SIZE] = tile
    return sheet


def draw_gallery() -> None:
    """Write the first, the last observed and a later frame of each trial, side by side."""
    folder = Path(__file__).with_name("gallery")
    folder.mkdir(exist_ok=True)
    for name, later in LATER.items():
        renderer = renderer_of(name, cues=True)
        frames = [renderer.render(at).color for at in (0, OBSERVED_FRAMES - 1, later)]
        sheet = grid([frame for frame in frames if frame is not None], 3)
        Image.fromarray(sheet).save(folder / f"{name}.jpg", quality=85)


def main() -> None:
    """Sample, simulate and render the trials, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("official", nargs="?", type=Path)
    parser.add_argument("--gallery", action="store_true", help="draw docs/gallery/ instead")
    args = parser.parse_args()
    if args.gallery:
        draw_gallery()
        return
    official = args.official
    frames = [renderer_of(name).render(at).color for name, (_, _, at) in TRIALS.items()]
    ours = grid([frame for frame in frames if frame is not None], 4)
    name, passes = PASSES
    trial = renderer_of(name, cues=True)
    first = trial.render(0, ("color", "ids"))
    moving = trial.render(TRIALS[name][2], passes)
    assert first.color is not None and first.ids is not None and moving.color is not None
    roles = role_map(first.ids, trial.scene)
    cues = np.where(roles[..., 3:] > 0, roles[..., :3], first.color // 3)
    strip = [first.color, cues.astype(np.uint8), moving.color, *color_passes(moving)]
    top = ours
    if official is not None:
        picture = Image.open(official).convert("RGB").resize((ours.shape[1], ours.shape[0]))
        top = np.concatenate([ours, np.full((len(ours), GAP, 3), 255, np.uint8), picture], axis=1)
    below = Image.fromarray(grid(strip, len(strip)))
    height = round(below.height * top.shape[1] / below.width)
    whole = np.concatenate([top, np.asarray(below.resize((top.shape[1], height)))])
    Image.fromarray(whole).save(Path(__file__).with_suffix(".jpg"), quality=88)


if __name__ == "__main__":
    main()
