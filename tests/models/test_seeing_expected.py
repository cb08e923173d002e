"""What `seeing-simulation` expects of objects whose depth has an error."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from physion import sample_scene
from physion.clips.batch import SCENERY_ID, Motion
from physion.clips.rendered import MotionRenderer
from physion.core.names import RIGID
from physion.core.seeds import generator
from physion.models.seeing.expected import (
    COLUMNS,
    ERROR,
    FRAMES,
    VALUES,
    ExpectationNetwork,
    Tokens,
    assumed_depth,
    expect,
    frames_of,
    split,
    tokens_of,
)
from physion.models.seeing.masks import TRUST, Expected
from physion.models.seeing.solids import Placed, solid
from physion.physics.engine import simulate
from physion.scenes.scene import Scene

FOLDER = Path(__file__).parents[2] / "benchmarks" / "models"
Shown = dict[str, NDArray[Any]]


@pytest.fixture(scope="module")
def training() -> Iterator[Any]:
    """The script that trains the network."""
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module("train_seeing")
    sys.path.remove(str(FOLDER))


def shown(made: Scene, frames: tuple[int, ...] = FRAMES) -> Shown:
    """Return ids, depth and camera of frames of a scene."""
    motions = {made.name: Motion(made, simulate(made, frames=45))}
    reader = MotionRenderer(motions, ("ids", "depth", "camera"), 256, 1, {made.name: "redyellow"})
    return reader.read(made.name, np.array(frames))


@pytest.fixture(scope="module")
def seen() -> Shown:
    return shown(sample_scene("support", 3))


def tokens(seen: Shown, **changed: Any) -> Tokens:
    arrays = seen | changed
    return tokens_of(arrays["ids"], arrays["depth"], arrays["camera"])


def values_of(found: Tokens) -> torch.Tensor:
    return torch.from_numpy(found.values)[None]


def test_places_are_in_axes_of_the_camera(seen: Shown) -> None:
    made = sample_scene("support", 3)
    found = tokens(seen)
    assert found.values.shape == (len(found.numbers), VALUES)
    assert found.numbers[:2] == (1, 2) and found.axes.T @ found.axes == pytest.approx(np.eye(3))
    agent = next(body for body in made.bodies if body.name == made.roles.agent)
    frame = frames_of(values_of(found))[0, 0, 0].numpy()
    place = found.origin + found.axes @ frame[6:9]
    assert np.linalg.norm(place - agent.position) < 1.2 * max(agent.scale)
    assert frame[0] == 1 and frame[6] > 0, "it is seen, ahead of the camera"


def test_another_factor_of_depth_changes_tokens_as_in_training(seen: Shown, training: Any) -> None:
    found, change = tokens(seen), np.array([0.03, -0.02, 0.01, 0.0, 0.02, -0.03])
    change = change[: len(found.numbers)]
    depth = seen["depth"].astype(np.float64)
    for number, by in zip(found.numbers, change, strict=False):
        depth[seen["ids"] == number] *= np.exp(by)
    change = np.pad(change, (0, len(found.numbers) - len(change)))
    height = torch.tensor([-(seen["camera"][0, :3, :3].T @ seen["camera"][0, :3, 3])[2]]).float()
    by = torch.tensor(change)[None, :, None].float()
    made = training.with_errors(values_of(found), by, height)
    expected = tokens(seen, depth=depth).values
    assert np.abs(expected - found.values).max() > 0.02
    made = made[0].numpy()
    near = np.abs(np.where(np.abs(expected) == 1, 0, made - expected))
    assert near.max() < 2e-4, "but where the distance to the floor is cut off"


def test_tokens_of_a_flipped_picture_are_mirrored(seen: Shown, training: Any) -> None:
    flipped = tokens(seen, ids=seen["ids"][..., ::-1], depth=seen["depth"][..., ::-1])
    made = training.mirrored(values_of(tokens(seen)))[0].numpy()
    left = [COLUMNS * (frame + 1) - 1 for frame in range(len(FRAMES))]
    # Cells of a mask whose pixels cannot be divided evenly are not mirrored to the pixel.
    cells = [COLUMNS * f + k for f in range(len(FRAMES)) for k in range(15, 33)]
    masks = range(len(FRAMES) * COLUMNS, VALUES - 2)
    exact = np.setdiff1d(np.arange(VALUES), [*left, *cells, *masks])
    assert made[:, exact] == pytest.approx(flipped.values[:, exact], abs=1e-4)
    assert np.abs(made[:, masks] - flipped.values[:, masks]).mean() < 0.05
    twice = training.mirrored(training.mirrored(values_of(tokens(seen))))
    assert torch.equal(twice, values_of(tokens(seen)))


def test_order_and_number_of_objects_do_not_matter() -> None:
    torch.manual_seed(0)
    network = ExpectationNetwork().eval()
    values = torch.randn(1, 4, VALUES)
    with torch.no_grad():
        alone = network(values, torch.ones(1, 4, dtype=torch.bool))[0]
        order = torch.tensor([2, 0, 3, 1])
        padded = torch.cat([values[:, order], torch.randn(1, 3, VALUES)], 1)
        there = torch.tensor([[True] * 4 + [False] * 3])
        other = network(padded, there)[0]
    assert torch.allclose(other[:4], alone[order], atol=1e-5) and (other[4:] == 0).all()


def test_free_fall_says_the_error_of_depth() -> None:
    frames = torch.zeros(1, len(FRAMES), COLUMNS)
    frames[..., 0] = 1
    times = torch.tensor(FRAMES) * 0.01
    frames[..., 8] = 2 - 1.04 * 9.81 * times**2 / 2
    fall = ExpectationNetwork._fall(frames)
    assert fall[0, :5] == pytest.approx(np.full(5, 0.04 / 0.05), abs=1e-3)
    assert (fall[0, 5:] == 1).all()
    frames[..., 8] = 2.0
    assert (ExpectationNetwork._fall(frames) == 0).all(), "it stays where it is"


def test_masks_by_themselves_make_the_tokens_that_were_trained(seen: Shown, training: Any) -> None:
    """What stands on the floor is there, and tokens of depth become those of assumed depth."""
    assumed = assumed_depth(seen["ids"], seen["camera"])
    scenery = seen["ids"] == SCENERY_ID
    floor = scenery & (np.abs(assumed / seen["depth"] - 1) < 0.02)
    assert floor.sum() > 0.1 * scenery.sum()
    found = tokens(seen)
    height = torch.tensor([-(seen["camera"][0, :3, :3].T @ seen["camera"][0, :3, 3])[2]]).float()
    errors = torch.zeros(1, len(found.numbers))
    made, wrong = training.standing_on_floor(values_of(found), errors, height)
    expected = tokens(seen, depth=assumed).values
    made = made[0].numpy()
    assert np.abs(expected - found.values).max() > 0.02
    assert np.abs(made - expected).max() < 0.02 and np.abs(made - expected).mean() < 1e-3
    for k, number in enumerate(found.numbers):
        mask = seen["ids"][0] == number
        there = np.median(seen["depth"][0][mask])
        assert float(wrong[0, k, 0]) == pytest.approx(np.log(assumed[0][mask][0] / there), abs=0.01)


def test_the_parts_of_what_the_network_gives(seen: Shown) -> None:
    values = values_of(tokens(seen))
    there = torch.ones(values.shape[:2], dtype=torch.bool)
    for depth, count in ((True, 0), (False, len(FRAMES))):
        with torch.no_grad():
            out = ExpectationNetwork(depth=depth)(values, there)
        measured, shapes, middle, errors = split(out)
        assert measured.shape[2:] == (5, 2) and middle.shape[2:] == (3, 2)
        assert errors.shape[2:] == (count, 2)
        parts = [part.reshape(*part.shape[:2], -1) for part in (measured, shapes, middle, errors)]
        assert torch.equal(torch.cat(parts, -1), out)


def test_residuals_are_distances_in_standard_deviations() -> None:
    box = Placed(solid("cube"), np.array([1.0, 2.0, 0.1]), np.eye(3), np.array([0.4, 0.2, 0.5]))
    low, high = box.extent_z()
    expected = Expected(
        0.01, {}, (low - 0.02, 0.01), (np.log(high - low), 0.1), (np.log(0.4), 0.1),
        (np.log(0.2) + 0.1, 0.1), np.eye(3), (box.middle() + 0.05 * np.eye(3)[2], np.full(3, 0.05)),
    )  # fmt: skip
    found = expected.residuals(box, flat=False, stands=False)
    wanted = [0, -1, 0, 0, -1, 0, 2]
    assert found == pytest.approx(TRUST * np.array(wanted), rel=0.06, abs=1e-9)
    assert len(expected.residuals(box, flat=True, stands=False)) == 5
    later = expected.in_another_frame().residuals(box, flat=False, stands=False)
    assert later == pytest.approx(TRUST * np.array([0, -1, 0, 0]), rel=0.06, abs=1e-5)


@pytest.mark.slow
def test_depth_is_better_than_it_was() -> None:
    """The error of depth, root mean square, of scenes that trained nothing."""
    errors: dict[str, list[float]] = {"before": [], "after": []}
    for scenario in RIGID:
        made = replace(sample_scene(scenario, 77), name=f"{scenario} 77")
        true = shown(made)
        rng = generator("test", scenario)
        depth = true["depth"] * (1 + ERROR * rng.standard_normal(true["depth"].shape))
        numbers = np.unique(true["ids"][true["ids"] != SCENERY_ID]).tolist()
        for number in numbers:
            depth[true["ids"] == number] *= 1 + ERROR * rng.standard_normal()
        better, expected = expect(FRAMES, true["ids"], depth, true["camera"])
        assert set(expected) == set(numbers)
        for number in numbers:
            mask = true["ids"] == number
            for name, found in (("before", depth), ("after", better)):
                errors[name].append(float(np.median(found[mask] / true["depth"][mask]) - 1))
    before, after = (np.sqrt(np.mean(np.square(errors[name]))) for name in errors)
    assert after < before / 2, (before, after)


@pytest.mark.slow
def test_masks_say_how_far_away_objects_are() -> None:
    """Depth of scenes that trained nothing, from masks and the camera only."""
    errors: dict[str, list[float]] = {"assumed": [], "expected": []}
    for scenario in RIGID:
        made = replace(sample_scene(scenario, 77), name=f"{scenario} 77")
        true = shown(made)
        assumed = assumed_depth(true["ids"], true["camera"])
        found, _ = expect(FRAMES, true["ids"], None, true["camera"])
        for number in np.unique(true["ids"][0][true["ids"][0] != SCENERY_ID]):
            mask = true["ids"][0] == number
            for name, depth in (("assumed", assumed), ("expected", found)):
                error = np.median(depth[0][mask] / true["depth"][0][mask]) - 1
                errors[name].append(abs(float(error)))
    assumed_error, expected_error = (np.median(errors[name]) for name in errors)
    assert expected_error < 0.02 < assumed_error, (assumed_error, expected_error)
