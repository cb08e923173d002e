"""Options of models: each value has the type that its field declares, or is refused in one line."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import pytest

from physion.cli.model_options import parse_options
from physion.core.errors import BadInputError, PhysionError
from physion.models.baselines.pixels import BlobCentroidsConfig
from physion.models.build import build_model, make_config
from physion.models.encoders.encoder import EncoderConfig
from physion.models.encoders.video import VideoConfig
from physion.models.noisy_simulation import NoisySimulationConfig
from physion.models.particles.simulator import ParticleOptions
from physion.models.vision import VisionOptions

CONFIGS: list[Any] = [
    BlobCentroidsConfig, EncoderConfig, NoisySimulationConfig, ParticleOptions, VideoConfig,
    VisionOptions,
]  # fmt: skip


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
        build_model("noisy-simulation", **parse_options((option,)))
    assert "\n" not in str(error.value) and len(str(error.value)) < 300


def test_a_choice_without_a_check_of_its_own_is_checked() -> None:
    with pytest.raises(PhysionError, match="pooled"):
        make_config(EncoderConfig, "m", {"pooling": "other"})
    with pytest.raises(BadInputError, match="dynamics must be mlp or lstm"):
        make_config(EncoderConfig, "m", {"dynamics": "other"})


@pytest.mark.parametrize("kind", CONFIGS)
def test_defaults_are_of_their_types(kind: Any) -> None:
    values = {f.name: getattr(kind(), f.name) for f in dataclasses.fields(kind)}
    assert make_config(kind, "m", values) == kind()


def test_python_may_give_tuples_numbers_of_numpy_and_whole_numbers() -> None:
    config = make_config(
        NoisySimulationConfig,
        "m",
        {"samples": np.int64(3), "scales": (1, np.float32(0.5)), "scale": 2},
    )
    assert (config.samples, config.scales, config.scale) == (3, (1.0, 0.5), 2.0)
    assert isinstance(config.scale, float)


def test_nesting_without_end_takes_a_moment() -> None:
    start = time.process_time()
    assert parse_options(("a=" + "[" * 100_000,))["a"].startswith("[[")
    assert time.process_time() - start < 5
