"""RPIN: boxes, regions, interaction, and losses in closed form; objects that are not seen."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from physion.clips.batch import Batch
from physion.core.errors import BadInputError
from physion.models.build import build_model
from physion.models.rpin import (
    UNIT,
    Backbone,
    Dynamics,
    Interaction,
    RolledOut,
    Rpin,
    RpinSettings,
    Targets,
    constant_velocity,
    cut_regions,
    is_present,
    known_boxes,
    last_changes,
    to_center,
    to_edges,
)
from support.moving_squares import squares, with_arrays

NAN = float("nan")


def model_of(**options: Any) -> Any:
    return build_model("rpin", **{"weights": "random", **options}).eval()  # type: ignore[attr-defined]


def with_boxes(batch: Batch, boxes: torch.Tensor) -> Batch:
    return with_arrays(batch, boxes=boxes)


def test_boxes_of_frames_that_do_not_show_an_object() -> None:
    """The last box stands in, before the first one the first; an object never seen has zeros."""
    box = torch.tensor([[0.1, 0.2, 0.3, 0.6], [0.2, 0.2, 0.4, 0.6]])
    missing = torch.full((4,), NAN)
    clip = torch.stack([missing, box[0], missing, box[1], missing])
    boxes = torch.stack([clip, torch.full((5, 4), NAN)], 1)[None]
    known = known_boxes(boxes)
    first, second = to_center(box)
    assert torch.equal(known[0, :, 0], torch.stack([first, first, first, second, second]))
    assert torch.equal(known[0, :, 1], torch.zeros(5, 4))
    assert is_present(known)[0].all(0).tolist() == [True, False]


def test_centres_and_edges_are_inverse() -> None:
    box = torch.tensor([0.1, 0.2, 0.3, 0.6])
    assert torch.allclose(to_center(box), torch.tensor([0.2, 0.4, 0.2, 0.4]))
    assert torch.allclose(to_edges(to_center(box)), box)


def test_constant_velocity_continues_a_line() -> None:
    start, change = torch.tensor([0.1, 0.2, 0.3, 0.4]), torch.tensor([0.02, -0.01, 0.01, 0.0])
    line = (start + torch.arange(6.0)[:, None] * change)[None, :, None]
    assert torch.allclose(constant_velocity(line[:, :3], 3), line[:, 3:], atol=1e-6)
    assert torch.equal(constant_velocity(line[:, :1], 2), line[:, [0, 0]])


def test_changes_of_boxes_are_in_units() -> None:
    boxes = torch.tensor([0.1, 0.1 + UNIT, 0.1 - UNIT]).view(1, 3, 1, 1).expand(1, 3, 1, 4)
    changes = last_changes(boxes)[0, :, 0, 0]
    assert torch.allclose(changes, torch.tensor([0.0, 1.0, -2.0]), atol=1e-5)


def test_the_region_of_a_ramp_has_its_values_at_the_centres_of_the_cells() -> None:
    """A ramp with the column as its value is sampled exactly; pixel centres are at 0.5."""
    columns = torch.arange(20.0) + 0.5
    maps = columns.expand(1, 1, 20, 20)
    boxes = torch.tensor([[[0.5, 0.5, 0.3, 0.3]]])  # from column 7 to 13
    region = cut_regions(maps, boxes, 3, 0.0, sampling=1, aligned=True)[0, 0, 0]
    assert torch.allclose(region, torch.tensor([8.0, 10.0, 12.0]).expand(3, 3), atol=1e-5)
    enlarged = cut_regions(maps, boxes, 3, 1.0, sampling=1, aligned=True)[0, 0, 0]
    assert torch.allclose(enlarged, torch.tensor([6.0, 10.0, 14.0]).expand(3, 3), atol=1e-5)


def test_regions_belong_to_their_picture() -> None:
    maps = torch.arange(3.0).view(3, 1, 1, 1).expand(3, 1, 8, 8)
    boxes = torch.tensor([0.5, 0.5, 0.4, 0.4]).expand(3, 2, 4)
    regions = cut_regions(maps, boxes, 2, 0.1, sampling=2, aligned=True)
    assert torch.allclose(regions, torch.arange(3.0).view(3, 1, 1, 1, 1))


def test_an_interaction_follows_the_order_of_the_objects() -> None:
    torch.manual_seed(0)
    interaction = Interaction(4)
    states, order = torch.randn(2, 5, 4, 3, 3), torch.tensor([4, 2, 0, 1, 3])
    present = torch.tensor([[True, True, True, False, True], [True] * 5])
    effects = interaction(states, present)
    permuted = interaction(states[:, order], present[:, order])
    assert torch.allclose(permuted, effects[:, order], atol=1e-5)
    assert not torch.allclose(effects[:, order], effects, atol=1e-3)


def test_a_relation_is_one_convolution_of_both_states() -> None:
    """The two products, added, are the convolution of the joined states (Qi et al. 2021)."""
    torch.manual_seed(0)
    interaction, states = Interaction(3), torch.randn(1, 2, 3, 3, 3)
    joined = torch.nn.Conv2d(6, 3, 3, padding=1)
    with torch.no_grad():
        weights = [interaction.receiver.weight, interaction.sender.weight]
        joined.weight.copy_(torch.cat(weights, 1))
        joined.bias.copy_(interaction.receiver.bias)  # type: ignore[union-attr, arg-type]
        relation = torch.relu(joined(torch.cat([states[:, 0], states[:, 1]], 1)))
        effect = interaction.affect(interaction.alone(states[:, 0]) + relation)
        expected = interaction.join(torch.cat([effect, states[:, 0]], 1))
        found = interaction(states, torch.ones(1, 2, dtype=torch.bool))[:, 0]
    assert torch.allclose(found, expected, atol=1e-6)


def test_absent_objects_have_no_effect() -> None:
    torch.manual_seed(0)
    dynamics = Dynamics(4, 3, 2)
    states, boxes = torch.randn(2, 2, 5, 4, 3, 3), torch.rand(2, 2, 5, 4)
    present = torch.tensor([True, True, True, False, False]).expand(2, 5)
    state, decoded = dynamics(states, boxes, present)
    alone = dynamics(states[:, :, :3], boxes[:, :, :3], present[:, :3])
    assert torch.allclose(state[:, :3], alone[0], atol=1e-5)
    assert torch.allclose(decoded[:, :3], alone[1], atol=1e-5)
    assert not state[:, 3:].any()


def test_the_maps_have_a_quarter_of_the_resolution() -> None:
    with torch.no_grad():
        maps = Backbone(16, 2, 4)(torch.zeros(2, 3, 64, 64))
    assert maps.shape == (2, 16, 16, 16)


def missing_objects(model: Any, frames: int) -> Batch:
    """Return clips of which the second has no object at all, and the first hides one for a time."""
    batch = squares(2, frames, model.spec, count=3)
    boxes = batch.boxes.clone()
    boxes[0, :2, 1] = NAN
    boxes[0, 3:, 2] = NAN
    boxes[1] = NAN
    return with_boxes(batch, boxes)


@pytest.mark.parametrize("outputs", ["boxes", "published"])
def test_objects_that_are_not_seen_leave_no_nan(outputs: Any) -> None:
    model = Rpin(RpinSettings(outputs=outputs, weights="random")).eval()
    clip = missing_objects(model, model.settings.history + 2)
    losses = model.loss(clip)
    losses["loss"].backward()
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    assert gradients and all(bool(g.isfinite().all()) for g in gradients)
    context = missing_objects(model, model.spec.context)
    with torch.no_grad():
        features = model.encode(context)
        rollout = model.imagine(context, 1, 0)
        assert model.baseline(clip).isfinite()
    assert features.isfinite().all() and rollout.features.isfinite().all()
    assert not features[1].any() and not rollout.features[1].any()
    shown = rollout.shown["boxes"]
    assert shown[0, 0, :, :3].isfinite().all() and shown[0, 0, :, 3:].isnan().all()
    assert shown[1].isnan().all()


def test_a_clip_without_objects_costs_nothing() -> None:
    model = model_of()
    batch = squares(1, model.window, model.spec, count=0)
    loss = model.loss(batch)["loss"]
    loss.backward()
    assert loss.item() == 0 and model.baseline(batch).item() == 0


def test_boxes_at_constant_velocity_cost_the_baseline_nothing() -> None:
    model = model_of()
    batch = squares(3, model.window, model.spec)
    assert model.baseline(batch).item() == pytest.approx(0, abs=1e-6)
    with torch.no_grad():
        errors, constant = model.center_errors(batch)
    steps = model.settings.rollout
    assert errors.shape == constant.shape == (steps,)
    assert constant.max() < 1e-6


def test_an_untrained_network_predicts_that_nothing_moves() -> None:
    model = model_of()
    batch = squares(3, model.window, model.spec)
    history = model.settings.history
    true = to_center(batch.boxes[:, :, :2])
    moved = (true[:, history:] - true[:, history - 1 : history])[..., :2].norm(dim=-1)
    with torch.no_grad():
        errors, _ = model.center_errors(batch)
        shown = model.imagine(squares(3, 5, model.spec), 1, 0).shown["boxes"]
    assert torch.allclose(errors, moved.mean((0, 2)), atol=1e-6)
    last = squares(3, 5, model.spec).boxes[:, -1, :2]
    assert torch.allclose(shown[:, 0, :, :2], last[:, None].expand(-1, 11, -1, -1), atol=1e-6)


def test_what_is_decoded_moves_the_boxes_by_units_a_step() -> None:
    """Step s adds s times the decoded change of centre and size to the last observed box."""
    model = model_of()
    decoded = torch.tensor([0.5, -1.0, 0.25, -0.5])
    with torch.no_grad():
        model.dynamics.decode.bias.copy_(decoded)
        context = squares(2, model.spec.context, model.spec)
        shown = model.imagine(context, 1, 0).shown["boxes"][:, 0, :, :2]
    last = to_center(context.boxes)[:, -1:, :2]
    steps = torch.arange(1.0, 12.0)[:, None, None]
    assert torch.allclose(to_center(shown), last + steps * 0.02 * decoded, atol=1e-5)


def test_the_distance_of_given_boxes() -> None:
    """Half the square up to one unit, linear beyond; what does not count is left out."""
    model = model_of()
    true = torch.zeros(1, 1, 3, 4)
    predicted = true.clone()
    predicted[0, 0, 0, 0], predicted[0, 0, 1, 1], predicted[0, 0, 2, 2] = UNIT, 3 * UNIT, 9.0
    counted = torch.tensor([[[True, True, False]]])
    loss = model._distance(predicted, Targets(true, counted))
    assert loss.item() == pytest.approx((0.5 + 2.5) / 2)


def test_the_published_loss_of_given_values() -> None:
    """100 (1 + 4) + (9 + 16) for one object that moved by 2 and 3 pixels to (52, 33)."""
    model = model_of(size="released")
    size = model.settings.image_size
    last = torch.tensor([50.0, 30.0, 10.0, 10.0]).view(1, 1, 1, 4) / size
    true = torch.tensor([52.0, 33.0, 10.0, 10.0]).view(1, 1, 1, 4) / size
    decoded = torch.tensor([3.0, 5.0, 55.0, 37.0]).view(1, 1, 1, 4)
    imagined = RolledOut(true, true, decoded)
    targets = Targets(true, torch.ones(1, 1, 1, dtype=torch.bool))
    assert model._published(imagined, last, targets).item() == pytest.approx(525, rel=1e-4)


@pytest.mark.nightly
@pytest.mark.slow
def test_published_boxes_keep_their_size() -> None:
    model = model_of(size="released")
    context = squares(1, model.spec.context, model.spec)
    with torch.no_grad():
        shown = to_center(model.imagine(context, 1, 0).shown["boxes"][0, 0, :, 0])
    assert torch.allclose(shown[:, 2:], torch.full((11, 2), 0.2), atol=1e-5)
    assert not torch.allclose(shown[:, :2], to_center(context.boxes)[0, -1, 0, :2], atol=1e-3)


def test_frames_past_the_end_of_a_trial_do_not_count() -> None:
    model = model_of()
    batch = squares(2, model.window, model.spec)
    valid = batch.valid.clone()
    valid[:, -2:] = False
    boxes = batch.boxes.clone()
    boxes[:, -2:] = boxes[:, -2:] * 0.5
    cut = model.loss(with_arrays(batch, valid=valid, boxes=boxes))["loss"]
    short = model.loss(batch.steps(slice(0, model.window - 2)))["loss"]
    assert cut.item() == pytest.approx(short.item(), rel=1e-5)


def test_the_last_frames_of_the_context_are_rolled_out() -> None:
    """With 4 frames of 5 as the history, the first one has no effect on the future."""
    model = model_of()
    context = squares(1, model.spec.context, model.spec)
    rgb = context.rgb.clone()
    rgb[:, 0] = 0
    with torch.no_grad():
        before = model.imagine(context, 1, 0).features
        after = model.imagine(with_arrays(context, rgb=rgb), 1, 0).features
    assert torch.equal(before, after)


def test_bad_boxes_are_named() -> None:
    model = model_of()
    batch = squares(1, 5, model.spec)
    with pytest.raises(BadInputError, match="boxes of 8 objects are needed, not 3"):
        model.encode(with_boxes(batch, batch.boxes[:, :, :3]))
    with pytest.raises(BadInputError, match="boxes of 8 objects are needed, not none"):
        model.encode(with_arrays(batch, boxes=None))
    with pytest.raises(BadInputError, match="needs more than 4 frames, not 4"):
        model.loss(batch.steps(slice(0, 4)))


def test_history_lies_in_the_context_of_every_size() -> None:
    for size in ("small", "paper", "released"):
        model = model_of(size=size)
        assert model.settings.history <= model.spec.context == 5
        last = 135 if size == "released" else 152
        assert model.spec.all_frames(150)[-1] == last


def test_the_order_of_objects_is_their_place_and_not_their_role() -> None:
    """Features of clips whose objects change numbers are equal; shown boxes keep the numbers."""
    model = model_of()
    with torch.no_grad():
        model.dynamics.decode.weight.normal_()
    clip = squares(4, 8, model.spec, count=4)
    swapped = with_boxes(clip, clip.boxes[:, :, [1, 0, 3, 2, *range(4, 8)]])
    found, other = model.encode(clip), model.encode(swapped)
    assert torch.allclose(found, other, atol=1e-6) and not torch.equal(clip.boxes, swapped.boxes)
    # Frames 0, 9, ..., 63: number 4 is frame 36, and number 5 comes after the observed part.
    centers = model._split(found)[1][:, 4, :4, 0]
    assert (centers.diff(dim=1) >= 0).all()
    left = to_center(clip.boxes)[:, 4, :4, 0]
    assert torch.allclose(centers, left.sort(dim=1).values, atol=1e-6)
    assert not (to_center(clip.boxes)[:, 5, :4, 0].gather(1, left.argsort(1)).diff() > 0).all()
    context, turned = clip.steps(slice(0, 5)), swapped.steps(slice(0, 5))
    with torch.no_grad():
        assert torch.allclose(model.encode(context), found[:, :5], atol=1e-5)
        rollouts = [model.imagine(batch, 1, 0) for batch in (context, turned)]
    assert torch.allclose(rollouts[0].features, rollouts[1].features, atol=1e-5)
    boxes, exchanged = (rollout.shown["boxes"] for rollout in rollouts)
    assert torch.allclose(boxes[..., [1, 0, 3, 2], :], exchanged[..., :4, :], atol=1e-5)
    gap = to_center(boxes[:, 0, 0, :4]) - to_center(context.boxes[:, -1, :4])
    assert gap.abs().max() < 0.2, "each box continues its own"
