"""Training loop, checkpoints and protocols: the loss falls, resuming is exact, NaN stops."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from physion.errors import BadInputError, UnknownNameError
from physion.models import build_model
from physion.training.batches import WindowBatches, copy_last_loss, hold_out
from physion.training.dynamics import one_step_loss, simulate_features, train_dynamics
from physion.training.loop import (
    CHECKPOINT,
    METRICS,
    TrainingConfig,
    TrainingStoppedError,
    train,
)
from physion.training.protocols import Training, training_sets


@pytest.fixture(scope="module")
def cpu() -> Fabric:
    return Fabric(accelerator="cpu", devices=1)


def waves(trials: int = 24, time: int = 25, size: int = 6) -> np.ndarray:
    """Return features that move on circles: predictable, but never equal to the last ones."""
    rng = np.random.default_rng(0)
    phase, speed = rng.uniform(0, 6, (trials, 1, size)), rng.uniform(0.3, 0.5, (trials, 1, size))
    return np.sin(phase + speed * np.arange(time)[None, :, None]).astype(np.float32)


class Net(nn.Module):
    """Small network with dropout, which also tests random operations in a model."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.net = nn.Sequential(
                nn.Linear(42, 32), nn.ReLU(), nn.Dropout(0.2), nn.Linear(32, 6)
            )

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        features = batch["features"]
        out: Tensor = self.net(features[:, :7].flatten(1))
        return (out - features[:, 7]).pow(2).mean()


BATCHES = WindowBatches(waves(), 8, 16, seed=1)


def run(cpu: Fabric, steps: int, folder: Path | None, **config: Any) -> tuple[Any, Net]:
    net = Net()
    settings = TrainingConfig(steps=steps, batch=16, checkpoint_every=10, **config)
    return train(net, BATCHES, settings, cpu, folder=folder, identity={"net": 1}), net


def test_resumed_training_is_the_uninterrupted_one_to_the_bit(cpu: Fabric, tmp_path: Path) -> None:
    whole, net = run(cpu, 40, tmp_path / "whole")
    for steps in (17, 30):
        run(cpu, steps, tmp_path / "parts")
    torch.rand(7)
    parts, resumed = run(cpu, 40, tmp_path / "parts")
    assert parts.losses == whole.losses and len(whole.losses) == 40
    for name, value in net.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name])
    lines = [(tmp_path / f / METRICS).read_text() for f in ("whole", "parts")]
    assert lines[0] == lines[1]
    steps = [json.loads(line)["step"] for line in lines[0].splitlines()]
    assert steps == [0, 10, 20, 30, 39]


def test_a_killed_run_goes_on_from_its_last_checkpoint(cpu: Fabric, tmp_path: Path) -> None:
    class Killed(Exception):
        pass

    def stop(what: str, done: int, total: int) -> None:
        if done == 25:
            raise Killed

    settings = TrainingConfig(steps=40, batch=16, checkpoint_every=10)
    with pytest.raises(Killed):
        train(Net(), BATCHES, settings, cpu, folder=tmp_path, identity={"net": 1}, progress=stop)
    assert json.loads((tmp_path / "checkpoint.json").read_text())["step"] == 20
    seen = []

    def counted(step: int) -> dict[str, Tensor]:
        seen.append(step)
        return BATCHES(step)

    result = train(Net(), counted, settings, cpu, folder=tmp_path, identity={"net": 1})
    assert seen == list(range(20, 40))
    assert result.losses == run(cpu, 40, None)[0].losses


def test_training_depends_on_its_seed(cpu: Fabric) -> None:
    losses = [run(cpu, 12, None, seed=seed)[0].losses for seed in (0, 0, 1)]
    assert losses[0] == losses[1] != losses[2]


def test_the_optimiser_keeps_its_moments(cpu: Fabric, tmp_path: Path) -> None:
    """Adam that is created again at every step, as released, would take steps of equal length."""
    run(cpu, 20, tmp_path)
    from safetensors.torch import load_file

    state = load_file(tmp_path / CHECKPOINT)
    steps = [float(v) for k, v in state.items() if k.startswith("optimizer/") and "/step" in k]
    assert steps == [20.0] * 4


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_stops_with_its_step(
    bad: float, cpu: Fabric, tmp_path: Path
) -> None:
    def poisoned(step: int) -> dict[str, Tensor]:
        batch = BATCHES(step)
        return {"features": batch["features"] * bad} if step == 13 else batch

    with pytest.raises(TrainingStoppedError, match="step 13"):
        train(Net(), poisoned, TrainingConfig(20, 16, checkpoint_every=5), cpu, folder=tmp_path)
    assert json.loads((tmp_path / "checkpoint.json").read_text())["step"] == 10


def test_a_checkpoint_of_another_config_net_or_length_is_refused(
    cpu: Fabric, tmp_path: Path
) -> None:
    run(cpu, 20, tmp_path)
    with pytest.raises(BadInputError, match="another config"):
        run(cpu, 20, tmp_path, learning_rate=0.5)
    with pytest.raises(BadInputError, match="more than"):
        run(cpu, 10, tmp_path)
    other = nn.Linear(2, 2)
    settings = TrainingConfig(20, 16, checkpoint_every=10)
    with pytest.raises(BadInputError, match="another network"):
        train(other, BATCHES, settings, cpu, folder=tmp_path, identity={"net": 1})


