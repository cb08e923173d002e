"""Properties of every model, and inputs that the interface rejects."""

from __future__ import annotations

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
from physion.core.errors import BadInputError, UnknownNameError
from physion.models import Batch, Spec, build_model, models
from physion.models.interface import Model, can
from physion.readout.predictor import ways
from support.tiny_models import FROZEN, TINY, tiny


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


def test_spec_shows_the_frames_of_the_released_models() -> None:
    spec = Spec(context=7, future=18, context_at="start")
    assert spec.context_frames() == (0, 6, 12, 18, 24, 30, 36)
    for length in (60, 602):
        assert spec.all_frames(length) == tuple(range(0, 145, 6))
    spec = Spec(stride=9, context=5, future=11, context_at="start")
    assert spec.all_frames(602)[-1] == 135


def test_spec_with_few_frames_ends_with_the_last_observed_one() -> None:
    spec = Spec(stride=5, context=4, future=2)
    assert spec.all_frames(100) == (29, 34, 39, 44, 49, 54)


@pytest.mark.parametrize(
    "wrong",
    [
        {"context": 8, "stride": 7},
        {"future": -1},
        {"stride": 0},
        {"image_size": 0},
        {"context": -1},
        {"inputs": ("sound",)},
        {"context_at": "middle"},
        {"objects": 0},
    ],
)
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
from physion.models import build_model
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
