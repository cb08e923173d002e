"""Train the networks of what is expected of objects, of `seeing-simulation` without exact depth.

    physion generate TRIALS --full --no-movies
    OMP_NUM_THREADS=1 python benchmarks/models/train_seeing.py FOLDER --trials TRIALS
        [--count 16000] [--steps 20000] [--no-depth] [--write]

Of own rigid trials the frames that the network sees are rendered, each object's depth gets an
error, and tokens and true values are stored in FOLDER, 1,000 trials a file; the same command
resumes. In the training each object gets another error in every step, and trials are mirrored at
random. With --no-depth the network for masks only is trained, from the same tokens: each object's
depth is where the floor is below it (`physion.models.seeing.expected.assumed_depth`), and what is
nearer or farther in its pixels is left out. 700 trials train nothing. Printed are, on them, the
error of the depth of objects that move, before and after, and how many shapes are right. --write
puts the weights into the package, with a card.

Trials with the scene of an official one are left out.
"""

from __future__ import annotations

import argparse
import datetime
import time
from collections.abc import Set
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

from physion import Dataset
from physion.clips.batch import SCENERY_ID, Motion
from physion.clips.rendered import MotionRenderer, object_ids
from physion.compute.tasks import processor
from physion.core.files import write_with_digest
from physion.core.names import RIGID
from physion.core.seeds import generator
from physion.data.official import official
from physion.models.seeing.expected import (
    CROP,
    ERROR,
    FRAMES,
    MOST,
    VALUES,
    WEIGHTS,
    ExpectationNetwork,
    floor_depth,
    frames_of,
    split,
    tokens_of,
)
from physion.models.seeing.solids import Placed, library, solid
from physion.numerics.rotations import rotation_matrices
from physion.trials.trial_file import Trial

SHIPPED = Path(__file__).parents[2] / "src/physion/data/seeing"
SHAPES = [each.name for each in library()]
PART, HELD_OUT, BATCH, SIZE = 1000, 700, 64, 256
RATE = 3e-3
"""Largest learning rate, of one cycle."""
SHARES = {"values": 0.15, "shape": 0.3, "middle": 0.2}
"""Of the losses, besides that of the depth."""


def told(scene: Any, path: Any, numbers: Any, errors: Any, tokens: Any) -> NDArray[np.float32]:
    """Return the true values (K, 10) of objects, NaN of those that are no shape of the library.

    Error of depth, lower end, height, sides, number of the shape, whether it stays, and its middle
    along the axes of the camera.
    """
    known = object_ids(scene)[1:].tolist()
    rows = np.full((len(numbers), 10), np.nan, np.float32)
    for row, number in enumerate(numbers):
        i = known.index(number)
        body = scene.bodies[i]
        rows[row, 0], rows[row, 6] = errors[number], body.kinematic
        if body.shape not in SHAPES:
            continue
        turn = rotation_matrices(path.rotations[0, i : i + 1].astype(float))[0]
        place = path.positions[0, i].astype(float)
        placed = Placed(solid(body.shape), place, turn, np.array(body.scale, float))
        low, high = placed.extent_z()
        sides = np.ptp(placed.corners()[:, :2], axis=0)
        rows[row, 1:5] = low, high - low, sides.max(), sides.min()
        rows[row, 5] = SHAPES.index(body.shape)
        rows[row, 7:] = tokens.axes.T @ (placed.middle() - tokens.origin)
    return rows


def tokens_of_trial(name: str, path: Path, known: Set[str]) -> tuple[Any, ...] | None:
    """Return numbers, true values and height of the camera of a trial; None if it shows nothing.

    ``known``: digests of the physics of trials that are left out.
    """
    trial = Trial.open(path)
    if trial.scene.physics_digest() in known:
        return None
    scene, motion = trial.scene, Motion(trial.scene, trial.trajectory)
    reader = MotionRenderer(
        {name: motion}, ("ids", "depth", "camera"), SIZE, 1, {name: "redyellow"}
    )
    shown = reader.read(name, np.array(FRAMES))
    rng = generator("seeing", "errors of depth", name)
    ids = shown["ids"]
    depth = shown["depth"] * (1 + ERROR * rng.standard_normal(ids.shape))
    errors = {}
    for number in np.unique(ids[ids != SCENERY_ID]).tolist():
        factor = 1 + ERROR * rng.standard_normal()
        depth[ids == number] *= factor
        errors[number] = np.log(factor)
    tokens = tokens_of(ids, depth, shown["camera"])
    if not tokens.numbers:
        return None
    true = told(scene, trial.trajectory, tokens.numbers, errors, tokens)
    return tokens.values, true, scene.camera.position[2]


