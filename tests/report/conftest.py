"""A small comparison with invented answers, and a browser, for the tests of figures and pages."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator

import numpy as np
import pandas as pd
import pytest

from physion.analysis.comparison import Comparison, compare_scores
from physion.analysis.intervals import Bootstrap
from support.browser import Browser

Maker = Callable[..., Comparison]


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    found = Browser(tmp_path_factory.mktemp("profile"))
    yield found
    found.close()


@pytest.fixture(scope="session")
def make_comparison() -> Maker:
    """Builds a comparison of two models on Collide and Drop; ``model`` and ``readout`` are of the
    first one."""

    @functools.cache
    def make(
        model: str = "simulation",
        with_people: bool = True,
        constant: bool = False,
        readout: str = "observed",
    ) -> Comparison:
        generator = np.random.default_rng(0)
        stems = {"collide": "pilot_it2_collision_simple_box", "drop": "pilot_it2_drop_simple_box"}
        names = [(s, f"{stem}_{i:04d}") for s, stem in stems.items() for i in range(12)]
        people = pd.DataFrame(names, columns=["scenario", "stimulus"])
        people["accuracy"] = generator.integers(5, 20, 24) / 20
        people["count"] = 20.0
        labels = {name: place % 2 == 0 for place, name in enumerate(people["stimulus"])}
        actual = np.array(list(labels.values()))
        actual[5] = not actual[5]
        tables = []
        for name, given in ((model, readout), ("encoder", "observed+simulated")):
            p = np.full(24, 0.5) if constant else generator.random(24)
            tables.append(pd.DataFrame({
                "Model": name, "Readout Type": given, "Predicted Prob_true": p,
                "Predicted Outcome": p > 0.5, "Actual Outcome": actual,
                "Stimulus Name": people["stimulus"],
            }))  # fmt: skip
        zone = pd.DataFrame({"scenario": ["collide"], "low": [0.6], "high": [0.8]})
        return compare_scores(
            pd.concat(tables),
            people if with_people else None,
            labels if with_people else None,
            zone=zone if with_people else None,
            bootstrap=Bootstrap(resamples=100),
        )

    return make
