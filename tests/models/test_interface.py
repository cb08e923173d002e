"""Properties of every model, its options, and inputs that the interface rejects."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from physion.clips.batch import clip_frames
from physion.core.errors import BadInputError, PhysionError, UnknownNameError
from physion.core.settings import parse_pairs
from physion.models import Batch, Spec
from physion.models.build import (
    build_model,
    build_untrained,
    make_settings,
    models,
    option_names,
    settings_type,
)
from physion.models.interface import Model, ModelSettings, can
from physion.models.noisy_simulation import NoisySimulationSettings
from physion.readout.predictor import ways
from support.tiny_models import FROZEN, TINY, UNTRAINED, tiny


def clips(frames: Any, features: Any = None) -> Batch:
    """Return a batch of pictures (B, T, H, W, 3), as tensors."""
    count, steps = (frames if features is None else features).shape[:2]
    return Batch(
        trials=tuple(f"t{i}" for i in range(count)),
        frames=np.tile(np.arange(steps), (count, 1)),
        valid=np.ones((count, steps), np.bool_),
        rgb=frames,
        features=features,
    ).to("cpu")


def test_spec_shows_all_observed_frames_that_fit_and_all_up_to_the_end_of_the_movie() -> None:
    assert Spec().context_frames() == (2, 8, 14, 20, 26, 32, 38, 44)
    assert Spec(stride=9).context_frames() == (8, 17, 26, 35, 44)
    assert Spec(stride=1).context == 45 and Spec(stride=100).context_frames() == (44,)
    for length, last in ((45, 44), (46, 50), (51, 50), (52, 56), (602, 602)):
        assert Spec().all_frames(length) == tuple(range(2, last + 1, 6))
        assert Spec().steps_after(length) == (last - 44) // 6
    assert replace(Spec(stride=9), stride=6).context == 5, "a number that was chosen is kept"
    few = Spec(stride=5, context=4, future=2)
    assert few.all_frames(100) == (29, 34, 39, 44, 49, 54), "up to the last observed one"


def test_spec_shows_the_frames_of_the_released_models() -> None:
    spec = Spec(context=7, future=18, context_at="start")
    assert spec.context_frames() == (0, 6, 12, 18, 24, 30, 36)
    for length in (60, 602):
        assert spec.all_frames(length) == tuple(range(0, 145, 6))
    spec = Spec(stride=9, context=5, future=11, context_at="start")
    assert spec.all_frames(602)[-1] == 135


@pytest.mark.parametrize(
    "wrong",
    [
        {"context": 8, "stride": 7}, {"future": -1}, {"stride": 0}, {"image_size": 0},
        {"context": -1}, {"inputs": ("sound",)}, {"context_at": "middle"}, {"objects": 0},
    ],
)  # fmt: skip
def test_spec_refuses_context_past_the_observed_part_and_empty_clips(wrong: dict[str, Any]) -> None:
    with pytest.raises(BadInputError, match="spec"):
        Spec(**wrong)


def test_batch_refuses_arrays_of_another_shape_or_type() -> None:
    frames = np.zeros((2, 3), np.int64)
    valid = np.ones((2, 3), np.bool_)
    rgb = np.zeros((2, 3, 8, 8, 3), np.uint8)
    batch = Batch(("a", "b"), frames, valid, rgb=rgb)
    assert len(batch) == 2 and set(batch.arrays()) == {"frames", "valid", "rgb"}
    with pytest.raises(BadInputError, match="rgb must be uint8"):
        Batch(("a", "b"), frames, valid, rgb=rgb.astype(np.float32))
    with pytest.raises(BadInputError, match="frames must be int64"):
        Batch(("a",), frames, valid)
    with pytest.raises(BadInputError, match="features must be float32"):
        Batch(("a", "b"), frames, valid, features=np.zeros((2, 2, 5), np.float32))
    with pytest.raises(BadInputError, match="0 motions"):
        Batch(("a", "b"), frames, valid, state=())


def test_batches_are_selected_and_cut() -> None:
    rng = np.random.default_rng(0)
    batch = Batch(
        ("a", "b", "c"),
        np.tile(np.arange(4, dtype=np.int64), (3, 1)),
        np.ones((3, 4), np.bool_),
        rgb=rng.integers(0, 256, (3, 4, 2, 2, 3), dtype=np.uint8),
        camera=np.zeros((3, 2, 4, 4)),
    )
    chosen = batch.select([2, 0])
    assert chosen.trials == ("c", "a") and np.array_equal(chosen.rgb[1], batch.rgb[0])
    cut = batch.steps(slice(1, 3))
    assert cut.frames.tolist() == [[1, 2]] * 3 and cut.camera.shape == (3, 2, 4, 4)
    moved = batch.to("cpu")
    assert isinstance(moved.rgb, torch.Tensor) and moved.rgb.dtype == torch.uint8


def test_a_clip_that_is_longer_than_its_motion_repeats_the_last_frame() -> None:
    frames, valid = clip_frames((0, 6, 12, 18), 13)
    assert frames.tolist() == [0, 6, 12, 12] and valid.tolist() == [True, True, True, False]


@pytest.mark.parametrize("name", models.names())
def test_every_model_keeps_to_the_interface(name: str) -> None:
    model = tiny(name)
    assert isinstance(model, Model) and isinstance(model.spec, Spec)
    provenance = model.provenance()
    assert provenance.init in {"random", "none"}
    assert provenance.model and provenance.versions
    json.dumps(model.spec.context_frames())
    assert any(can(model, what) for what in ("encode", "imagine", "predict", "fit"))
    assert ways(model)
    digest = model.digest()
    assert len(digest) == 64 and int(digest, 16) >= 0 and tiny(name).digest() == digest
    if can(model, "loss"):
        assert isinstance(model, nn.Module) and model.window >= 1


@pytest.mark.parametrize("name", [n for n in models.names() if isinstance(tiny(n), nn.Module)])
def test_the_digest_of_a_network_follows_its_weights(name: str) -> None:
    model = tiny(name)
    before = model.digest()
    with torch.no_grad():
        next(model.parameters()).view(-1)[0] += 1e-3
    assert model.digest() != before


@pytest.mark.parametrize("name", FROZEN)
def test_every_frozen_encoder_encodes_imagines_and_learns(name: str) -> None:
    torch.manual_seed(0)
    model = tiny(name)
    spec = model.spec
    frames = torch.randint(0, 256, (2, 9, spec.image_size, spec.image_size, 3), dtype=torch.uint8)
    features = model.encode(clips(frames))
    assert features.shape == (2, 9, model.feature_size) and features.dtype == torch.float32
    assert torch.equal(model.encode(clips(frames)), features)
    assert not torch.equal(features[0, 0], features[0, 1])
    context = features[:, : spec.context]
    kept = context.clone()
    rollout = model.imagine(replace(clips(None, context), future=3), 2, 0).features
    assert rollout.shape == (2, 2, 3, model.feature_size)
    assert torch.equal(rollout[:, 0], rollout[:, 1]), "the dynamics are deterministic"
    assert torch.equal(context, kept), "a rollout must not change what it started from"
    model.prepare(clips(None, features))
    loss = model.loss(clips(None, features))["loss"]
    baseline = model.baseline(clips(None, features))
    assert loss.shape == baseline.shape == () and float(baseline) > 0
    loss.backward()
    gradients = [p.grad for p in model.parameters()]
    assert gradients and all(g is not None for g in gradients)
    assert sum(float(g.abs().sum()) > 0 for g in gradients) >= 2


@pytest.mark.parametrize("name", models.names())
def test_unknown_options_get_the_closest_ones(name: str) -> None:
    with pytest.raises(UnknownNameError, match=f"option of model {name} 'sampels'"):
        build_model(name, sampels=3)


def test_unknown_names_get_the_closest_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"pVGG-lstm.*FILE\.py:Class"):
        build_model("pVGG-lsm")
    with pytest.raises(UnknownNameError, match="resnet18"):
        build_model("frozen-encoder", encoder="resnet81", weights="random")
    with pytest.raises(BadInputError, match="'mlp' or 'lstm'"):
        build_model("frozen-encoder", **{**TINY, "dynamics": "gru"})


def test_simulators_and_baselines_run_without_torch_and_others_name_the_extra() -> None:
    code = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name in ("torch", "timm", "torchvision", "safetensors", "lightning_fabric", "av"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
import physion.readout
from physion.core.errors import MissingExtraError
from physion.models.build import build_model
for name in ("noisy-simulation", "chance", "state-trees", "already-touched",
             "constant-motion", "blob-centroids", "copy-last-frame"):
    build_model(name)
try:
    build_model("pVGG-mlp")
except MissingExtraError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "-e '.[models]'" in done.stdout


# --- options: each value has the type that its field declares -----------------------------------


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ("samples=1.5", "samples of model noisy-simulation must be a whole number, not 1.5"),
        ("samples=1e9", "samples of model noisy-simulation must be a whole number"),
        ("samples=x", "samples of model noisy-simulation must be a whole number, not 'x'"),
        ("samples=true", "samples of model noisy-simulation must be a whole number, not True"),
        ("samples=null", "samples of model noisy-simulation must be a whole number, not None"),
        ("samples=[1]", "samples of model noisy-simulation must be a whole number"),
        ("scales=5", "scales of model noisy-simulation must be a list, not 5"),
        ("scales=[null]", r"scales of model noisy-simulation\[0\] must be a finite number"),
        ("scales=[NaN]", r"scales of model noisy-simulation\[0\] must be a finite number"),
        ("scale=1e999", "scale of model noisy-simulation must be a finite number"),
        ("engine=7", "engine of model noisy-simulation must be a text, not 7"),
        ("samples=" + "[" * 5000, "samples of model noisy-simulation must be a whole number"),
    ],
)
def test_values_of_another_type_are_one_line(option: str, says: str) -> None:
    with pytest.raises(BadInputError, match=says) as error:
        build_model("noisy-simulation", **parse_pairs((option,), "--option"))
    assert "\n" not in str(error.value) and len(str(error.value)) < 300


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("frozen-encoder", {"pooling": "other"}, "pooling of model frozen-encoder must be"),
        ("frozen-encoder", {"fine_tuned": True, "distillation": -0.1}, "must be at least 0"),
        ("frozen-encoder", {"fine_tuned": True, "standardised": False}, "standardised=true"),
        ("pVGG-mlp", {"size": "released", "fine_tuned": True}, "trains no encoder"),
        ("svg", {"backbone": "resnet"}, "must be 'dcgan' or 'vgg'"),
        ("svg", {"image_size": 48}, "image_size must be 16, 32, 64, 128 or 256, not 48"),
        ("svg", {"samples": 0}, "samples must be at least 1"),
        ("svg", {"size": "large"}, "sizes small, paper, released"),
        ("op3", {"slots": 0}, "slots must be at least 1"),
        ("dpi", {"size": "huge"}, "sizes small, paper"),
        ("dpi", {"samples": 1.5}, "samples of model dpi must be a whole number"),
        ("dpi", {"stride": 2}, "stride of model dpi must be 1 or 3"),
        ("dpi", {"spread": -1.0}, "spread must be at least 0"),
        ("dpi", {"weights": "shipped", "size": "paper"}, "no weights are shipped for dpi-paper"),
        ("constant-motion", {"frames": 0}, "frames must be at least 1"),
        ("already-touched", {"margin": 0.5}, "margin must be at least 0 and below 0.5"),
    ],
)
def test_values_that_make_no_model_are_one_line(
    name: str, options: dict[str, Any], says: str
) -> None:
    with pytest.raises(BadInputError, match=says) as error:
        build_model(name, **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", models.names())
def test_every_field_of_the_settings_is_an_option(name: str) -> None:
    """The values that a model has can be given again, and give the same settings."""
    kind = settings_type(models.get(name))
    assert kind is not None and issubclass(kind, ModelSettings)
    built = tiny(name).settings
    values = dataclasses.asdict(built)
    assert values.pop("model") in (name, built.model) and tuple(values) == option_names(name)
    if not (name.startswith("noisy-simulation-") or name == "frozen-encoder"):
        assert make_settings(kind, name, values) == built


@pytest.mark.parametrize("name", ["svg", "op3", "cswm", "rpin", "gns", "gns-ransac", "dpi"])
def test_shipped_weights_are_the_default_and_only_for_their_settings(name: str) -> None:
    shipped: Any = build_model(name)
    assert shipped.trained and shipped.init.startswith("shipped:")
    fresh: Any = build_untrained(name)
    assert not fresh.trained and fresh.init == "random"
    assert fresh.digest() == build_model(name, **UNTRAINED).digest() != shipped.digest()
    paper = settings_type(models.get(name))
    assert paper is not None and make_settings(paper, name, {"size": "paper"}).weights == "random"
    size = "hidden" if "hidden" in option_names(name) else "width"
    with pytest.raises(BadInputError, match=f"shipped weights of {name} are for .*weights=random"):
        build_model(name, **{"rollout" if name == "rpin" else size: 24})


@dataclasses.dataclass(frozen=True)
class BlinkSettings:
    """Settings of a user's model."""

    rate: float = 1.0


