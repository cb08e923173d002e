"""Train the network that finds objects in pictures, on own trials with true masks.

    physion generate TRIALS --full --no-movies
    OMP_NUM_THREADS=1 python benchmarks/models/train_segmentation.py FOLDER --trials TRIALS
        [--count 24000] [--steps 4000] [--write]

Of training trials three observed frames are rendered, in red and yellow, and stored in FOLDER
with their masks, 1,000 trials a file; the same command resumes. In the training pictures are
mirrored, and brightness, contrast and noise vary; in half of them also colours (`recolor`), since
the red and the yellow of other renderers are darker or paler. The loss is

    cross entropy of the class of pixels + SHARE * mean |offset - o|_1 of pixels of objects.

Printed are, on the trials of the last file, which train nothing, intersection over union by class
and the error of the offsets. --write puts the weights into the package, with a card.

Trials with the scene of an official one are left out.
"""

from __future__ import annotations

import argparse
import datetime
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from physion import Dataset
from physion.clips.batch import AGENT_ID, FIRST_OTHER_ID, PATIENT_ID, SCENERY_ID
from physion.clips.rendered import object_ids
from physion.clips.states import TrialMotions
from physion.core.seeds import generator
from physion.data.official import official
from physion.models.segmentation import (
    CLASSES,
    OFFSET,
    SIDE,
    WEIGHTS,
    SegmentationNetwork,
    network_input,
)
from physion.rendering.renderer import Renderer
from physion.scenes.looks import in_look
from physion.scenes.scene import OBSERVED_FRAMES
from train_seeing import write_network

SHIPPED = Path(__file__).parents[2] / "src/physion/data/segmentation"
PART, FRAMES, BATCH, HELD = 1000, 3, 32, 512
RATE, WARM_UP = 2e-3, 100
SHARE = 0.2
JITTER, NOISE = 0.1, 0.02
"""Standard deviations of contrast and brightness of a picture, and of its pixels."""
DARK, PALE = {AGENT_ID: (0.3, 1.1), PATIENT_ID: (0.5, 1.1)}, {AGENT_ID: 0.4, PATIENT_ID: 0.7}
"""Range of the factor of the colour of agent and patient, and largest share of grey in it."""
GAMMA, TINT = (0.7, 1.5), 0.08
"""Range of the exponent of a picture, and standard deviation of the factors of its channels."""


def make(folder: Path, dataset: Dataset, count: int) -> None:
    """Store pictures and masks of ``count`` trials, one of each scenario in turn."""
    known = {trial.scene.physics_digest() for trial in official().trials}
    index = dataset.index[dataset.index["split"] == "training"]
    order = index.groupby("scenario").cumcount()
    names = index.assign(order=order).sort_values(["order", "scenario"])["trial"].tolist()[:count]
    motions = TrialMotions(dataset.files("trial_file"), observed=True)
    for start in range(0, len(names), PART):
        path = folder / f"pictures-{start}.npz"
        if path.exists():
            continue
        shown, masks = [], []
        for name in names[start : start + PART]:
            motion = motions[name]
            if motion.scene.physics_digest() in known:
                continue
            renderer = Renderer(in_look(motion.scene, "redyellow"), motion.trajectory, SIDE, SIDE)
            chosen = generator("segmentation", "frames", name).choice(
                OBSERVED_FRAMES, FRAMES, replace=False
            )
            for frame in chosen.tolist():
                drawn = renderer.render(frame, ("color", "ids"))
                shown.append(drawn.color)
                masks.append(object_ids(motion.scene)[drawn.ids])
        kept = folder / "part.npz"
        np.savez(kept, rgb=np.array(shown), ids=np.array(masks, np.uint8))
        kept.rename(path)
        print(f"{datetime.datetime.now():%H:%M:%S} {start} of {len(names)}", flush=True)


def targets(ids: Tensor) -> tuple[Tensor, Tensor]:
    """Return the class of pixels (N, H, W), and the offset to the centre of their object.

    The centre is the mean of the object's pixels in this picture. Offsets (N, 2, H, W) are x and y,
    in units of 1 / `OFFSET` of a side.
    """
    pictures, height, width = ids.shape
    number = (ids.long() + 256 * torch.arange(pictures)[:, None, None]).reshape(-1)
    x = ((torch.arange(width) + 0.5) / width).expand(ids.shape).reshape(-1)
    y = ((torch.arange(height) + 0.5) / height)[:, None].expand(ids.shape).reshape(-1)
    counts = torch.bincount(number).clamp(min=1)
    offsets = [(torch.bincount(number, axis) / counts)[number] - axis for axis in (x, y)]
    by_picture = torch.stack(offsets).view(2, *ids.shape).transpose(0, 1)
    return ids.long().clamp(max=FIRST_OTHER_ID), OFFSET * by_picture.float()