def make(folder: Path, dataset: Dataset, count: int) -> None:
    """Store the tokens of ``count`` trials, one of each scenario in turn."""
    index = dataset.index
    known = {trial.scene.physics_digest() for trial in official().trials}
    index = index[index["scenario"].isin(RIGID) & (index["split"] != "familiarization")]
    order = index.groupby("scenario").cumcount()
    names = index.assign(order=order).sort_values(["order", "scenario"])["trial"].tolist()[:count]
    files = dataset.files("trial_file")
    for start in range(0, len(names), PART):
        path = folder / f"tokens-{start}.npz"
        if path.exists():
            continue
        made = [
            tokens_of_trial(name, files[name].path, known) for name in names[start : start + PART]
        ]
        rows = [one for one in made if one is not None]
        values = np.zeros((len(rows), MOST, VALUES), np.float16)
        true = np.full((len(rows), MOST, 10), np.nan, np.float32)
        for row, (seen, expected, _) in enumerate(rows):
            values[row, : len(seen)], true[row, : len(seen)] = seen, expected
        kept = folder / "part.npz"
        np.savez(
            kept, values=values, true=true, height=np.array([one[2] for one in rows], np.float32)
        )
        kept.rename(path)
        print(f"{datetime.datetime.now():%H:%M:%S} {start + len(made)} of {len(names)}", flush=True)


def with_errors(values: Tensor, change: Tensor, height: Tensor) -> Tensor:
    """Return numbers of objects whose logarithm of depth is changed (B, K, 1 or T)."""
    frames, factor = frames_of(values).clone(), torch.exp(change)
    seen = frames[..., 0] > 0
    frames[..., 1:3] *= factor[..., None]
    frames[..., 4] = torch.where(
        seen, ((frames[..., 4] + 1) / factor - 1).clamp(-1, 1), frames[..., 4]
    )
    camera = torch.zeros(len(values), 1, 1, 3)
    camera[..., 2] = height[:, None, None]
    moved = camera + (frames[..., 6:9] - camera) * factor[..., None]
    frames[..., 6:9] = torch.where(seen[..., None], moved, frames[..., 6:9])
    frames[..., 9:24] *= factor[..., None]
    return torch.cat([frames.flatten(-2), values[..., frames.shape[-2] * frames.shape[-1] :]], -1)


def standing_on_floor(values: Tensor, errors: Tensor, height: Tensor) -> tuple[Tensor, Tensor]:
    """Return numbers of objects that stand on the floor by assumption, and its errors (B, K, T).

    ``errors`` (B, K): the error that the logarithm of their depth has. The result's is NaN in
    frames that do not show the object.
    """
    frames = frames_of(values)
    seen, depth, camera = frames[..., 0] > 0, frames[..., 1], height[:, None, None]
    slopes = (frames[..., 8] + frames[..., 11] - camera) / depth.clamp(min=0.1)
    assumed = torch.from_numpy(floor_depth(-camera.numpy(), slopes.numpy()))
    change = torch.where(seen, torch.log(assumed / depth.clamp(min=0.1)), 0.0)
    out = with_errors(values, change, height)
    of_objects = frames_of(out)
    floor = torch.where(slopes < -1e-4, -camera / slopes, 50.0)
    of_objects[..., 4] = torch.where(seen, (floor / assumed - 1).clamp(-1, 1), 0.0)
    of_objects[..., 15:24] = 0.0
    return out, torch.where(seen, change + errors[..., None], torch.nan)


