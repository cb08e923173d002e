"""Rules by which models are evaluated: ``v1``, of the paper, or ``v1.5``, of physion_evaluator.

| | v1 | v1.5 |
|---|---|---|
| scenarios | all | seven, without Drape |
| last frame that may be seen | 44 | 44, in Collide 15 |
| readouts | all three | *observed* (prediction), *full* (detection) |
| logistic regression | one per scenario | one of all scenarios, C of `GRID` |
| frames of *full* | to the end of the movie | 30 before to 15 after the first contact |
| tested stimuli | all | without `LEFT_OUT` |

Numbers of the two are not comparable. Where the code of v1.5 is not followed: it shows frame 45
too, which comes after the observed part; for *full* it leaves out the earliest frame and passes the
others from the last to the first; and it rounds features to 16 bits.

References
----------
``dataloader_mp4s.py`` and ``train_readout.py`` of neuroailab/physion_evaluator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pandas as pd

from physion.clips.batch import LAST_OBSERVED, Spec
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import RIGID, canonical_name
from physion.models.interface import ask
from physion.readout.decisions import Readout
from physion.readout.folds import TESTING, Fold, ScenarioSplit, select_scenario
from physion.readout.logistic import C_GRID, LogisticSettings
from physion.readout.model_calls import model_name

GRID = (1e-6, 1e-5, 0.01, 0.1, 1.0, 5.0, 10.0, 20.0)
"""Inverse penalties of v1.5."""
TOGETHER = "all scenarios"
"""Name of the scenarios that share a readout."""
_LEFT_OUT = {
    "pilot-containment-cone-plate": "0017 0022 0029 0034",
    "pilot-containment-multi-bowl": "0042 0048",
    "pilot-containment-vase_torus": "0031",
    "pilot_dominoes_SJ020_d3chairs_o1plants_tdwroom": "0005",
    "pilot_it2_collision_non-sphere_box": "0002",
    "pilot_it2_collision_non-sphere_tdw_1_dis_1_occ": "0004 0007",
    "pilot_it2_drop_simple_box": "0000 0042",
    "pilot_it2_drop_simple_tdw_1_dis_1_occ": "0003",
    "pilot_it2_rollingSliding_simple_collision_box": "0008",
    "pilot_it2_rollingSliding_simple_collision_box_large_force": "0009",
    "pilot_it2_rollingSliding_simple_collision_tdw_1_dis_1_occ": "0002",
    "pilot_it2_rollingSliding_simple_ledge_tdw_1_dis_1_occ_sphere_small_zone": "0022",
    "pilot_it2_rollingSliding_simple_ramp_box_small_zone": "0006",
    "pilot_it2_rollingSliding_simple_ramp_tdw_1_dis_1_occ_small_zone": "0004 0017",
    "pilot_linking_nl1-8_mg000_aCyl_bCyl_tdwroom1_long_a": "0022",
    "pilot_linking_nl1-8_mg000_aCylcap_bCyl_tdwroom1": "0012",
    "pilot_linking_nl1-8_mg000_aCylcap_bCyl_tdwroom_small_rings": "0006 0010 0029 0036",
    "pilot_linking_nl6_aNone_bCone_occ1_dis1_boxroom": "0028",
    "pilot_towers_nb4_fr015_SJ000_gr000sph_mono1_dis0_occ0_tdwroom_stable": (
        "0000 0002 0003 0010 0013 0017 0018 0032 0036"
    ),
    "pilot_towers_nb4_fr015_SJ000_gr01_mono0_dis1_occ1_tdwroom_unstable": "0021 0041",
    "pilot_towers_nb5_fr015_SJ030_mono0_dis0_occ0_boxroom_unstable": "0006 0009",
}
LEFT_OUT = frozenset(f"{name}_{n}" for name, numbers in _LEFT_OUT.items() for n in numbers.split())
"""Test stimuli that the authors of v1.5 leave out, as ``buggy_stims``, by canonical name."""


@dataclass(frozen=True)
class Benchmark:
    """Rules of an evaluation.

    - ``name``: which is in every row of a table. ``scenarios``: that are tested; empty: all.
    - ``last``: by scenario the last frame that may be seen, where it is not `LAST_OBSERVED`.
    - ``window``: first and last frame of *full*, counted from the first contact, or from the middle
      of a movie without one; None: the entire movie.
    - ``readouts``: that are possible. ``together``: whether all scenarios share one readout.
    - ``grid``: inverse penalties of the logistic regression. ``left_out``: stimuli not tested.
    """

    name: str
    scenarios: tuple[str, ...] = ()
    last: Mapping[str, int] = field(default_factory=dict)
    window: tuple[int, int] | None = None
    readouts: tuple[str, ...] = tuple(readout.value for readout in Readout)
    together: bool = False
    grid: tuple[float, ...] = C_GRID
    left_out: frozenset[str] = frozenset()

    def check(self, model: Any) -> None:
        """Raise `BadInputError` for a model that cannot be evaluated by these rules."""
        own = ask(model, "benchmark")
        if own not in ("", self.name):
            raise BadInputError(
                f"{model_name(model)} has features by the rules of {own}, not {self.name}; leave "
                "out the option benchmark, or encode the movies of the other one"
            )
        if self.last and "state" in model.spec.inputs:
            raise BadInputError(
                f"{model_name(model)} reads states, which {self.name} does not give: it is about "
                "models that see movies; leave out the option benchmark"
            )

    def select(self, index: pd.DataFrame) -> pd.DataFrame:
        """Return the trials of an index that take part, with whether a contact is observed."""
        if self.scenarios:
            index = index[index["scenario"].isin(self.scenarios)]
        if self.left_out:
            names = index["trial"].map(canonical_name)
            index = index[~(names.isin(self.left_out) & (index["split"] == TESTING))]
        if self.last:
            last = index["scenario"].map(lambda name: self.last.get(name, LAST_OBSERVED))
            seen = index["first_frame"].astype("float64") <= last
            known = index["first_frame"].notna() & index["scenario"].isin(self.last)
            index = index.assign(observed_contact=index["observed_contact"].mask(known, seen))
        return index

    def last_frames(self, index: pd.DataFrame) -> dict[str, int]:
        """Return by trial the last frame that may be seen, where it is an earlier one."""
        rows = index[index["scenario"].isin(self.last)]
        return {str(t): self.last[s] for t, s in zip(rows["trial"], rows["scenario"], strict=True)}

    def windows(self, index: pd.DataFrame) -> dict[str, tuple[int, int]]:
        """Return by trial the first and last frame of *full*, where it is not the entire movie.

        Raises `BadInputError` for a contact whose frame is not known.
        """
        if self.window is None:
            return {}
        first, contact = index["first_frame"], index["contact"].fillna(False).astype(bool)
        if len(unknown := index[contact & first.isna()]):
            raise BadInputError(
                f"the frame of the contact of {unknown['trial'].iloc[0]!r} is not known, around "
                f"which {self.name} detects it; ask for --readouts observed"
            )
        around = first.where(contact, index["frames"] // 2).astype(int)
        before, after = self.window
        return {
            str(trial): (frame + before, frame + after)
            for trial, frame in zip(index["trial"], around.tolist(), strict=True)
        }

    def arrange(self, folds: Sequence[Fold], scenario: str) -> list[Fold]:
        """Return folds in which a scenario is tested (all if empty), with the trials to fit on."""
        chosen = select_scenario(folds, scenario)
        if not self.together:
            return chosen
        arranged = []
        for whole, kept in zip(folds, chosen, strict=True):
            fit = sorted({trial for split in whole.scenarios for trial in split.fit})
            test = sorted({trial for split in kept.scenarios for trial in split.test})
            split = ScenarioSplit(TOGETHER, tuple(fit), tuple(test))
            arranged.append(replace(kept, scenarios=(split,)))
        return arranged

    def logistic(self, settings: LogisticSettings) -> LogisticSettings:
        """Return the settings of the regression, with the grid of these rules if none was set."""
        return replace(settings, grid=self.grid) if settings.grid == C_GRID else settings

    def describe_frames(self, spec: Spec, readout: str, scenario: str, rate: float) -> str:
        """Return the frames that a model sees of trials, and how many a second, as text.

        ``rate``: frames of the movie a second. Empty for a model that sees nothing of a trial.
        """
        if not spec.inputs:
            return ""
        state = "state" in spec.inputs
        shown = spec.context_frames(self.last.get(scenario, LAST_OBSERVED))
        first, last = (0, str(LAST_OBSERVED)) if state else (shown[0], str(shown[-1]))
        each = rate if state else rate / spec.stride
        if readout == Readout.FULL.value:
            last = "end"
            if self.window is not None:
                before, after = self.window
                return f"contact {before:+d} to {after:+d}, {each:g}/s"
        return f"{first} to {last}, {each:g}/s"


V1 = Benchmark("v1")
V1_5 = Benchmark(
    "v1.5",
    scenarios=RIGID,
    last={"collide": 15},
    window=(-30, 15),
    readouts=(Readout.OBSERVED.value, Readout.FULL.value),
    together=True,
    grid=GRID,
    left_out=LEFT_OUT,
)
BENCHMARKS = {one.name: one for one in (V1, V1_5)}


def benchmark_of(model: Any, name: str = "") -> Benchmark:
    """Return the rules called ``name``, by default the model's own, else `V1`.

    Raises `UnknownNameError` for an unknown name, and `BadInputError` for a model that cannot be
    evaluated by them.
    """
    chosen = BENCHMARKS.get(name or ask(model, "benchmark") or V1.name)
    if chosen is None:
        raise UnknownNameError("benchmark", name, BENCHMARKS)
    chosen.check(model)
    return chosen
