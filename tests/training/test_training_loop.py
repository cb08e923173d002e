"""Training loop: the loss falls, resuming is exact, a loss that is not finite stops it."""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn
from torch.optim.lr_scheduler import ReduceLROnPlateau

from physion.clips.batch import Batch
from physion.core.errors import BadInputError, PhysionError
from physion.core.files import folder_lock
from physion.models.build import OutOfMemoryError
from physion.models.checkpoint import WEIGHTS, read_checkpoint
from physion.models.interface import TrainingSettings
from physion.training.devices import Devices, make_fabric
from physion.training.loop import (
    CARD,
    CHECKPOINT,
    EVENTS,
    METRICS,
    MetricsLog,
    Plateau,
    TrainingStoppedError,
    learning_rate,
)
from physion.training.train import TrainedModel, train_model
from physion.training.windows import ClipWindows, FeatureWindows, Request, step_request
from support.trained_models import QUICK, SPEC, MovingValues, NextBrightness, equal_weights

CPU = make_fabric(Devices("cpu"))
ALL_AT_ONCE = replace(
    QUICK, optimizer="adamw", schedule="cosine", warmup=5, clip=0.5, accumulate=2, weight_decay=0.1
)
PLATEAU = replace(
    QUICK, schedule="plateau", validate_every=3, plateau_patience=0, plateau_factor=0.5,
    learning_rate=0.1,
)  # fmt: skip


class Killed(Exception):
    """End of a training in the middle, after which nothing is written."""


def kill_at(step: int) -> Callable[[str, int, int], None]:
    def progress(what: str, done: int, total: int) -> None:
        if done == step:
            raise Killed

    return progress