def mirrored(values: Tensor) -> Tensor:
    """Return numbers of objects in the mirror image of trials.

    Whether something is cut off on the left stays, since it is not known for the right.
    """
    frames = frames_of(values).clone()
    frames[..., 7] *= -1
    frames[..., 10], frames[..., 13] = -frames[..., 13], -frames[..., 10].clone()
    for first in (15, 24):
        cells = frames[..., first : first + 9].reshape(*frames.shape[:-1], 3, 3)
        frames[..., first : first + 9] = cells.flip(-1).flatten(-2)
    start = frames.shape[-2] * frames.shape[-1]
    masks = values[..., start:-2].reshape(*values.shape[:-1], 2, CROP, CROP).flip(-1).flatten(-3)
    return torch.cat([frames.flatten(-2), masks, values[..., -2:]], -1)


def density(given: Tensor, wanted: Tensor, least: float = -5.0) -> Tensor:
    """Return negative logarithms of normal densities (...) of means and log deviations (..., 2)."""
    mean, logs = given[..., 0], given[..., 1].clamp(least, 3)
    out: Tensor = logs + 0.5 * ((wanted.nan_to_num() - mean) * torch.exp(-logs)) ** 2
    return out


def losses(
    out: Tensor, values: Tensor, true: Tensor, there: Tensor, of_frames: Tensor | None
) -> Tensor:
    """Return the loss: negative logarithms of normal densities, and the cross entropy of shapes.

    ``of_frames``: errors of depth of every frame, if depth is assumed.
    """
    measured, shapes, middles, errors = split(out)
    sizes = torch.log(true[..., 2:5].clamp(min=0.005))
    wanted = torch.cat([true[..., :1] / ERROR, true[..., 1:2], sizes], -1)
    known = there & torch.isfinite(true[..., 5])
    densities = density(measured, wanted)
    depth = densities[..., 0][there].mean()
    if of_frames is not None:
        seen = torch.isfinite(of_frames)
        depth = (depth + density(errors, of_frames / ERROR)[seen].mean()) / 2
    rest = densities[..., 1:][known].sum(-1).mean()
    shape = functional.cross_entropy(shapes[known], true[..., 5][known].long())
    frames = frames_of(values)
    first = (frames[..., 0] > 0).float().argmax(-1)[..., None, None]
    seen = known & (frames[..., 0] > 0).any(-1)
    centroid = frames[..., 6:9].gather(2, first.expand(*first.shape[:2], 1, 3))[:, :, 0]
    middle = density(middles[seen], (true[..., 7:] - centroid)[seen], -6).sum(-1).mean()
    total: Tensor = (
        depth + SHARES["values"] * rest + SHARES["shape"] * shape + SHARES["middle"] * middle
    )
    return total