class Blink(Model):
    """Model of a user; its options are the fields of the settings."""

    def __init__(self, settings: BlinkSettings) -> None:
        self.settings = settings


class Plain(Model):
    """Model of a user with plain arguments."""

    def __init__(self, gain: float = 1.0, name: str = "", extra: Any = None) -> None:
        self.gain, self.name, self.extra = gain, name, extra


@pytest.mark.parametrize(
    ("kind", "options", "says"),
    [
        (Blink, {"rate": "high"}, "option rate of model own must be a finite number, not 'high'"),
        (Blink, {"rat": 1.0}, "unknown option of model own 'rat'; closest: rate"),
        (Plain, {"gain": "high"}, "option gain of model own must be a finite number, not 'high'"),
        (Plain, {"gian": 1.0}, "unknown option of model own 'gian'; closest: gain"),
    ],
)
def test_options_of_a_model_of_ones_own_are_checked(
    kind: Any, options: dict[str, Any], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("physion.models.build._factory", lambda name: kind)
    with pytest.raises(PhysionError, match=says) as error:
        build_model("own", **options)
    assert "\n" not in str(error.value)


def test_python_may_give_tuples_numbers_of_numpy_and_whole_numbers() -> None:
    config = make_settings(
        NoisySimulationSettings,
        "noisy-simulation",
        {"samples": np.int64(3), "scales": (1, np.float32(0.5)), "scale": 2},
    )
    assert (config.samples, config.scales, config.scale) == (3, (1.0, 0.5), 2.0)
    assert isinstance(config.scale, float)
