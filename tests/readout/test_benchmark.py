"""The rules of v1.5: frames that are shown, one readout of all scenarios, what is refused."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import physion
from physion.clips.batch import Batch, Provenance, Spec
from physion.core.errors import BadInputError, UnknownNameError
from physion.models.interface import Model
from physion.readout.benchmark import GRID, LEFT_OUT, V1_5
from physion.readout.evaluate import evaluate
from physion.readout.settings import EvaluationSettings
from physion.trials.dataset import Dataset
from support.moving_dots import SIZE, make_dots

V15 = EvaluationSettings(accelerator="cpu", benchmark="v1.5")
FIRST = 70
"""First frame of every contact."""


class Watcher(Model):
    """Model that notes the frames that it is shown; its features are where the dot is."""

    decision = "logistic"
    spec = Spec(image_size=SIZE, stride=6)

    def __init__(self) -> None:
        self.shown: dict[str, set[tuple[int, ...]]] = {}

    def encode(self, batch: Batch) -> Any:
        for trial, frames in zip(batch.trials, batch.frames.tolist(), strict=True):
            self.shown.setdefault(trial, set()).add(tuple(frames))
        red = batch.rgb[..., 0].astype(np.float32)
        return np.concatenate([red.mean(3), red.mean(2)], axis=-1)

    def provenance(self) -> Provenance:
        return Provenance("watcher", "none")

    def digest(self) -> str:
        return hashlib.sha256(b"watcher").hexdigest()


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    counts = {"readout": 8, "testing": 4}
    made: Dataset = make_dots(tmp_path_factory.mktemp("dots"), counts, ("collide", "drop", "drape"))
    contact = made.index["contact"].astype(bool)
    made.index["first_frame"] = pd.Series(FIRST, contact.index).where(contact).astype("Int64")
    return made


def test_no_frame_after_the_last_one_and_the_first_is_repeated() -> None:
    assert Spec().context_frames(15) == (3, 3, 3, 3, 3, 3, 9, 15)
    assert Spec(stride=2, context=16).context_frames(15) == (1,) * 8 + tuple(range(1, 16, 2))
    assert Spec(context=7, context_at="start").context_frames(15) == (0, 0, 0, 0, 0, 6, 12)
    assert Spec(stride=9).context_frames() == (8, 17, 26, 35, 44)


@pytest.mark.slow
def test_frames_readouts_and_rows(dots: Dataset, tmp_path: Path) -> None:
    model = Watcher()
    table = evaluate(model, dots, tmp_path, V15).predictions
    assert set(table["scenario"]) == {"collide", "drop"}, "seven scenarios, Drape is none of them"
    assert set(table["benchmark"]) == {"v1.5"} and set(table["readout"]) == {"observed", "full"}
    context = {"collide": (3, 3, 3, 3, 3, 3, 9, 15), "drop": tuple(range(2, 45, 6))}
    # 46 frames of a contact, or of the middle of the 151 of a movie without one, in steps of six.
    for trial, seen in model.shown.items():
        around = FIRST if int(trial[-4:]) % 2 == 0 else 75
        window = tuple(range(around - 27, around + 16, 6))
        assert seen == {context[trial.partition("_")[0]], window}
    texts = table.groupby(["readout", "scenario"])["frames"].unique().map(list).to_dict()
    assert texts["observed", "collide"] == ["3 to 15, 5/s"]
    assert texts["observed", "drop"] == ["2 to 44, 5/s"]
    assert texts["full", "drop"] == ["contact -30 to +15, 5/s"]
    # One regression of both scenarios, on all their trials, with C of the grid of v1.5.
    assert set(table["fit_trials"]) == {16}
    for _, rows in table.groupby("readout"):
        assert rows["readout_c"].nunique() == 1 and set(rows["readout_c"]) <= set(GRID)


@pytest.mark.slow
def test_both_benchmarks_are_named_in_the_table_of_results(dots: Dataset, tmp_path: Path) -> None:
    settings = EvaluationSettings(accelerator="cpu", readouts=("observed",))
    first = evaluate(Watcher(), dots, tmp_path, settings)
    second = evaluate(Watcher(), dots, tmp_path, settings, benchmark="v1.5")
    assert set(first.predictions["frames"]) == {"2 to 44, 5/s"}
    assert set(first.predictions["scenario"]) == {"collide", "drop", "drape"}
    shown = physion.compare([*first.paths, *second.paths]).summary
    assert dict(zip(shown["model"], shown["frames"], strict=True)) == {
        "watcher · observed · benchmark v1": "v1: 2 to 44, 5/s",
        "watcher · observed · benchmark v1.5": "v1.5: 3 to 15, 5/s or 2 to 44, 5/s",
    }


@pytest.mark.slow
def test_a_tested_scenario_is_read_out_from_all(dots: Dataset, tmp_path: Path) -> None:
    table = evaluate(Watcher(), dots, tmp_path, V15, scenario="drop").predictions
    assert set(table["scenario"]) == {"drop"} and set(table["fit_trials"]) == {16}


def test_nothing_is_trained_that_v1_5_has_no_use_for(dots: Dataset, tmp_path: Path) -> None:
    options = {"encoder": "test_vit", "image_size": 64, "weights": "random"}
    trained = {}
    for name in ("v1", "v1.5"):
        plan = evaluate("frozen-encoder", dots, tmp_path, V15, options=options, benchmark=name,
                        dry_run=True)  # fmt: skip
        trained[name] = [one.protocol for one in plan.evaluated]
    assert trained == {"v1": ["all"], "v1.5": [""]}


def test_what_does_not_fit_is_refused_in_a_line(dots: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="benchmark"):
        evaluate(Watcher(), dots, tmp_path, benchmark="v2")
    with pytest.raises(BadInputError, match="state-trees reads states"):
        evaluate("state-trees", dots, tmp_path, V15)
    with pytest.raises(BadInputError, match=r"does not support the readout observed\+simulated"):
        evaluate(Watcher(), dots, tmp_path, V15, readouts=("observed+simulated",))
    features = tmp_path / "features.npz"
    np.savez(features, names=np.array(dots.trials()), frames=np.array([44]),
             features=np.ones((len(dots), 1, 2), np.float32))  # fmt: skip
    with pytest.raises(BadInputError, match=r"by the rules of v1, not v1\.5"):
        evaluate(features, dots, tmp_path, V15)
    index = dots.index.assign(first_frame=pd.Series(pd.NA, dots.index.index, dtype="Int64"))
    with pytest.raises(BadInputError, match="frame of the contact"):
        V1_5.windows(index)


def test_which_trials_take_part(dots: Dataset) -> None:
    stimulus = "pilot_it2_collision_non-sphere_box_0002"
    assert len(LEFT_OUT) == 41 and stimulus in LEFT_OUT
    index = dots.index.copy()
    tested = index.index[(index["scenario"] == "collide") & (index["split"] == "testing")]
    index.loc[tested[0], "trial"] = stimulus.replace("_0002", "-redyellow_0002")
    index.loc[tested[2], "first_frame"] = 16
    index.loc[tested[2], "observed_contact"] = True
    kept = V1_5.select(index)
    assert len(kept) == 2 * 12 - 1 and stimulus not in set(kept["trial"])
    assert not kept["observed_contact"].any(), "frame 16 of Collide is not shown"