def recolor(
    rgb: NDArray[np.uint8], ids: NDArray[np.uint8], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) in other colours.

    A pixel c of agent or patient becomes f (c + g (max c - c)), with f of `DARK` and g up to
    `PALE`; then all pixels become t c^e, with e of `GAMMA` and factors t of the channels.
    """
    colors = rgb / 255
    for role, factors in DARK.items():
        own = ids == role
        grey = colors[own].max(-1, keepdims=True, initial=0)
        paler = colors[own] + rng.uniform(0, PALE[role]) * (grey - colors[own])
        colors[own] = rng.uniform(*factors) * paler
    colors = colors ** rng.uniform(*GAMMA) * (1 + TINT * rng.normal(size=3))
    return np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)


def losses(found: Tensor, kinds: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cross entropy of the classes, and the mean error of the offsets."""
    entropy = functional.cross_entropy(found[:, : len(CLASSES)], kinds)
    objects = kinds != SCENERY_ID
    error = (found[:, len(CLASSES) :] - offsets).abs().sum(1)
    return entropy, (error * objects).sum() / objects.sum().clamp(min=1)


def train(folder: Path, steps: int) -> tuple[SegmentationNetwork, str]:
    """Return the trained network, and its errors on held-out trials as text."""
    paths = sorted(folder.glob("pictures-*.npz"), key=lambda path: int(path.stem.split("-")[1]))
    parts = [np.load(path) for path in paths]
    *fit, held = [(part["rgb"], part["ids"]) for part in parts]
    if not fit or len(held[0]) < HELD:
        raise SystemExit(f"{folder} has {len(paths)} files; two of {PART} trials are needed")
    rng = generator("segmentation", "training")
    torch.manual_seed(0)
    network = SegmentationNetwork()
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, RATE, steps, pct_start=WARM_UP / steps, cycle_momentum=False
    )

    def batch() -> tuple[Tensor, Tensor, Tensor]:
        files = rng.choice(len(fit), BATCH)
        rows = [(fit[file], rng.integers(len(fit[file][0]))) for file in files]
        rgb, ids = (np.stack([part[kind][row] for part, row in rows]) for kind in (0, 1))
        if rng.random() < 0.5:
            rgb, ids = rgb[:, :, ::-1].copy(), ids[:, :, ::-1].copy()
        half = BATCH // 2
        rgb[:half] = [recolor(*pair, rng) for pair in zip(rgb[:half], ids[:half], strict=True)]
        seen = network_input(rgb)
        gain, lift = JITTER * torch.randn(2, BATCH, 3, 1, 1)
        seen[:, :3] = seen[:, :3] * (1 + gain) + lift + NOISE * torch.randn(BATCH, 3, SIDE, SIDE)
        return seen, *targets(torch.from_numpy(ids))

    start = time.process_time()
    for step in range(1, steps + 1):
        seen, kinds, offsets = batch()
        entropy, error = losses(network(seen), kinds, offsets)
        optimizer.zero_grad()
        (entropy + SHARE * error).backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if step % 100 == 0:
            text = score(network, *held)
            print(f"{datetime.datetime.now():%H:%M:%S} step {step}: {text}", flush=True)
    seconds = time.process_time() - start
    trials = sum(len(part[0]) for part in fit) // FRAMES
    text = (
        f"{trials} trials, {steps} steps of {BATCH} pictures, {seconds:.0f} s of processor time. "
        f"On {HELD} pictures of other trials: {score(network, *held)}"
    )
    return network, text


@torch.no_grad()
def score(network: SegmentationNetwork, rgb: NDArray[Any], ids: NDArray[Any]) -> str:
    """Return intersection over union by class, and the error of the offsets, as text."""
    network.eval()
    found = torch.cat([network(network_input(part)) for part in np.split(rgb[:HELD], HELD // 64)])
    network.train()
    kinds, offsets = targets(torch.from_numpy(ids[:HELD]))
    best = found[:, : len(CLASSES)].argmax(1)
    shares = []
    for kind in CLASSES:
        both, either = (best == kind) & (kinds == kind), (best == kind) | (kinds == kind)
        shares.append(f"{both.sum() / either.sum():.3f}")
    _, error = losses(found, kinds, offsets)
    return (
        "intersection over union of scenery, agent, patient and other objects "
        f"{', '.join(shares)}; error of offsets {error / OFFSET:.4f} of a side"
    )


def main() -> None:
    """Make what is missing, train, and write the weights."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trials", type=Path, help="folder of own trials; else only those stored")
    parser.add_argument("--count", type=int, default=15000)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.folder.mkdir(parents=True, exist_ok=True)
    if options.trials is not None:
        make(options.folder, Dataset(options.trials), options.count)
    network, text = train(options.folder, options.steps)
    print(text)
    if options.write:
        write_network(
            SHIPPED / WEIGHTS,
            network,
            "# Objects in pictures\nNetwork of `physion.models.segmentation`",
            "python benchmarks/models/train_segmentation.py FOLDER --trials TRIALS --count "
            f"{options.count} --steps {options.steps} --write",
            text,
        )


if __name__ == "__main__":
    main()