def run(
    model: NextBrightness,
    folder: Path | None = None,
    settings: TrainingSettings = QUICK,
    source: MovingValues | None = None,
    **options: Any,
) -> TrainedModel:
    source = source if source is not None else MovingValues(spec=model.spec)
    features = source.features if model.learns_from == "features" else None
    options = {"seed": 0, "name": "all", "fabric": CPU, **options}
    return train_model(
        model, source, source.trials, settings=settings, features=features, folder=folder, **options
    )


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the content of all files but TensorBoard's, which hold the time of day."""
    paths = [path for path in folder.rglob("*") if path.is_file() and path.parent.name != "events"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.mark.slow
@pytest.mark.parametrize("learns_from", ["clips", "features", "states"])
def test_a_model_learns_from_every_input(learns_from: Any) -> None:
    first = run(NextBrightness(learns_from), settings=replace(QUICK, steps=1, learning_rate=1e-9))
    model = NextBrightness(learns_from)
    result = run(model, settings=replace(QUICK, steps=200))
    assert result.loss < 0.2 * first.loss
    assert result.validation < 0.5 * result.baseline
    assert not model.training and result.steps == 200 and not result.loaded


@pytest.mark.slow
@pytest.mark.parametrize("learns_from", ["clips", "features"])
@pytest.mark.parametrize(
    "settings",
    [
        pytest.param(QUICK, id="adam", marks=pytest.mark.nightly),
        pytest.param(ALL_AT_ONCE, id="all"),
        pytest.param(PLATEAU, id="plateau", marks=pytest.mark.nightly),
    ],
)
def test_resumed_training_is_the_uninterrupted_one_to_the_bit(
    learns_from: Any, settings: TrainingSettings, tmp_path: Path
) -> None:
    settings = replace(settings, log_every=4)  # checkpoints lie inside of intervals
    whole = NextBrightness(learns_from, dropout=0.2)
    run(whole, tmp_path / "whole", settings)
    for step in (7, 25, 39):
        with pytest.raises(Killed):
            run(
                NextBrightness(learns_from, 0.2),
                tmp_path / "parts",
                settings,
                progress=kill_at(step),
            )
        torch.rand(3)  # the state of torch's generator does not matter
    model = NextBrightness(learns_from, 0.2)
    result = run(model, tmp_path / "parts", settings)
    assert equal_weights(model, whole) and result.notes == ()
    assert files_of(tmp_path / "parts") == files_of(tmp_path / "whole")
    assert {Path(name).name for name in files_of(tmp_path)} == {
        WEIGHTS, f"{WEIGHTS}.sha256", CARD, METRICS,
    }  # fmt: skip


class Calibrated(NextBrightness):
    """Network with a buffer that is set after training; ``killed`` ends the process before it."""

    calibration_trials = 5

    def __init__(self, *, killed: bool = False) -> None:
        super().__init__()
        self.killed = killed
        self.level = nn.Buffer(torch.zeros(()))

    def calibrate(self, whole: Batch) -> None:
        if self.killed:
            raise KeyboardInterrupt
        assert len(whole) == self.calibration_trials
        self.level.copy_(self.net(self._brightness(whole)[:, :3]).mean() + torch.rand(()))


def test_a_training_that_ended_before_its_calibration_is_calibrated(tmp_path: Path) -> None:
    whole, resumed = Calibrated(), Calibrated()
    run(whole, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        run(Calibrated(killed=True), tmp_path / "parts")
    assert not any(Path(name).name == WEIGHTS for name in files_of(tmp_path / "parts"))
    run(resumed, tmp_path / "parts")
    assert equal_weights(resumed, whole) and float(resumed.level) != 0
    assert files_of(tmp_path / "parts") == files_of(tmp_path / "whole")
    again = Calibrated(killed=True)
    assert run(again, tmp_path / "parts").loaded and equal_weights(again, whole)


def test_a_resumed_training_reads_only_the_batches_that_are_left(tmp_path: Path) -> None:
    sources = [MovingValues() for _ in range(2)]
    settings = replace(QUICK, held_out=0.0)
    run(NextBrightness(), tmp_path / "whole", settings, sources[0])
    with pytest.raises(Killed):
        run(NextBrightness(), tmp_path / "parts", settings, progress=kill_at(25))
    run(NextBrightness(), tmp_path / "parts", settings, sources[1])
    # The first reading of the first run is the sample from which the model sets its statistics.
    assert len(sources[0].read) == 41 and len(sources[1].read) == 20
    assert sorted(sources[1].read) == sorted(sources[0].read[21:])


def test_batches_depend_only_on_seed_and_step() -> None:
    read = []
    for seed in (0, 0, 1):
        source = MovingValues()
        settings = replace(QUICK, steps=5, held_out=0.0)
        run(NextBrightness(), source=source, seed=seed, settings=settings)
        read.append(sorted(source.read))
    assert read[0] == read[1] != read[2]
    assert len(set(read[0])) == 6  # five steps, and the sample for statistics


def test_windows_start_anywhere_and_stay_inside_of_their_trials() -> None:
    source = MovingValues(frames=40)
    source.frames[source.trials[3]] = 10  # shorter than a window
    run(NextBrightness(), source=source, settings=replace(QUICK, steps=30))
    starts = {(t, s) for trials, at in source.read for t, s in zip(trials, at, strict=True)}
    assert {s for t, s in starts if t == source.trials[3]} == {0}
    assert {s for _, s in starts} == set(range(40 - 18))


def test_held_out_trials_are_not_trained_on() -> None:
    source = MovingValues(count=20)
    run(NextBrightness(), source=source, settings=replace(QUICK, held_out=0.25))
    sizes = {8, 15, 5}  # batches, the sample for statistics, and the held-out trials
    assert {len(trials) for trials, _ in source.read} == sizes
    (held,) = {trials for trials, _ in source.read if len(trials) == 5}
    others = {t for trials, _ in source.read if len(trials) != 5 for t in trials}
    assert len(held) == 5 and others == set(source.trials) - set(held)


def test_models_see_a_sample_of_clips_or_features_before_training() -> None:
    for learns_from, count in (("clips", 64), ("features", 90)):
        model = NextBrightness(learns_from)  # type: ignore[arg-type]
        run(model, source=MovingValues(count=100), settings=replace(QUICK, steps=1))
        (sample,) = model.prepared
        assert len(sample) == count == len(set(sample.trials))
        assert sample.frames.shape[1] == 4


def test_frames_of_feature_windows_match_the_features() -> None:
    class Checked(NextBrightness):
        def loss(self, batch: Batch) -> dict[str, Tensor]:
            rows = zip(batch.trials, batch.frames.numpy(), batch.features.numpy(), strict=True)
            for trial, frames, features in rows:
                expected = source.values(trial, frames) / 100
                assert features[:, 0] == pytest.approx(expected, rel=1e-6)
            assert (batch.valid.numpy() == (batch.frames.numpy() % 6 == 0)).all()
            return super().loss(batch)

    source = MovingValues(frames=40)  # the last steps of a clip repeat frame 39
    run(Checked("features"), source=source, settings=replace(QUICK, steps=3))


def test_windows_of_features_come_from_the_entire_movie() -> None:
    """Of movies of 60 and 602 frames: 2, 8, ..., 62 (59 is the last one) and 2, ..., 602 (601)."""
    spec = replace(SPEC, context=0, future=None, context_at="end")
    source = MovingValues(count=2, spec=spec)
    source.frames = dict(zip(source.trials, (60, 602), strict=True))
    features = source.features(source.trials)
    assert [len(own) for own in features] == [11, 101]
    windows = FeatureWindows(spec, source.trials, features, [60, 602], np.arange(2), 4)
    starts = windows.starts([0, 1] * 5000, np.random.default_rng(0))
    assert set(starts[::2]) == set(range(8)) and set(starts[1::2]) == set(range(98))
    batch = windows.read(Request((source.trials[1], source.trials[0]), (97, 7)))
    assert batch.frames.tolist() == [[584, 590, 596, 601], [44, 50, 56, 59]]
    assert batch.valid.tolist() == [[True, True, True, False]] * 2
    for trial, frames, own in zip(batch.trials, batch.frames, batch.features, strict=True):
        assert own[:, 0] == pytest.approx(source.values(trial, frames) / 100, rel=1e-6)
    long = FeatureWindows(spec, source.trials, features, [60, 602], np.arange(2), 13)
    assert long.starts([0], np.random.default_rng(0)).tolist() == [0]
    short = long.read(Request(source.trials[:1], (0,)))
    assert short.frames.tolist() == [[*range(2, 57, 6), 59, 59, 59]]
    assert short.valid.tolist() == [[True] * 10 + [False] * 3]
    assert (short.features[0, -1] == short.features[0, -3]).all()
    with pytest.raises(BadInputError, match=r"clip of 11 frames of trial 'drop_0000'"):
        FeatureWindows(spec, source.trials, features[::-1], [60, 602], np.arange(2), 4)


def test_nothing_held_out_uses_every_trial_and_validates_nothing() -> None:
    source = MovingValues(count=10)
    for held_out, used in ((0.1, 9), (0.0, 10)):
        source.read.clear()
        trained = run(
            NextBrightness(), source=source, settings=replace(QUICK, held_out=held_out, steps=60)
        )
        steps = [trials for trials, _ in source.read if len(trials) == QUICK.batch]
        assert len({trial for trials in steps for trial in trials}) == used
        assert np.isnan(trained.validation) == (held_out == 0)


def test_the_rate_rises_linearly_and_is_constant_afterwards() -> None:
    settings = TrainingSettings(steps=20, learning_rate=0.5, warmup=4)
    rates = [learning_rate(settings, step) for step in range(7)]
    assert rates == pytest.approx([0.125, 0.25, 0.375, 0.5, 0.5, 0.5, 0.5])
    assert learning_rate(settings, 10, factor=0.5) == pytest.approx(0.25)


def test_the_cosine_goes_from_the_base_rate_to_zero() -> None:
    settings = TrainingSettings(steps=14, learning_rate=2.0, warmup=4, schedule="cosine")
    rates = [learning_rate(settings, step) for step in range(4, 15)]
    assert rates[0] == 2.0 and rates[5] == pytest.approx(1.0) and rates[10] == pytest.approx(0.0)
    assert (np.diff(rates) < 0).all()


@pytest.mark.parametrize("patience", [0, 1, 3])
def test_the_plateau_follows_torch(patience: int) -> None:
    settings = TrainingSettings(
        schedule="plateau", plateau_patience=patience, plateau_factor=0.8, learning_rate=1.0
    )
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([weight], lr=1.0)
    reference = ReduceLROnPlateau(optimizer, factor=0.8, patience=patience)
    losses = np.random.default_rng(patience).integers(1, 30, 60) / 10
    losses[10:14] = losses[9] * (1 - 0.5e-4)  # improvements that are too small to count
    plateau, rates = Plateau(), []
    for loss in losses:
        reference.step(float(loss))
        plateau.update(float(loss), settings)
        # As it is stored in a checkpoint.
        plateau = Plateau(**json.loads(json.dumps(asdict(plateau))))
        assert learning_rate(settings, 5, plateau.factor) == pytest.approx(
            optimizer.param_groups[0]["lr"]
        )
        rates.append(plateau.factor)
    assert len(set(rates)) > 3


class Sum(NextBrightness):
    """Network whose loss is the sum of its weights: Adam then moves each by the learning rate."""

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        return {"loss": sum((p.sum() for p in self.net.parameters()), torch.zeros(()))}


@pytest.mark.parametrize(
    ("changes", "rates"),
    [
        ({"steps": 1, "warmup": 4}, [0.1]),
        ({"steps": 6, "warmup": 4}, [0.1, 0.2, 0.3, 0.4, 0.4, 0.4]),
        ({"steps": 5, "warmup": 1, "schedule": "cosine"}, [0.4, 0.4, 0.34142136, 0.2, 0.05857864]),
        ({"steps": 2, "accumulate": 2}, [0.4, 0.4]),
    ],
)
def test_every_step_has_the_rate_of_its_number(changes: Any, rates: list[float]) -> None:
    model = Sum()
    before = [value.detach().clone() for value in model.net.parameters()]
    run(model, settings=replace(QUICK, learning_rate=0.4, held_out=0.0, **changes))
    for first, last in zip(before, model.net.parameters(), strict=True):
        assert (first - last.detach()).numpy() == pytest.approx(sum(rates), rel=1e-5)


def test_a_validation_is_the_mean_over_clips_not_over_batches() -> None:
    """Five trials in batches of two: the last batch has one clip, which counts as any other."""
    model, source = NextBrightness(), MovingValues(count=20)
    result = run(model, None, replace(QUICK, steps=4, batch=2, held_out=0.25), source)
    asked = ((lambda b: model.loss(b)["loss"]), model.baseline)
    reads = list(source.read)
    # The last reads are those of the model's validation, then of the baseline's.
    for read, ask, found in zip(
        (reads[5:8], reads[8:]), asked, (result.validation, result.baseline),
        strict=True,
    ):  # fmt: skip
        assert sorted(len(trials) for trials, _ in read) == [1, 2, 2]
        with torch.no_grad():
            batches = [
                [
                    float(ask(source.window([t], [s], 4).to("cpu")))
                    for t, s in zip(*one, strict=True)
                ]
                for one in read
            ]
        assert found == pytest.approx(np.mean([x for batch in batches for x in batch]), rel=1e-5)
        of_batches = np.mean([np.mean(batch) for batch in batches])
        assert found != pytest.approx(of_batches, rel=1e-3), "the difference can be seen"


def test_validation_does_not_change_what_is_learnt() -> None:
    models = [NextBrightness(dropout=0.2) for _ in range(2)]
    for model, every in zip(models, (1, 40), strict=True):
        run(model, settings=replace(QUICK, validate_every=every))
    assert equal_weights(*models)


def test_steps_match_plain_torch_with_all_settings() -> None:
    """Betas, weight decay, clipping, warm-up, cosine, and a batch of two accumulated parts."""
    source = MovingValues()
    windows = ClipWindows(source, source.trials, 4)

    def plain(clip: float) -> tuple[NextBrightness, list[float]]:
        """Return the network after six steps, and the norms of its gradients."""
        model, norms = NextBrightness(), []
        model.prepare(windows.sample(0).to("cpu"))
        optimizer = torch.optim.AdamW(model.parameters(), betas=(0.7, 0.8), weight_decay=0.1)
        for step, rate in enumerate((0.5, 1.0, 1.0, 0.85355339, 0.5, 0.14644661)):
            optimizer.param_groups[0]["lr"] = 0.01 * rate
            optimizer.zero_grad()
            batch = windows.read(step_request(windows, 16, 0, step)).to("cpu")
            model.loss(batch)["loss"].backward()  # type: ignore[no-untyped-call]
            norms.append(float(nn.utils.clip_grad_norm_(model.parameters(), clip)))
            optimizer.step()
        return model, norms

    _, norms = plain(1e9)
    clip = 1.2 * min(norms)  # some steps are clipped, others are not
    assert max(norms) > 1.5 * min(norms)
    settings = replace(ALL_AT_ONCE, steps=6, warmup=2, held_out=0.0, betas=(0.7, 0.8), clip=clip)
    model = NextBrightness()
    run(model, settings=settings, source=source)
    for one, other in zip(model.parameters(), plain(clip)[0].parameters(), strict=True):
        assert one.detach().numpy() == pytest.approx(other.detach().numpy(), rel=1e-4, abs=1e-6)


def test_the_optimiser_keeps_its_moments(tmp_path: Path) -> None:
    """Adam that is created again at every step, as released, would take steps of equal length."""
    with pytest.raises(Killed):
        run(NextBrightness(), tmp_path, progress=kill_at(25))
    tensors, metadata = read_checkpoint(next(tmp_path.rglob(CHECKPOINT)))
    steps = [v for k, v in tensors.items() if k.startswith("optimizer/") and k.endswith("/step")]
    assert [float(value) for value in steps] == [20.0] * 4 and metadata["step"] == 20


class Poisoned(NextBrightness):
    """Network whose loss, or its gradient, is spoilt at one step."""

    def __init__(self, step: int, value: float | None, **options: Any) -> None:
        super().__init__(**options)
        self.step, self.value, self.calls = step, value, 0

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        losses = super().loss(batch)
        self.calls += self.training
        if self.training and self.calls == self.step:
            if self.value is not None:
                losses["loss"] = losses["loss"] * self.value
            else:  # the root of zero, whose slope is infinite
                losses["loss"] = losses["loss"] + (losses["loss"] * 0).sqrt()
        return losses


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None])
def test_a_loss_or_weight_that_is_not_finite_stops_and_the_last_checkpoint_stays(
    value: float | None, tmp_path: Path
) -> None:
    settings = replace(QUICK, log_every=7, checkpoint_every=10)
    with pytest.raises(Killed):
        run(Poisoned(13, value), tmp_path, settings, progress=kill_at(11))
    before = files_of(tmp_path)
    with pytest.raises(TrainingStoppedError) as caught:
        run(Poisoned(3, value), tmp_path, settings)
    # The loss of step 13, or that of step 14 after a step along an infinite gradient.
    step, shown = (13, str(value)) if value is not None else (14, "nan")
    told = f"steps 11 to 14: the loss of step {step} is {shown} (trials "
    assert told in str(caught.value) and str(caught.value).count("drop_") >= 1
    assert files_of(tmp_path) == before


