"""Models of intuition: tokens of objects, mirror images, learning from outcomes, bad input."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from physion.clips.batch import Batch, Motion
from physion.clips.rendered import MotionRenderer
from physion.core.errors import BadInputError
from physion.models.build import build_model
from physion.models.interface import TrainingSettings
from physion.models.intuition import READINGS, VIEWS, mask_tokens, state_tokens
from physion.models.segmentation import segment
from physion.physics.engine import simulate
from physion.physics.trajectory import Contacts, Trajectory
from physion.scenes.sampling.sample import sample_scene
from physion.scenes.scene import Body, Camera, Cloth, Roles, Scene
from physion.training.train import train_model
from support.clip_source import ClipSource

FRAMES = np.arange(2, 45, 3)
COLUMN = {name: VIEWS["states"].columns.index(name) for name in VIEWS["states"].columns}


def scene(*more: Body) -> Scene:
    bodies = (
        Body("red", "cone", (0.0, 0.0, 0.0), (0.2, 0.4, 0.6)),
        Body("yellow", "cube", (0.0, 0.0, 0.0), (1.0, 1.0, 0.5), kinematic=True),
        *more,
    )
    cloth = Cloth("sheet", (0.0, 0.0, 0.0), resolution=2)
    return Scene("s", "drop", bodies, Roles("red", "yellow"), Camera((3.0, 0.0, 1.0)), (cloth,))


def motion(made: Scene, angle: float = 0.0, mirrored: bool = False, shift: Any = 0.0) -> Motion:
    """Bodies that move on straight lines, in a world that is mirrored, turned and shifted."""
    count, steps = len(made.bodies), np.arange(60)[:, None, None] / 100
    rng = np.random.default_rng(0)
    start, speed, spin, cloth = (rng.normal(size=(count, 3)) for _ in range(4))
    sine, cosine = np.sin(angle), np.cos(angle)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    side = np.diag([1.0, -1.0 if mirrored else 1.0, 1.0])
    quaternion = np.float32([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    moved = shift * np.array([1.0, 1.0, 0.0])

    def world(vectors: Any) -> Any:
        return (vectors @ side @ turn.T).astype(np.float32)

    return Motion(
        made,
        Trajectory(
            world(start + steps * speed) + moved.astype(np.float32),
            np.tile(quaternion, (60, count, 1)),
            np.tile(world(speed), (60, 1, 1)),
            # A mirror turns a rotation the other way.
            np.tile(world(spin) * np.float32(np.linalg.det(side)), (60, 1, 1)),
            world(np.tile(cloth[:1], (60, 4, 1))) + moved.astype(np.float32),
            np.full(60, np.nan, np.float32), Contacts.empty(), True, "by hand 1",
        ),
    )  # fmt: skip


def test_tokens_of_states_have_the_patient_at_the_origin_and_the_agent_ahead() -> None:
    made = scene(
        Body("far", "sphere", (0.0, 0.0, 0.0)), Body("tree", "cube", (0, 0, 0), scenery=True)
    )
    seen = motion(made)
    tokens = state_tokens(seen, "t", FRAMES, 6)
    assert tokens.shape == (15, 6, len(COLUMN))
    last = tokens[-1]
    assert last[:, COLUMN["there"]].tolist() == [1, 1, 0, 1, 1, 0], "no probe; no scenery"
    assert last[1, [COLUMN["x"], COLUMN["y"]]] == pytest.approx([0, 0], abs=1e-6)
    agent, patient = seen.trajectory.positions[44, :2]
    middle = [0.0, 0.0, 0.3], [0.0, 0.0, 0.25]  # centres of the boxes above the pivots
    assert last[0, COLUMN["x"]] == pytest.approx(np.hypot(*(agent - patient)[:2]), rel=1e-5)
    assert last[0, COLUMN["y"]] == pytest.approx(0, abs=1e-6)
    assert last[0, COLUMN["z"]] == pytest.approx(agent[2] + middle[0][2], rel=1e-5)
    speed = seen.trajectory.velocities[44, 0]
    moved = np.sinh(last[0, [COLUMN["vx"], COLUMN["vy"], COLUMN["vz"]]])
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(speed), rel=1e-5)
    assert moved[2] == pytest.approx(speed[2], rel=1e-5)
    sizes = [COLUMN[name] for name in ("length", "width", "height")]
    assert last[0, sizes] == pytest.approx([0.2, 0.4, 0.6], rel=0.02)
    # A cone fills a third of the cylinder, a cube all of its box.
    assert last[0, COLUMN["filled"]] == pytest.approx(np.pi / 12, rel=0.05)
    assert last[1, COLUMN["filled"]] == 1 and last[1, COLUMN["fixed"]] == 1
    assert last[0, COLUMN["corner +++"]] < last[0, COLUMN["corner ++-"]] < 1
    assert last[3:5, COLUMN["cloth"]].sum() == 1


def test_tokens_of_states_turn_with_agent_and_patient_and_mirror_with_the_world() -> None:
    model: Any = build_model("intuition-states", objects=6, weights="random")
    made = scene(Body("far", "cube", (0.0, 0.0, 0.0)))
    plain = state_tokens(motion(made), "t", FRAMES, 6)
    turned = state_tokens(motion(made, angle=2.0, shift=5.0), "t", FRAMES, 6)
    bodies = plain[-1, :, COLUMN["cloth"]] == 0
    assert turned[:, bodies] == pytest.approx(plain[:, bodies], abs=1e-5)
    mirrored = state_tokens(motion(made, mirrored=True), "t", FRAMES, 6)
    image = model._mirrored(torch.from_numpy(plain)).numpy()
    # Bodies that do not turn have other axes than a mirror image.
    compared = [i for name, i in COLUMN.items() if not name.startswith(("axis", "up"))]
    assert mirrored[..., compared] == pytest.approx(image[..., compared], abs=1e-5)


def test_tokens_of_masks_hold_the_largest_objects() -> None:
    ids = np.zeros((2, 8, 8), np.uint8)
    ids[:, :2, :4], ids[0, 6:, 6:], ids[:, 3:6, 0:2], ids[:, 4, 4] = 1, 2, 5, 3
    ids[0, 3, 2] = 5  # so that up and down, left and right differ
    tokens = mask_tokens(ids, 3)
    columns = VIEWS["masks"].columns
    first = dict(zip(columns, tokens[0].T, strict=True))
    assert first["there"].tolist() == [1, 1, 1] and tokens[1, :, 0].tolist() == [1, 0, 1]
    assert first["area"] == pytest.approx(np.sqrt([8 / 64, 4 / 64, 7 / 64]))
    assert first["x"] == pytest.approx([0.25 - 0.5, 0.875 - 0.5, (6 * 1 + 2.5) / 7 / 8 - 0.5])
    assert first["bottom"] == pytest.approx([-0.25, 0.5, 0.25])
    # Corners of a box of 4 x 2 of 8 pixels, 2 and 1 pixels from its middle.
    for turn in (1, 2, 3, 5, 6, 7, 9, 10, 11, 13, 14, 15):
        x, y = np.abs([np.cos(turn * np.pi / 8), np.sin(turn * np.pi / 8)])
        assert first[f"reach {turn}"][0] == pytest.approx((2 * x + y) / 8, abs=1e-6)
    # The other object, of mean (8.5, 30.5) / 7, reaches to the corners (3, 3), (0, 3), (0, 6).
    x, y = 8.5 / 7, 30.5 / 7
    for turn, (dx, dy) in {14: (3 - x, y - 3), 10: (x, y - 3), 6: (x, 6 - y)}.items():
        assert first[f"reach {turn}"][2] == pytest.approx((dx + dy) / 8 / np.sqrt(2), abs=1e-6)
    assert (tokens[1, 1, : -len(VIEWS["masks"].constants)] == 0).all()
    model: Any = build_model("intuition-masks", objects=3, weights="random")
    image = model._mirrored(torch.from_numpy(tokens)).numpy()
    assert image == pytest.approx(mask_tokens(ids[:, :, ::-1], 3), abs=1e-6)


@pytest.mark.parametrize("reading", [of for of in READINGS["masks"] if of.changes])
def test_a_network_reads_changes_of_masks_that_are_there_in_both_frames(reading: Any) -> None:
    ids = np.zeros((15, 16, 32), np.uint8)
    ids[:, 10:12, 20:25] = 2
    for frame in range(15):
        ids[frame, 2:6, frame : frame + 4] = 1
    ids[7, :8] = 0
    model: Any = build_model("intuition-masks", objects=3, weights="random")
    tokens = torch.from_numpy(mask_tokens(ids, 3))[None]
    values, there = model._values(tokens, reading)
    assert there.tolist() == [[True, True, False]]
    track = reading.track
    assert values.shape == (1, 3, 15 * (2 * len(track) + 3) + 2)
    other = tokens.clone()
    left_out = [name not in (*track, "agent", "patient") for name in VIEWS["masks"].columns]
    other[..., left_out] += 1
    assert torch.equal(model._values(other, reading)[0], values)
    read = values[0, :, : -len(VIEWS["masks"].constants)].reshape(3, 15, -1)
    changes = dict(zip(track[1:], read[..., 1 - len(track) :].permute(2, 0, 1), strict=True))
    expected = [0.0] + [1 / 32] * 6 + [0.0] * 2 + [1 / 32] * 6
    for name in ("x", "left", "right"):
        assert changes[name][0] == pytest.approx(expected), name
    for name, change in changes.items():
        assert (change[1:] == 0).all(), "nothing else moves"
        if name not in ("x", "left", "right"):
            assert change[0] == pytest.approx(0, abs=1e-6), "turned or grown"
    # In training they have noise, and their own standard deviation.
    sample = MovingSquares(model.spec).context([f"drop_{number:04d}" for number in range(150)])
    model = build_model("intuition-masks", image_size=16, objects=3, weights="random").train()
    model.prepare(replace(sample, contact=torch.tensor([True, False] * 75)))
    tokens = model._tokens(sample)
    values, _ = model._values(tokens, reading)
    read = values[..., : -len(VIEWS["masks"].constants)].reshape(150, 3, 15, -1)
    moved = read[:, 0, 1:, 1 - len(track) + track.index("x") - 1]
    assert float(moved.std()) == pytest.approx(1, rel=0.5) and len(torch.unique(moved)) > 2000
    assert (read[:, :, 0, 1 - len(track) :] == 0).all(), "no noise where nothing is before"


def test_networks_of_masks_read_different_things_and_their_mean_is_the_answer() -> None:
    model: Any = build_model("intuition-masks", image_size=16, objects=3, weights="random")
    assert model.readings == [*READINGS["masks"]] and not model.readings[-1].changes
    batch = MovingSquares(model.spec).context([f"drop_{number:04d}" for number in range(9)])
    with torch.no_grad():
        alone = model.logits(batch).sigmoid().unflatten(0, (-1, 2)).mean(1)
        answers = model.predict(batch)
    assert len(alone) == 3 and len(torch.unique(alone[:, 0])) == 3
    assert torch.allclose(answers, alone.mean(0))
    four: Any = build_model("intuition-masks", image_size=16, members=4, weights="random")
    assert four.readings[3] == four.readings[0]


def clips(ids: Any, frames: Any = FRAMES) -> Batch:
    """Return a batch of pictures of objects (B, T, H, W), as tensors."""
    count, steps = ids.shape[:2]
    return Batch(
        tuple(f"t{i}" for i in range(count)), np.tile(np.asarray(frames), (count, 1)),
        np.ones((count, steps), np.bool_), ids=ids,
    ).to("cpu")  # fmt: skip


class MovingSquares(ClipSource):
    """Trials in which a square moves right; it touches the other one if that is on its line.

    Objects other than these two are noise.
    """

    def __init__(self, spec: Any, count: int = 150) -> None:
        self.spec, rng = spec, np.random.default_rng(0)
        self.trials = tuple(f"drop_{number:04d}" for number in range(count))
        self.rows = dict(zip(self.trials, rng.integers(0, 12, (count, 3)), strict=True))
        self.outcomes = {t: bool(abs(r[0] - r[1]) < 4) for t, r in self.rows.items()}

    def length(self, trial: str) -> int:
        return 60

    def key(self, trial: str, part: str) -> str:
        assert part == "context", "the future of a trial is not read"
        return trial

    def clips(self, trials: Any, frames: Any) -> Batch:
        ids = np.zeros((len(trials), len(frames[0]), 16, 16), np.uint8)
        for clip, trial in zip(ids, trials, strict=True):
            top, other, more = self.rows[trial]
            for frame, picture in zip(frames[0], clip, strict=True):
                assert frame < 45
                picture[more : more + 2, 6:8] = 3
                picture[other : other + 4, 12:16] = 2
                picture[top : top + 4, frame // 8 : frame // 8 + 4] = 1
        return replace(clips(ids, frames[0]), trials=tuple(trials))


QUICK = TrainingSettings(steps=50, batch=64, learning_rate=3e-3, validate_every=50)


def test_outcomes_are_learned_from_contexts_and_the_order_of_objects_does_not_matter() -> None:
    model: Any = build_model(
        "intuition-masks", image_size=16, width=32, layers=1, objects=4, weights="random"
    )
    source: Any = MovingSquares(model.spec)

    def features(trials: Any) -> Any:
        return [row.numpy() for row in model.encode(source.context(trials))]

    settings = {"seed": 0, "name": "all", "folder": None, "accelerator": "cpu", "settings": QUICK}
    with pytest.raises(BadInputError, match=r"learns outcomes, but 150 trials .* without"):
        train_model(model, source, source.trials, features=features, **settings)
    result = train_model(
        model, source, source.trials, features=features, outcomes=source.outcomes, **settings
    )
    assert result.validation < 0.5 * result.baseline
    assert float(model.base_rate) == pytest.approx(np.mean([*source.outcomes.values()]), abs=0.05)
    asked = MovingSquares(model.spec, 100)
    batch = asked.context(asked.trials)
    with torch.no_grad():
        answers = model.predict(batch)
        image = model.predict(replace(batch, ids=batch.ids.flip(3)))
        other = model.predict(replace(batch, ids=torch.where(batch.ids == 3, 7, batch.ids)))
    right = (answers.numpy() > 0.5) == np.array([*asked.outcomes.values()])
    assert right.mean() > 0.9
    assert torch.allclose(answers, image, atol=1e-5), "a mirror image has the same answer"
    assert torch.equal(answers, other), "the number of an object means nothing"


def test_unusual_trials_get_the_base_rate_or_a_note() -> None:
    model: Any = build_model("intuition-masks", image_size=16, objects=3, weights="random")
    model.base_rate.fill_(0.25)
    source = MovingSquares(model.spec, 3)
    batch = source.context(source.trials)
    batch.ids[1][batch.ids[1] == 2] = 0
    batch.ids[2, :, 0, 0], batch.ids[2, 0, 0, 1] = 9, 8
    with torch.no_grad():
        answers = model.predict(batch)
    assert answers[1] == 0.25 and (answers[[0, 2]] != 0.25).all()
    assert model.notes(batch) == [
        "",
        "agent or patient never visible: base rate",
        "5 objects, only 3 are looked at",
    ]


def test_a_scene_without_a_probe_leaves_its_token_empty_and_the_note_says_so() -> None:
    model: Any = build_model("intuition-states", objects=4, weights="random")
    made = scene(*(Body(f"b{n}", "cube", (0.0, float(n), 0.0), (1.0, 1.0, 1.0)) for n in (1, 2)))
    frames = np.array([model.spec.context_frames()])
    shown = Batch(("s",), frames, np.ones_like(frames, np.bool_), state=(motion(made),)).to("cpu")
    tokens = state_tokens(motion(made), "s", frames[0], 4)
    assert int((tokens[..., 0] > 0).any(0).sum()) == 3
    assert model.notes(shown) == ["5 objects, only 3 are looked at"]


def test_other_frames_and_sizes_are_refused_in_one_line() -> None:
    model: Any = build_model("intuition-masks", image_size=16, weights="random")
    ids = np.zeros((1, 15, 16, 16), np.uint8)
    with pytest.raises(
        BadInputError, match=r"frames 2, 5, \.\.\., 44 are needed, not 15 frames up to 14"
    ):
        model.predict(clips(ids, np.arange(15)))
    with pytest.raises(BadInputError, match=r"of 16 x 16 are needed, not \(8, 8\)"):
        model.predict(clips(ids[:, :, :8, :8]))
    with pytest.raises(BadInputError, match="objects must be at least 3"):
        build_model("intuition-states", objects=2, weights="random")
    with pytest.raises(BadInputError, match="must be a multiple of heads"):
        build_model("intuition-states", width=30, weights="random")


def pictures(rgb: Any, names: Any) -> Batch:
    """Return a batch of pictures (B, T, H, W, 3)."""
    frames = np.tile(FRAMES, (len(rgb), 1))
    return Batch(tuple(names), frames, np.ones(frames.shape, np.bool_), rgb=rgb).to("cpu")


def test_pixels_become_the_tokens_of_the_masks_that_are_found() -> None:
    made = sample_scene("drop", 7003)
    seen = Motion(made, simulate(made, frames=45))
    renderer = MotionRenderer({"new": seen}, ("rgb", "ids"), 96, 1, {"new": "redyellow"})
    drawn = renderer.read("new", FRAMES)
    model: Any = build_model("intuition-pixels", weights="random")
    true: Any = build_model("intuition-masks", image_size=96, weights="random")
    batch = pictures(drawn["rgb"][None], ["new"])
    tokens = model.encode(batch)
    assert np.array_equal(tokens[0].reshape(15, 8, -1), mask_tokens(segment(drawn["rgb"]), 8))
    expected = true.encode(clips(drawn["ids"][None]))[0].reshape(15, 8, -1)
    found = tokens[0].reshape(15, 8, -1)
    # Agent and patient: there, area, x, y and the others, in fractions of the picture.
    alike = len(VIEWS["pixels"].track)
    assert (found[:, :2, :alike] - expected[:, :2, :alike]).abs().mean() < 0.01
    with torch.no_grad():
        assert torch.equal(model.predict(batch), model.predict(replace(batch, features=tokens)))
    assert model.notes(batch) == [""]
    assert model.encoder_digest() != true.encoder_digest()


def test_tokens_of_masks_say_the_same_at_any_size() -> None:
    made = sample_scene("drop", 7003)
    seen = Motion(made, simulate(made, frames=45))
    shipped: Any = build_model("intuition-masks")
    assert shipped.spec.image_size == 192
    found, answers = [], []
    for size in (96, 192):
        renderer = MotionRenderer({"new": seen}, ("ids",), size, 1, {"new": "redyellow"})
        model: Any = build_model("intuition-masks", image_size=size, weights="random")
        batch = clips(renderer.read("new", FRAMES)["ids"][None])
        tokens = model.encode(batch)
        found.append(tokens[0].reshape(15, 8, -1)[:, :2])
        with torch.no_grad():
            answers.append(float(shipped.predict(replace(batch, features=tokens))))
    both = (found[0][..., :1] > 0) & (found[1][..., :1] > 0)
    # Places, sizes, borders and reaches differ by less than a pixel of the coarser picture.
    assert 0 < ((found[0] - found[1]).abs() * both).max() < 1 / 96
    assert answers[0] != answers[1] and abs(answers[0] - answers[1]) < 0.1
    with pytest.raises(BadInputError, match="are for image_size=192, not 96"):
        build_model("intuition-masks", image_size=96)


def test_with_a_cue_only_the_masks_of_the_first_frame_count() -> None:
    made = sample_scene("drop", 7003)
    seen = Motion(made, simulate(made, frames=45))
    renderer = MotionRenderer({"new": seen}, ("rgb", "ids"), 96, 1, {"new": "free"})
    drawn = renderer.read("new", FRAMES)
    model: Any = build_model("intuition-pixels", cue=True)
    assert model.spec.inputs == ("rgb", "ids")
    batch = replace(pictures(drawn["rgb"][None], ["new"]), ids=drawn["ids"][None])
    tokens = model.encode(batch)
    found = mask_tokens(segment(drawn["rgb"], drawn["ids"][0]), 8)
    assert np.array_equal(tokens[0].reshape(15, 8, -1), found)
    later = drawn["ids"].copy()
    later[1:] = 0
    assert torch.equal(model.encode(replace(batch, ids=later[None])), tokens)
    assert model.notes(batch) == [""]
    none = replace(batch, ids=np.zeros_like(drawn["ids"])[None])
    with torch.no_grad():
        assert model.predict(none).tolist() == [float(model.base_rate)]
    assert model.notes(none) == ["agent or patient not visible in the first frame: base rate"]
    with pytest.raises(BadInputError, match=r"\(input ids\) of 96 x 96 are needed, not none"):
        model.predict(pictures(drawn["rgb"][None], ["new"]))
    with pytest.raises(BadInputError, match="cue=true is for intuition-pixels"):
        build_model("intuition-masks", cue=True)
    plain = build_model("intuition-pixels")
    assert plain.digest() != model.digest() and plain.encoder_digest() != model.encoder_digest()


def test_pictures_without_red_and_yellow_have_the_base_rate_and_a_note() -> None:
    model: Any = build_model("intuition-pixels", weights="random")
    model.base_rate.fill_(0.25)
    grey = np.full((2, 15, 96, 96, 3), 90, np.uint8)
    both = pictures(grey, ["a", "b"])
    with torch.no_grad():
        assert model.predict(both).tolist() == [0.25, 0.25]
    assert model.notes(both) == ["red agent or yellow patient never visible: base rate"] * 2
    with pytest.raises(BadInputError, match=r"pictures \(input rgb\) of 96 x 96 are needed, not"):
        model.predict(pictures(grey[:, :, :48, :48], ["a", "b"]))
    with pytest.raises(BadInputError, match="image_size must be 96"):
        build_model("intuition-pixels", image_size=64, weights="random")
