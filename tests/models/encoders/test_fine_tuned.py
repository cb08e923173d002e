"""Encoders that are trained with the dynamics: gradients, digests, features that stay different."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from physion.core.errors import BadInputError
from physion.models import Batch, build_model
from physion.models.checkpoint import WEIGHTS, load_weights
from physion.models.encoders.encoder import FINE_TUNING, FineTunedEncoder
from physion.models.interface import TrainingSettings
from physion.readout.evaluate import evaluate
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings
from physion.training.devices import Devices, make_fabric
from physion.training.train import train_model
from support.moving_dots import make_dots
from support.tiny_models import TINY
from support.trained_models import MovingValues

FEW: dict[str, Any] = {
    **TINY, "image_size": 32, "context": 2, "future": 2, "fine_tuned": True,
}  # fmt: skip
QUICK = TrainingSettings(steps=3, batch=4, learning_rate=1e-3, held_out=0.25)


def make(**options: Any) -> FineTunedEncoder:
    model = build_model("frozen-encoder", **{**FEW, **options})
    assert isinstance(model, FineTunedEncoder)
    return model


def clips(count: int = 4, frames: int = 3, size: int = 32, seed: int = 0) -> Batch:
    """A bright square that moves by some pixels each frame, on a noisy ground."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 60, (count, frames, size, size, 3), dtype=np.uint8)
    for clip in range(count):
        x, y, step = rng.integers(0, size - 14, 2).tolist() + rng.integers(1, 4, 1).tolist()
        for frame in range(frames):
            left = x + step * frame
            rgb[clip, frame, y : y + 8, left : left + 8] = (220, 180, 40)
    return Batch(
        tuple(f"t{row}" for row in range(count)),
        np.tile(np.arange(frames), (count, 1)),
        np.ones((count, frames), np.bool_),
        rgb=rgb,
    ).to("cpu")


def gradients(model: FineTunedEncoder, loss: Tensor) -> list[Tensor]:
    model.zero_grad()
    loss.backward()
    return [p.grad.clone() for p in model.parameters() if p.grad is not None]


def test_gradients_reach_encoder_and_dynamics_but_not_the_initial_encoder() -> None:
    model, batch = make(residual=False), clips()
    model.prepare(batch)
    model.loss(batch)["loss"].backward()
    for part in (model.encoder, model.dynamics):
        assert all(p.grad is not None for p in part.parameters())
        assert sum(float(p.grad.abs().sum()) for p in part.parameters()) > 0  # type: ignore[union-attr]
    assert not any(p.requires_grad for p in model._initial[0].parameters())


def test_no_gradient_passes_through_the_target() -> None:
    model, batch = make(residual=False, distillation=0.5), clips()
    model.prepare(batch)
    with torch.no_grad():
        for parameter in model.encoder.parameters():
            parameter += 0.01 * torch.randn(parameter.shape, generator=torch.manual_seed(0))
    initial = model._initial[0]

    def by_hand(stopped: bool) -> Tensor:
        pictures = batch.rgb.float().permute(0, 1, 4, 2, 3) / 255
        mean, std = (torch.tensor(v).view(3, 1, 1) for v in (model.spec.mean, model.spec.std))
        flat = ((pictures - mean) / std).flatten(0, 1)
        z, z0 = (
            (network(flat).view(4, 3, -1) - model.center) / model.scale
            for network in (model.encoder, initial)
        )
        target = z[:, 2].detach() if stopped else z[:, 2]
        prediction = (model.dynamics(z[:, :2]) - target).pow(2).mean()
        return prediction + 0.5 * (z - z0).pow(2).mean()

    own = gradients(model, model.loss(batch)["loss"])
    stopped, open_ = (gradients(model, by_hand(stopped)) for stopped in (True, False))
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(own, stopped, strict=True))
    assert not all(torch.allclose(a, b, atol=1e-5) for a, b in zip(own, open_, strict=True))


def test_before_training_the_loss_is_that_of_the_frozen_encoder() -> None:
    """Residual dynamics add nothing at first, so that it is that of repeating the last feature."""
    model, batch = make(), clips()
    model.prepare(batch)
    losses = model.loss(batch)
    assert float(losses["change"].detach()) == pytest.approx(0, abs=1e-10)
    assert float(losses["variance"]) == pytest.approx(1, rel=1e-4)
    assert float(losses["loss"].detach()) == pytest.approx(float(model.baseline(batch)), rel=1e-5)
    frozen: Any = build_model("frozen-encoder", **{**FEW, "fine_tuned": False})
    assert torch.equal(frozen.encode(batch), model.encode(batch))