def test_a_step_that_spoils_the_weights_just_before_a_checkpoint_is_noticed(
    tmp_path: Path,
) -> None:
    with pytest.raises(TrainingStoppedError, match=r"step 20: net\.0\.weight is not finite"):
        run(Poisoned(20, None), tmp_path, replace(QUICK, held_out=0.0))
    assert read_checkpoint(next(tmp_path.rglob(CHECKPOINT)))[1]["step"] == 10
    assert not list(tmp_path.rglob(WEIGHTS))


def test_losses_are_read_from_the_device_only_where_they_are_logged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Reading a value waits for the device; a graphics processor would idle at every step."""
    counts = dict.fromkeys(("__float__", "__bool__", "tolist", "numpy"), 0)
    for name in counts:
        original = getattr(Tensor, name)

        def counted(self: Tensor, *args: Any, n: str = name, f: Any = original, **kw: Any) -> Any:
            counts[n] += 1
            return f(self, *args, **kw)

        monkeypatch.setattr(Tensor, name, counted)
    read = []
    for every in (40, 10, 1):
        counts.update(dict.fromkeys(counts, 0))
        run(NextBrightness(), settings=replace(QUICK, held_out=0.0, log_every=every))
        read.append(sum(counts.values()))
    assert read[1] - read[0] == 3 and read[2] - read[0] == 39


def test_a_finished_training_is_loaded_and_nothing_is_read_or_written(tmp_path: Path) -> None:
    first, second = NextBrightness(), NextBrightness()
    trained = run(first, tmp_path)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    source = MovingValues()
    loaded = run(second, tmp_path, source=source)
    assert loaded == replace(trained, loaded=True) and source.read == []
    assert equal_weights(first, second) and not second.training
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == times


def test_each_training_has_a_folder_of_its_own(tmp_path: Path) -> None:
    run(NextBrightness(), tmp_path)
    run(NextBrightness(), tmp_path, seed=1)
    run(NextBrightness(), tmp_path, replace(QUICK, learning_rate=1e-3))
    run(NextBrightness(), tmp_path, source=MovingValues(frames=90))
    run(NextBrightness(), tmp_path, replace(QUICK, log_every=5))  # changes no weight
    assert len(list(tmp_path.iterdir())) == 4
    assert all(folder.name.startswith("NextBrightness-all-") for folder in tmp_path.iterdir())


def test_two_processes_cannot_train_in_one_folder(tmp_path: Path) -> None:
    folder = run(NextBrightness(), tmp_path).folder
    assert folder is not None
    (folder / WEIGHTS).unlink()
    with folder_lock(folder), pytest.raises(PhysionError, match="another process"):
        run(NextBrightness(), tmp_path)


@pytest.mark.parametrize(
    "error", [torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), MemoryError()]
)
def test_memory_that_is_used_up_names_the_setting_to_lower(error: Exception) -> None:
    class Large(NextBrightness):
        def loss(self, batch: Batch) -> dict[str, Tensor]:
            raise error

    with pytest.raises(OutOfMemoryError, match="batch 4 and accumulate 2"):
        run(Large(), settings=replace(QUICK, held_out=0.0))
    with pytest.raises(OutOfMemoryError, match=r"at batch 1; use .*bf16-mixed"):
        run(Large(), settings=replace(QUICK, held_out=0.0, batch=1))


@pytest.mark.parametrize(
    ("losses", "message"),
    [
        (lambda x: x.mean(), "must give a mapping"),
        (lambda x: {"error": x.mean()}, "must give a mapping"),
        (lambda x: {"loss": x}, r"gave loss as \(8, 1\), expected a scalar"),
        (lambda x: {"loss": x.mean(), "part": 1.0}, "gave part as float"),
        (lambda x: {"loss": x.mean().detach()}, "depends on no weight"),
        (lambda x: {"loss": x.missing}, r"loss raised AttributeError: .* \(test_training_loop"),
    ],
)
def test_a_loss_that_cannot_be_used_is_one_clear_error(losses: Any, message: str) -> None:
    class Wrong(NextBrightness):
        def loss(self, batch: Batch) -> Any:
            return losses(self.net(self._pair(batch)[0]))

    with pytest.raises(BadInputError, match=message):
        run(Wrong())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"schedule": "plateau", "held_out": 0.0}, "held_out above 0"),
        ({"precision": "8-true"}, "precision must be one of"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(
    settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(BadInputError, match=message):
        run(NextBrightness(), settings=replace(QUICK, **settings), fabric=None, accelerator="cpu")


def test_no_device_without_float64_is_taken_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def record(accelerator: str, **_: object) -> Fabric:
        asked.append(accelerator)
        return CPU

    monkeypatch.setattr("physion.training.devices.Fabric", record)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for there in (True, False):
        monkeypatch.setattr("torch.backends.mps.is_available", lambda there=there: there)
        make_fabric(Devices("auto"))
        make_fabric(Devices("mps"))
    assert asked == ["cpu", "mps", "auto", "mps"]


def test_what_cannot_be_trained_is_refused() -> None:
    source = MovingValues()
    options: Any = {"seed": 0, "name": "all", "folder": None, "fabric": CPU}
    with pytest.raises(BadInputError, match="no trial to train"):
        train_model(NextBrightness(), source, [], **options)
    with pytest.raises(BadInputError, match="is trained on features"):
        train_model(NextBrightness("features"), source, source.trials, **options)
    fixed = NextBrightness()
    fixed.requires_grad_(False)
    with pytest.raises(BadInputError, match="no weight that can be trained"):
        run(fixed)
    with pytest.raises(BadInputError, match="cannot be used"):
        make_fabric(Devices("abacus"))
    with pytest.raises(BadInputError, match="at least 1"):
        make_fabric(Devices("cpu", devices=0))


def test_half_precision_trains(tmp_path: Path) -> None:
    settings = replace(QUICK, precision="bf16-mixed")
    model = NextBrightness()
    result = run(model, settings=settings, fabric=None, accelerator="cpu")
    assert all(value.dtype == torch.float32 for value in model.state_dict().values())
    exact = run(NextBrightness())
    assert result.loss != exact.loss and result.loss < 2 * exact.loss + 0.01


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / METRICS).read_text().splitlines()]


def test_metrics_hold_the_means_of_intervals_and_the_validations(tmp_path: Path) -> None:
    lines = []
    for every in (1, 10):
        settings = replace(QUICK, steps=25, warmup=40, log_every=every)
        folder = run(NextBrightness(), tmp_path / str(every), settings).folder
        assert folder is not None
        lines.append(read_metrics(folder))
    single, means = ([line for line in found if "train/loss" in line] for found in lines)
    assert [line["step"] for line in means] == [10, 20, 25] and len(single) == 25
    for line, steps in zip(means, (single[:10], single[10:20], single[20:]), strict=True):
        for name in ("train/loss", "train/bias"):
            assert line[name] == pytest.approx(np.mean([one[name] for one in steps]))
        # The rate of the last step of the interval, which is counted from 1.
        assert line["learning_rate"] == pytest.approx(0.01 * line["step"] / 40)
    assert [line["step"] for line in lines[1] if "validation/loss" in line] == [20, 25]
    assert set(means[0]) == {"step", "train/loss", "train/bias", "learning_rate"}


def write(folder: Path, start: int, steps: list[int]) -> None:
    with closing(MetricsLog(folder, start)) as log:
        for step in steps:
            log.write(step, {"train/loss": step / 10, "learning_rate": 1e-3})


def events(folder: Path) -> list[tuple[int, str, float]]:
    """Return step, name and value of all scalars, read as TensorBoard reads them."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    from tensorboardX.record_writer import masked_crc32c

    found = []
    for path in sorted((folder / EVENTS).iterdir()):
        content, position = path.read_bytes(), 0
        while position < len(content):
            (length,) = struct.unpack_from("<Q", content, position)
            header, data = content[position : position + 8], content[position + 12 :][:length]
            assert struct.unpack_from("<I", content, position + 8)[0] == masked_crc32c(header)
            assert struct.unpack_from("<I", content, position + 12 + length)[0] == masked_crc32c(
                data
            )
            event = event_pb2.Event.FromString(data)
            found += [(event.step, v.tag, v.simple_value) for v in event.summary.value]
            position += 16 + length
    return found


