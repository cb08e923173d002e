"""Properties of every model, and inputs that the interface rejects."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import physion.registry
from physion.errors import BadInputError, MissingExtraError, UnknownNameError
from physion.models import Clip, Provenance, Spec, build_model, models
from physion.models.interface import Encodes, Learns, ModelFactory, PredictsContact, Simulates
from physion.registry import Registry

TINY = {"encoder": "test_vit", "image_size": 64, "weights": "random", "hidden": 16}


def tiny(name: str) -> Any:
    """Build a model in its smallest configuration."""
    return build_model(name, **({} if name == "noisy-simulation" else TINY))


def test_spec_shows_the_frames_of_the_released_models() -> None:
    assert Spec().observed_indices() == (0, 6, 12, 18, 24, 30, 36)
    assert Spec().all_indices() == tuple(range(0, 145, 6))
    assert Spec(stride=9, context=5, total=16).all_indices()[-1] == 135


@pytest.mark.parametrize(
    "wrong",
    [{"context": 8, "stride": 7}, {"total": 7}, {"stride": 0}, {"image_size": 0}, {"context": 0}],
)
def test_spec_refuses_context_past_the_observed_part_and_empty_clips(wrong: dict[str, int]) -> None:
    with pytest.raises(BadInputError, match="spec"):
        Spec(**wrong)  # type: ignore[arg-type]


def test_clip_that_claims_to_be_observed_holds_no_later_frame() -> None:
    frames = np.zeros((2, 8, 8, 3), np.uint8)
    assert Clip("a", frames, (0, 44), observed=True).observed
    with pytest.raises(BadInputError, match="frame 45"):
        Clip("a", frames, (0, 45), observed=True)
    with pytest.raises(BadInputError, match="uint8"):
        Clip("a", frames.astype(np.float32), (0, 1), observed=True)
    with pytest.raises(BadInputError, match="3 indices"):
        Clip("a", frames, (0, 1, 2), observed=True)


@pytest.mark.parametrize("name", models.names())
def test_every_model_keeps_to_the_interface(name: str) -> None:
    model = tiny(name)
    assert isinstance(model.spec, Spec)
    provenance = model.provenance()
    assert provenance.init in {"random", "none"}
    assert provenance.model and provenance.versions
    json.dumps(model.spec.observed_indices())
    offers = [isinstance(model, what) for what in (Encodes, Simulates, Learns, PredictsContact)]
    assert any(offers)
    if isinstance(model, Simulates):
        assert isinstance(model, Encodes) and isinstance(model, Learns)


@pytest.mark.parametrize("name", [n for n in models.names() if n != "noisy-simulation"])
def test_every_seeing_model_encodes_simulates_and_learns(name: str) -> None:
    torch.manual_seed(0)
    model = tiny(name)
    spec = model.spec
    frames = torch.randint(0, 256, (2, 9, spec.image_size, spec.image_size, 3), dtype=torch.uint8)
    features = model.encode(frames)
    assert features.shape == (2, 9, model.feature_size) and features.dtype == torch.float32
    assert torch.equal(model.encode(frames), features)
    assert not torch.equal(features[0, 0], features[0, 1])
    context = features[:, : spec.context]
    kept = context.clone()
    rollout = model.simulate(context, 4)
    assert rollout.shape == (2, 4, model.feature_size)
    assert torch.equal(context, kept), "a rollout must not change what it started from"
    assert torch.allclose(model.simulate(context, 1), rollout[:, :1], atol=1e-6)
    loss = model.loss({"features": features})
    loss.backward()
    gradients = [p.grad for p in model.parameters()]
    assert gradients and all(g is not None for g in gradients)
    assert sum(float(g.abs().sum()) > 0 for g in gradients) >= 2


@pytest.mark.parametrize("name", [n for n in models.names() if n != "noisy-simulation"])
def test_frames_of_another_size_or_type_are_refused(name: str) -> None:
    model = tiny(name)
    with pytest.raises(BadInputError, match="uint8"):
        model.encode(torch.zeros(1, 7, 64, 64, 3))
    with pytest.raises(BadInputError, match="64, 64"):
        model.encode(torch.zeros(1, 7, 32, 32, 3, dtype=torch.uint8))


@pytest.mark.parametrize("name", models.names())
def test_unknown_options_get_the_closest_ones(name: str) -> None:
    wrong = "sampels" if name == "noisy-simulation" else "dynamic"
    with pytest.raises(UnknownNameError, match=r"samples|dynamics"):
        build_model(name, **{wrong: 3})


def test_unknown_names_get_the_closest_ones() -> None:
    with pytest.raises(UnknownNameError, match="pVGG-lstm"):
        build_model("pVGG-lsm")
    with pytest.raises(UnknownNameError, match="resnet18"):
        build_model("frozen-encoder", encoder="resnet81", weights="random")
    with pytest.raises(BadInputError, match="mlp or lstm"):
        build_model("frozen-encoder", **{**TINY, "dynamics": "gru"})


def test_random_weights_never_bear_the_name_of_a_published_model() -> None:
    model = build_model("pVGG-mlp", weights="random", hidden=4)
    assert model.provenance().model == "random-vgg19-mlp"
    assert model.provenance().init == "random"
    assert model.provenance().encoder_pretraining_task == ""
    assert build_model("pVGG-lstm", hidden=4).provenance().model == "pVGG-lstm"
    assert build_model("pDeIT-mlp", hidden=4).provenance().model == "pDeIT-mlp"
    assert build_model("pDeIT-mlp", hidden=4).provenance().init == "imagenet"


def test_published_encoders_have_their_feature_sizes() -> None:
    sizes = [
        build_model(name, weights="random", hidden=2).feature_size  # type: ignore[attr-defined]
        for name in ("pVGG-lstm", "pDeIT-lstm")
    ]
    assert sizes == [4096, 768]


class _Foreign(nn.Module):
    """Model as another package would define it."""

    spec = Spec(image_size=8)

    def provenance(self) -> Provenance:
        return Provenance("foreign", "none")


def test_another_package_adds_a_model_by_an_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    def points(group: str) -> list[EntryPoint]:
        return [EntryPoint("foreign", f"{__name__}:_Foreign", group)]

    monkeypatch.setattr(physion.registry, "entry_points", points)
    fresh: Registry[ModelFactory] = Registry("model")
    assert fresh.names() == ["foreign"]
    assert fresh.get("foreign")().provenance().model == "foreign"


def test_simulators_run_without_torch_and_others_name_the_extra() -> None:
    code = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name in ("torch", "timm", "torchvision", "safetensors", "lightning_fabric"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
import physion.readout
from physion.errors import MissingExtraError
from physion.models import build_model
build_model("noisy-simulation")
try:
    build_model("pVGG-mlp")
except MissingExtraError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install -e '.[models]'" in done.stdout


def test_missing_libraries_of_other_kinds_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name}", name="something_else")

    monkeypatch.setattr(models, "get", missing)
    with pytest.raises(ModuleNotFoundError):
        build_model("pVGG-mlp")
    assert not issubclass(ModuleNotFoundError, MissingExtraError)