def train(folder: Path, steps: int, depth: bool) -> tuple[ExpectationNetwork, str]:
    """Return the trained network, and its errors on held-out trials as text."""
    parts = [np.load(path) for path in sorted(folder.glob("tokens-*.npz"))]
    values, true, height = (
        torch.from_numpy(np.concatenate([part[name] for part in parts]).astype(np.float32))
        for name in ("values", "true", "height")
    )
    there = torch.isfinite(true[..., 0])
    rng = generator("seeing", "training")
    order = rng.permutation(len(values))
    held, fit = order[:HELD_OUT], order[HELD_OUT:]
    torch.manual_seed(0)
    network = ExpectationNetwork(depth=depth)
    assumed = None
    if not depth:
        values, assumed = standing_on_floor(values, true[..., 0].nan_to_num(), height)
        # Of the first frame that shows the object.
        first = torch.isfinite(assumed).float().argmax(-1, keepdim=True)
        true[..., 0] = torch.where(there, assumed.gather(-1, first)[..., 0].nan_to_num(), torch.nan)
    frames = frames_of(values[fit][there[fit]]).flatten(-2)
    network.mean.copy_(frames.mean(0))
    network.sd.copy_(frames.std(0).clamp(1e-3))
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, steps, pct_start=0.1)

    def batch_of(rows: Any, mirror: bool) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        expected, seen = true[rows].clone(), values[rows]
        if depth:
            new = ERROR * torch.from_numpy(rng.standard_normal((len(rows), MOST))).float()
            change = (new - expected[..., 0].nan_to_num())[..., None]
            seen = with_errors(seen, change, height[rows])
            expected[..., 0] = torch.where(there[rows], new, expected[..., 0])
        if mirror:
            chosen = torch.from_numpy(rng.random(len(rows)) < 0.5)
            seen = torch.where(chosen[:, None, None], mirrored(seen), seen)
            expected[chosen, :, 8] *= -1
        return seen, expected, there[rows], None if assumed is None else assumed[rows]

    start = time.process_time()
    for step in range(1, steps + 1):
        seen, expected, known, of_frames = batch_of(rng.choice(fit, BATCH), True)
        loss = losses(network(seen, known), seen, expected, known, of_frames)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if step % 1000 == 0:
            print(f"{datetime.datetime.now():%H:%M:%S} step {step}: loss {loss:.3f}", flush=True)
    seconds = time.process_time() - start
    network.eval()
    with torch.no_grad():
        seen, expected, known, of_frames = batch_of(held, False)
        out = network(seen, known)
    loss = losses(out, seen, expected, known, of_frames)
    measured, shapes, _, errors = split(out)
    moving = known & (expected[..., 6] == 0)
    shaped = moving & torch.isfinite(expected[..., 5])
    left = ERROR * measured[..., 0, 0] - expected[..., 0]
    right = (shapes.argmax(-1) == expected[..., 5])[shaped].float().mean()
    before, after = expected[..., 0][moving], left[moving]
    text = (
        f"{len(fit)} trials, {steps} steps of {BATCH}, {seconds:.0f} s of processor time. On "
        f"{len(held)} other trials: loss {loss:.3f}; error of depth of movable objects, root mean "
        f"square {before.square().mean().sqrt():.4f} before and {after.square().mean().sqrt():.4f} "
        f"after, median {before.abs().median():.4f} and {after.abs().median():.4f}; shapes right "
        f"{right:.3f}"
    )
    if of_frames is not None:
        late = (ERROR * errors[..., -1, 0] - of_frames[..., -1])[moving]
        late = late[torch.isfinite(late)]
        text += (
            f"; in the last frame, root mean square {late.square().mean().sqrt():.4f}, "
            f"median {late.abs().median():.4f}"
        )
    return network, text


def write_network(path: Path, network: nn.Module, title: str, command: str, text: str) -> None:
    """Write the weights of a network, rounded to float16, and a card, into the package."""
    path.parent.mkdir(exist_ok=True)
    halves = {name: value.half() for name, value in network.state_dict().items()}
    write_with_digest(path, save(halves))
    path.with_suffix(".md").write_text(
        f"{title}, rounded to float16.\n\n`{command}`, {datetime.date.today()}, {processor()}, "
        f"one thread: {text}.\n"
    )


def main() -> None:
    """Make what is missing, train, and write the weights."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trials", type=Path, help="folder of own trials; else only those stored")
    parser.add_argument("--count", type=int, default=16000)
    parser.add_argument("--steps", type=int, default=20000)
    parser.add_argument("--no-depth", action="store_true", help="the network for masks only")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.folder.mkdir(parents=True, exist_ok=True)
    if options.trials is not None:
        make(options.folder, Dataset(options.trials), options.count)
    if not options.steps:
        return
    network, text = train(options.folder, options.steps, not options.no_depth)
    print(text)
    if options.write:
        write_network(
            SHIPPED / WEIGHTS[not options.no_depth],
            network,
            f"# What is expected of objects{' from masks only' * options.no_depth}\n"
            "Network of `physion.models.seeing.expected`",
            "python benchmarks/models/train_seeing.py FOLDER --trials TRIALS --count "
            f"{options.count} --steps {options.steps}{' --no-depth' * options.no_depth} --write",
            text,
        )


if __name__ == "__main__":
    main()