@pytest.mark.parametrize("content", [b"", b"\x00" * 64, b"not a checkpoint" * 9])
def test_a_damaged_checkpoint_is_one_clear_error(
    content: bytes, cpu: Fabric, tmp_path: Path
) -> None:
    (tmp_path / CHECKPOINT).write_bytes(content)
    with pytest.raises(BadInputError, match="delete it"):
        run(cpu, 5, tmp_path)


def test_a_pickle_in_place_of_a_checkpoint_is_not_run(cpu: Fabric, tmp_path: Path) -> None:
    target = tmp_path / "pwned"

    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (target,))

    torch.save({"model": Evil()}, tmp_path / CHECKPOINT)
    with pytest.raises(BadInputError):
        run(cpu, 5, tmp_path)
    assert not target.exists()


@pytest.mark.parametrize("dynamics", ["mlp", "lstm"])
@pytest.mark.parametrize(("scale", "residual"), [(1.0, True), (1e-4, False), (1e3, False)])
def test_dynamics_learn_and_beat_standing_still(
    dynamics: str, scale: float, residual: bool, cpu: Fabric
) -> None:
    """For any unit of the features, the loss falls and the rollout is better than a copy."""
    model = build_model(
        "frozen-encoder", encoder="test_vit", image_size=32, weights="random", hidden=64,
        dynamics=dynamics, residual=residual,
    )  # fmt: skip
    mixing = np.random.default_rng(1).normal(size=(2, 64)).astype(np.float32)
    features = ((waves(trials=100, size=2) @ mixing + 3) * scale).astype(np.float32)
    report = train_dynamics(model, features, TrainingConfig(steps=250), cpu)
    losses = report.training.losses
    assert np.mean(losses[-20:]) < 0.3 * losses[0]
    assert report.validation < 0.6 * report.copy_last
    _, held = hold_out(len(features), 0.1, 0)
    rollout = simulate_features(model, features[held][:, :7], 6, cpu)
    copied = np.repeat(features[held][:, 6:7], 6, axis=1)
    truth = features[held][:, 7:13]
    assert np.square(rollout - truth).mean() < 0.7 * np.square(copied - truth).mean()


def test_residual_dynamics_start_at_standing_still(cpu: Fabric) -> None:
    model = build_model("frozen-encoder", encoder="test_vit", image_size=32, weights="random")
    features = waves(trials=4, size=64)
    assert one_step_loss(model, features, cpu) == pytest.approx(copy_last_loss(features, 7))


def test_losses_of_copying_and_of_a_perfect_model_are_what_they_say(cpu: Fabric) -> None:
    features = np.zeros((2, 9, 1), np.float32)
    features[:, 8] = 3.0
    assert copy_last_loss(features, 7) == pytest.approx(4.5)
    assert np.isnan(copy_last_loss(features[:, :7], 7))

    class Perfect:
        spec = build_model("noisy-simulation").spec

        def simulate(self, context: Tensor, steps: int) -> Tensor:
            return torch.zeros(len(context), steps, 1)

    assert one_step_loss(Perfect(), features[:, :8], cpu) == 0.0  # type: ignore[arg-type]
    assert one_step_loss(Perfect(), features, cpu) == pytest.approx(4.5)  # type: ignore[arg-type]


def test_constant_features_can_be_trained_on(cpu: Fabric) -> None:
    model = build_model(
        "frozen-encoder", encoder="test_vit", image_size=32, weights="random", hidden=8
    )
    features = np.full((4, 25, 64), 2.0, np.float32)
    report = train_dynamics(model, features, TrainingConfig(steps=5), cpu)
    assert np.isfinite(report.training.losses).all() and report.copy_last == 0.0


def test_batches_are_windows_of_the_features() -> None:
    features = waves()
    batch = WindowBatches(features, 8, 50, seed=3)(0)["features"].numpy()
    assert batch.shape == (50, 8, 6)
    windows = np.lib.stride_tricks.sliding_window_view(features, 8, axis=1)
    known = {w.T.tobytes() for w in windows.reshape(-1, 6, 8)}
    assert all(np.ascontiguousarray(w).tobytes() in known for w in batch)
    assert len({w.tobytes() for w in batch}) > 40
    with pytest.raises(BadInputError, match="windows of 8"):
        WindowBatches(features[:, :7], 8, 50, seed=3)
    with pytest.raises(BadInputError, match="0 trials"):
        WindowBatches(features[:0], 8, 50, seed=3)


@pytest.mark.parametrize("count", [1, 2, 10, 101])
def test_held_out_trials_are_not_trained_on(count: int) -> None:
    rows, held = hold_out(count, 0.1, 0)
    assert len(held) >= 1
    if count > 1:
        assert sorted([*rows, *held]) == list(range(count))


def test_training_sets_of_the_three_protocols() -> None:
    names = ["roll", "drop", "link", "drop"]
    every, but, only = (training_sets(protocol, names) for protocol in Training)
    assert [(s.name, s.tested) for s in every] == [("all", ("drop", "link", "roll"))]
    assert {s.name: s.trained for s in but}["no_drop"] == ("link", "roll")
    assert all(set(s.trained).isdisjoint(s.tested) for s in but)
    assert next((s.name, s.trained, s.tested) for s in only) == ("drop", ("drop",), ("drop",))
    with pytest.raises(BadInputError, match="two scenarios"):
        training_sets(Training.ALL_BUT, ["drop"])
    with pytest.raises(UnknownNameError, match="all-but"):
        Training.named("allbut")


@pytest.mark.parametrize(
    "wrong", [{"steps": 0}, {"batch": 0}, {"learning_rate": 0.0}, {"learning_rate": float("nan")}]
)
def test_impossible_settings_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(BadInputError):
        TrainingConfig(**wrong)