def descend(model: FineTunedEncoder, steps: int, rate: float, *, fixed: bool) -> None:
    """Train on one batch, or on another one at each step, with clipped gradients."""
    optimizer = torch.optim.Adam(model.parameters(), lr=rate)
    for step in range(steps):
        optimizer.zero_grad()
        model.loss(clips(seed=0 if fixed else step))["loss"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()


def test_one_batch_is_learned_by_heart() -> None:
    model, batch = make(encoder="test_efficientnet"), clips()
    model.prepare(batch)
    descend(model, 80, 1e-3, fixed=True)
    assert float(model.loss(batch)["loss"].detach()) < 0.1 * float(model.baseline(batch))


class _WithoutDistillation(FineTunedEncoder):
    """Encoder and dynamics that are trained on the error of the next feature alone."""

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        features = self.standardise(self.features_of(self.encoder, batch))
        windows, target = self.windows(features)
        variance = features.detach().flatten(0, 1).var(0, correction=0).mean()
        return {"loss": functional.mse_loss(self.step(windows), target), "variance": variance}


@pytest.mark.parametrize("encoder", ["test_efficientnet", "test_vit"])
def test_features_of_different_pictures_stay_different(encoder: str) -> None:
    """Where the loss of the next feature alone makes them equal."""
    kept, lost = make(encoder=encoder), make(encoder=encoder)
    lost.__class__ = _WithoutDistillation
    unseen = clips(16, seed=1000)
    variances = []
    for model in (kept, lost):
        model.prepare(clips(16))
        descend(model, 100, FINE_TUNING.learning_rate, fixed=False)
        variances.append(float(model.loss(unseen)["variance"]))
    assert variances[0] > 0.25 and variances[1] < 0.1


@pytest.mark.parametrize("options", [{}, {"weights": "random", "dynamics": "lstm"}])
def test_the_name_says_fine_tuned(options: dict[str, Any]) -> None:
    provenance = make(**options).provenance()
    assert provenance.model == f"random-test_vit-{options.get('dynamics', 'mlp')}-fine-tuned"
    assert provenance.encoder_training_task == "L2 on latent, distillation of the initial encoder"
    assert build_model("frozen-encoder", **TINY).provenance().encoder_training_task == ""


def test_a_training_changes_both_digests_and_its_weights_give_the_same_features(
    tmp_path: Path,
) -> None:
    model = make()
    before = model.digest(), model.encoder_digest()
    source = MovingValues(count=8, spec=model.spec)
    result = train_model(
        model, source, source.trials, seed=0, name="all", folder=tmp_path, settings=QUICK,
        fabric=make_fabric(Devices("cpu")),
    )  # fmt: skip
    after = model.digest(), model.encoder_digest()
    assert len({*before, *after}) == 4
    assert make().encoder_digest() == before[1], "which depends on no random number of its own"
    assert result.folder is not None and np.isfinite(result.baseline)
    loaded, batch = make(), clips()
    load_weights(result.folder / WEIGHTS, loaded)
    assert (loaded.digest(), loaded.encoder_digest()) == after
    assert torch.equal(loaded.encode(batch), model.encode(batch))
    assert not torch.equal(loaded.encode(batch), make().encode(batch))


def test_the_dynamics_do_not_change_the_digest_of_the_encoder() -> None:
    model = make()
    before = model.encoder_digest()
    with torch.no_grad():
        model.dynamics.outer.bias += 1
    assert model.encoder_digest() == before
    with torch.no_grad():
        next(model.encoder.parameters()).view(-1)[0] += 1e-3
    assert model.encoder_digest() != before


def test_statistics_of_batch_normalisation_stay_as_they_are() -> None:
    model = make(encoder="test_resnet")
    batch = clips()
    model.prepare(batch)
    kept = {k: v.clone() for k, v in model.encoder.state_dict().items() if "running" in k}
    model.train()
    assert model.training and model.dynamics.training and not model.encoder.training
    model.loss(batch)["loss"].backward()
    now = model.encoder.state_dict()
    assert kept and all(torch.equal(value, now[name]) for name, value in kept.items())


def test_fine_tuning_without_what_keeps_features_apart_is_refused() -> None:
    with pytest.raises(BadInputError, match="distillation must be above 0"):
        make(distillation=0.0)
    with pytest.raises(BadInputError, match="standardised=true"):
        make(standardised=False)
    with pytest.raises(BadInputError, match="trains no encoder"):
        build_model("pVGG-mlp", size="released", fine_tuned=True)


def test_evaluation_trains_the_encoder_of_each_fold_and_reads_its_features(tmp_path: Path) -> None:
    counts = {"training": 4, "readout": 8, "testing": 4}
    dots = make_dots(tmp_path / "dots", counts, ("collide", "drop"))
    settings = EvaluationSettings(accelerator="cpu", logistic=LogisticSettings(grid=(1e-2,)))
    options = {**FEW, "context": 3, "image_size": 32, "steps": 2, "batch": 2}
    table = evaluate(
        "frozen-encoder", dots, tmp_path, protocols="only", options=options, settings=settings
    ).predictions
    assert (table["model"] == "random-test_vit-mlp-fine-tuned").all()
    assert set(table["readout"]) == {"observed", "observed+simulated", "full"}
    assert np.isfinite(table["p_contact"]).all()
    # Features of two encoders, one for each training.
    assert len(list((tmp_path / "features" / "whole").iterdir())) == 2