def test_lines_are_appended_and_not_written_again(tmp_path: Path) -> None:
    write(tmp_path, 0, [10, 20])
    inode = (tmp_path / METRICS).stat().st_ino
    write(tmp_path, 20, [30])
    assert (tmp_path / METRICS).stat().st_ino == inode
    assert [line["step"] for line in read_metrics(tmp_path)] == [10, 20, 30]
    assert read_metrics(tmp_path)[0] == {"step": 10, "train/loss": 1.0, "learning_rate": 1e-3}


@pytest.mark.parametrize("rest", ["", '{"step": 40, "train/lo', "\0\0\0", '{"step": "x"}\n'])
def test_lines_after_the_checkpoint_are_cut(tmp_path: Path, rest: str) -> None:
    write(tmp_path, 0, [10, 20, 25, 30])
    with (tmp_path / METRICS).open("a") as file:
        file.write(rest)
    write(tmp_path, 20, [25, 30, 40])
    assert [line["step"] for line in read_metrics(tmp_path)] == [10, 20, 25, 30, 40]


def test_a_new_training_starts_with_an_empty_file(tmp_path: Path) -> None:
    write(tmp_path, 0, [10])
    write(tmp_path, 0, [5])
    assert [line["step"] for line in read_metrics(tmp_path)] == [5]


