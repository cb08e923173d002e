"""Options of models: each value has the type that its field declares, or is refused in one line."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import pytest

from physion.core.errors import BadInputError, PhysionError
from physion.core.settings import parse_pairs
from physion.models.build import (
    build_model,
    build_untrained,
    make_settings,
    models,
    option_names,
    settings_type,
)
from physion.models.interface import Model, ModelSettings
from physion.models.noisy_simulation import NoisySimulationSettings
from support.tiny_models import UNTRAINED, tiny


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
    with pytest.raises(BadInputError, match=f"shipped weights of {name} are for .*weights=random"):
        build_model(
            name,
            **{
                "rollout"
                if name == "rpin"
                else "hidden"
                if "hidden" in option_names(name)
                else "width": 24
            },
        )


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


def test_nesting_without_end_takes_a_moment() -> None:
    start = time.process_time()
    assert parse_pairs(("a=" + "[" * 100_000,), "--option")["a"].startswith("[[")
    assert time.process_time() - start < 5