def test_values_that_are_not_finite_are_null(tmp_path: Path) -> None:
    with closing(MetricsLog(tmp_path, 0)) as log:
        log.write(1, {"train/part": float("nan"), "train/loss": 0.5})
    assert read_metrics(tmp_path) == [{"step": 1, "train/part": None, "train/loss": 0.5}]


def test_tensorboard_reads_the_same_numbers_once_each(tmp_path: Path) -> None:
    write(tmp_path, 0, [10, 20, 25])
    write(tmp_path, 20, [30])
    found = events(tmp_path)
    expected = [
        (line["step"], name, pytest.approx(value))
        for line in read_metrics(tmp_path)
        for name, value in line.items()
        if name != "step"
    ]
    assert found == expected and len(found) == 6


def test_without_the_extra_there_are_no_event_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    write(tmp_path, 0, [10])
    assert [path.name for path in tmp_path.iterdir()] == [METRICS]


def test_the_model_card_tells_what_the_model_is(tmp_path: Path) -> None:
    result = run(NextBrightness(), tmp_path)
    assert result.folder is not None
    card = (result.folder / CARD).read_text()
    for text in (
        "# NextBrightness, trained on all", "20 trials", "drop 10, roll 10", "| steps | 40 |",
        "| seed | 0 |", f"{result.validation:.6g}", f"{result.baseline:.6g}", "Licence",
        f"torch | {torch.__version__}", "load_weights",
    ):  # fmt: skip
        assert text in card, text
