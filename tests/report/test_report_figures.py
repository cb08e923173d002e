"""Figures: they show the numbers of their tables, and their bytes do not depend on the day."""

from __future__ import annotations

import dataclasses
import io
import itertools
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from PIL import Image

from physion.analysis import figure_tables
from physion.analysis.comparison import ANOTHER, Comparison
from physion.analysis.model_tests import paired_tests, pool_comparison
from physion.analysis.people.effects import below_chance_level
from physion.analysis.rollout_errors import COLUMNS, CONSTANT_VELOCITY, ERRORS
from physion.analysis.scores import COMPUTED
from physion.analysis.tables import MEAN, name_models
from physion.cli.main import main
from physion.core.names import SCENARIOS
from physion.data.official import official
from physion.report.compare import compare
from physion.report.figures import theme
from physion.report.figures.by_scenario import draw_rollout_error as draw
from physion.report.figures.by_scenario import (
    measure_figure,
    model_and_people_figure,
    rollout_error,
)
from physion.report.figures.by_stimulus import (
    SQUARE,
    difficulty_figure,
    misleading_plot,
    response_time_figure,
    scatter_figure,
)
from physion.report.figures.overview import overview
from physion.report.figures.theme import LIGHT, make_plots
from physion.report.figures.training import generalization_figure, grouped_figure
from physion.report.html import number
from physion.report.inputs import ReportInputs
from physion.trials.video import encode_movie
from support.paths import ROOT

Maker = Callable[..., Comparison]


def dots(figure: Figure, panel: int) -> list[float]:
    """The values at which a panel has a mark, from top to bottom."""
    lines = [line for line in figure.axes[panel].lines if line.get_marker() not in ("None", None)]
    points = [(y, x) for line in lines for x, y in line.get_xydata()]  # type: ignore[union-attr]
    return [x for _, x in sorted(points)]


def test_dots_stand_at_the_accuracies(make_comparison: Maker) -> None:
    comparison = make_comparison()
    table = figure_tables.accuracy_table(comparison)
    figure = measure_figure(table, measure="accuracy")
    for place, scenario in enumerate(["collide", "drop", "mean"]):
        own = table[table["panel"] == scenario]
        assert dots(figure, place) == pytest.approx(own["value"].tolist())
        people = comparison.people.set_index("scenario").loc[scenario, "accuracy"]
        assert any(np.allclose(line.get_xdata(), people) for line in figure.axes[place].lines)
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert titles == ["collide", "drop", "mean over scenarios"]


def test_baselines_stand_below_the_models_lighter_and_hollow(make_comparison: Maker) -> None:
    comparison = make_comparison(model="constant-motion")
    given, model = "constant-motion · observed", "encoder · observed+simulated"
    table = figure_tables.accuracy_table(comparison)
    assert set(table.loc[table["kind"] != figure_tables.BASELINE, "model"]) == {model}
    figure = measure_figure(table, measure="accuracy")
    names = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert names == [model, given, *COMPUTED]
    inks = [text.get_color() for text in figure.axes[0].get_yticklabels()]
    assert inks == [theme.LIGHT.ink, *[theme.LIGHT.faint] * 4]
    marks = [line for line in figure.axes[0].lines if line.get_marker() not in ("None", None)]
    hollow = [line.get_markerfacecolor() == theme.LIGHT.paper for line in marks]
    assert hollow == [False, True, True, True, True]
    assert [text.get_text() for text in figure.legends[0].get_texts()].count("baseline") == 1
    # One person has an r too, with the average of the others.
    assert list(figure_tables.r_table(comparison)["model"].unique()) == [model, given, *COMPUTED]
    thirds = figure_tables.thirds_table(comparison)
    assert next(iter(thirds["model"].unique())) == model
    # Figures of single answers show models only.
    assert ReportInputs(comparison).scatter_models() == [model]


def test_the_readout_that_sees_the_outcome_is_not_compared_with_people(
    make_comparison: Maker,
) -> None:
    """As in the paper: detection has accuracies only."""
    plain = make_comparison()
    comparison = make_comparison(readout="full")
    detecting, predicting = comparison.names
    assert detecting.endswith("full")
    scores = comparison.all_scores.set_index(["model", "scenario"])
    known = plain.all_scores.set_index(["model", "scenario"])
    likeness = ["r", "kappa_from_averages", "rmsd", "difference", "r_beyond_outcome"]
    for scenario in ("collide", "drop", MEAN):
        own = scores.loc[detecting, scenario]
        before = known.loc[plain.names[0], scenario]
        assert own["accuracy"] == before["accuracy"] and own["d_prime"] == before["d_prime"]
        assert own["human_accuracy"] == before["human_accuracy"]
        assert own[likeness].isna().all() and before[likeness].notna().all()
        assert own[[f"{name}_low" for name in likeness]].isna().all()
        assert "sees the outcome" in own["reason"]
        other = scores.loc[predicting, scenario]
        assert other[likeness].tolist() == known.loc[predicting, scenario][likeness].tolist()
    inputs = ReportInputs(comparison)
    marks = inputs.tables()["comparison"].set_index(["model", "scenario"])
    assert (marks.loc[detecting, ["reliably", "people_interval"]] == "").all(axis=None)
    plots = {plot.name: plot.table for plot in make_plots(inputs)}
    for name in ("r", "thirds", "scatter", "right_answers", "people_and_models"):
        assert predicting in set(plots[name]["model"]), name
        assert detecting not in set(plots[name]["model"]), name
    assert detecting in set(plots["accuracy"]["model"])
    tests = paired_tests(pool_comparison(comparison), permutations=20).iloc[0]
    assert np.isnan(tests["r_difference"]) and np.isfinite(tests["accuracy_difference"])
    assert paired_tests(pool_comparison(plain), permutations=20)["r_difference"].notna().all()


def test_zones_of_participants_and_of_scenarios_look_different(make_comparison: Maker) -> None:
    table = figure_tables.accuracy_table(make_comparison())
    assert set(table.loc[table["zone_low"].notna(), "panel"]) == {"collide"}
    row = table.iloc[[0]].assign(zone_low=0.4, zone_high=0.6)
    hatches = []
    for zone in (figure_tables.PARTICIPANTS, figure_tables.SCENARIO_ZONE):
        axis = measure_figure(row.assign(zone=zone), measure="accuracy").axes[0]
        hatches.append(axis.patches[0].get_hatch())
    assert hatches[0] is None and hatches[1]


def test_undefined_values_are_dashes_in_the_figure(make_comparison: Maker) -> None:
    table = figure_tables.r_table(make_comparison(constant=True))
    table = table[table["kind"] != figure_tables.BASELINE]
    assert table["value"].isna().all() and table["reason"].str.contains("undefined|constant").all()
    words = [text.get_text() for text in measure_figure(table, measure="r").axes[0].texts]
    assert words == ["–", "–"]


def test_points_are_the_stimuli_in_the_square_of_their_scenario(make_comparison: Maker) -> None:
    comparison = make_comparison()
    table = figure_tables.scatter_table(comparison, comparison.names)
    figure = scatter_figure(table)
    own = table[table["model"] == comparison.names[1]]
    changed = own["label"] != own["simulated"]
    assert changed.sum() == 1
    filled, hollow = figure.axes[1].lines[1:]
    assert hollow.get_markerfacecolor() == "none" and filled.get_markerfacecolor() != "none"
    for line, part in ((filled, own[~changed]), (hollow, own[changed])):
        squares = (part["scenario"] == "drop") * SQUARE
        expected = np.column_stack([part["p_yes"] + squares, part["p_contact"]])
        assert np.allclose(line.get_xydata(), expected)
    words = [text.get_text() for text in figure.axes[1].texts]
    r = np.corrcoef(*own.loc[own["scenario"] == "drop", ["p_contact", "p_yes"]].T.to_numpy())[0, 1]
    assert words[1] == f"drop, r = {number(r)}"


def test_thirds_are_of_the_stimuli_that_bear_their_name(make_comparison: Maker) -> None:
    comparison = make_comparison()
    table = figure_tables.thirds_table(comparison)
    own = comparison.stimuli[comparison.stimuli["model"] == comparison.names[1]]
    easy = own[own["human_accuracy"] >= 2 / 3]
    row = table[(table["model"] == comparison.names[1]) & table["panel"].str.startswith("easy")]
    assert row["stimuli"].item() == len(easy)
    expected = [
        np.corrcoef(part["p_contact"], part["p_yes"])[0, 1] for _, part in easy.groupby("scenario")
    ]
    assert len(expected) == 2
    assert row["value"].item() == pytest.approx(np.mean(expected))
    assert row["low"].isna().all(), "two scenarios are too few to draw"
    assert table["people"].isna().all()


def test_intervals_of_thirds_draw_scenarios(make_comparison: Maker) -> None:
    """As in the paper: percentiles of means over scenarios drawn with replacement. A scenario
    whose answers are constant does not count, and is named."""
    comparison = make_comparison()
    rng = np.random.default_rng(3)
    model = comparison.names[0]
    part = comparison.stimuli[comparison.stimuli["model"] == model].iloc[:6]
    rows = []
    for scenario in ("collide", "drop", "link", "roll", "support"):
        p_contact = np.full(6, 0.5) if scenario == "roll" else rng.random(6)
        p_yes = 0.9 + rng.random(6) / 10
        names = [f"{scenario}{i}" for i in range(6)]
        rows.append(part.assign(scenario=scenario, stimulus=names, p_contact=p_contact,
                                p_yes=p_yes, human_accuracy=p_yes, label=True))  # fmt: skip
    stimuli = pd.concat(rows, ignore_index=True)
    table = figure_tables.thirds_table(dataclasses.replace(comparison, stimuli=stimuli))
    row = table[(table["model"] == model) & table["panel"].str.startswith("easy")].iloc[0]
    known = [rows[k] for k in (0, 1, 2, 4)]
    r = np.array([np.corrcoef(part["p_contact"], part["p_yes"])[0, 1] for part in known])
    assert row["value"] == pytest.approx(r.mean())
    # All 256 draws of four scenarios, instead of random ones.
    means = [r[list(drawn)].mean() for drawn in itertools.product(range(4), repeat=4)]
    expected = np.percentile(means, [2.5, 97.5])
    assert [row["low"], row["high"]] == pytest.approx(expected, abs=0.1 * np.ptp(expected))
    assert "roll" in row["reason"] and "drop" not in row["reason"]


def test_thirds_show_what_halves_of_people_reach(make_comparison: Maker) -> None:
    comparison = make_comparison()
    shown = comparison.stimuli.drop_duplicates("stimulus").set_index("stimulus")
    people = [f"p{i}" for i in range(20)]
    rows = pd.DataFrame(
        [(p, s) for p in people for s in shown.index], columns=["session", "stimulus"]
    )
    drawn = np.random.default_rng(0).random(len(rows))
    rows["yes"] = drawn < shown.loc[rows["stimulus"], "p_yes"].to_numpy()
    table = figure_tables.thirds_table(comparison, rows).drop_duplicates("panel").set_index("panel")
    easy = shown[shown["human_accuracy"] >= 2 / 3]
    # Written out here: halves of people, their fractions of yes, r of the two, by scenario.
    order = np.random.default_rng(1).permuted(np.tile(np.arange(20), (500, 1)), axis=1)
    found = []
    for scenario in ("collide", "drop"):
        own = rows[rows["stimulus"].isin(easy.index[easy["scenario"] == scenario])]
        yes = own.pivot(index="session", columns="stimulus", values="yes").to_numpy()
        halves = [(yes[one[:10]].mean(0), yes[one[10:]].mean(0)) for one in order]
        r = [np.corrcoef(*pair)[0, 1] for pair in halves]
        found.append([np.mean(r), np.percentile(r, 2.5)])
    mean, low = np.mean(found, axis=0)
    row = table.loc["easy (from 2/3)"]
    assert row["people"] == pytest.approx(mean, abs=0.02)
    assert row["zone_low"] == pytest.approx(low, abs=0.08)
    assert row["zone_low"] < row["people"] < row["zone_high"]
    figure = measure_figure(figure_tables.thirds_table(comparison, rows), measure="r")
    place = list(table["people"].notna()).index(True)
    value = table["people"].iloc[place]
    assert any(np.allclose(line.get_xdata(), value) for line in figure.axes[place].lines)


def test_the_zone_of_r_is_of_halves_of_the_people(make_comparison: Maker) -> None:
    comparison = make_comparison()
    zones = pd.DataFrame(
        [(scenario, "r", of, low, low + 0.1) for scenario in ("collide", "drop")
         for of, low in (("participants", 0.3), ("halves", 0.7 + 0.1 * (scenario == "drop")))],
        columns=["scenario", "measure", "of", "low", "high"],
    )  # fmt: skip
    table = figure_tables.r_table(comparison, zones).drop_duplicates("panel").set_index("panel")
    assert table.loc["collide", ["zone_low", "zone_high"]].tolist() == pytest.approx([0.7, 0.8])
    assert table.loc["drop", "zone"] == figure_tables.HALVES
    assert table.loc[MEAN, ["zone_low", "zone_high"]].tolist() == pytest.approx([0.75, 0.85])


# --- people against models ----------------------------------------------------------------------


def test_people_stand_against_every_model_by_scenario(make_comparison: Maker) -> None:
    comparison = make_comparison()
    table = figure_tables.people_and_models_table(comparison, comparison.models)
    own = comparison.stimuli[comparison.stimuli["scenario"] == "drop"]
    for model, rows in own.groupby("model"):
        row = table[(table["model"] == model) & (table["scenario"] == "drop")].iloc[0]
        assert row["accuracy"] == pytest.approx((rows["predicted"] == rows["label"]).mean())
        assert row["people"] == pytest.approx(rows["human_accuracy"].mean())
    figure = model_and_people_figure(table)
    assert len(figure.axes) >= 2
    for axis, model in zip(figure.axes, comparison.models, strict=False):
        rows = table[table["model"] == model]
        points = [np.asarray(line.get_xydata())[0].tolist() for line in axis.lines[1:]]
        assert points == rows[["accuracy", "people"]].to_numpy().tolist()


def test_right_answers_are_the_probability_of_the_recorded_outcome(make_comparison: Maker) -> None:
    comparison = make_comparison()
    table = figure_tables.right_answers_table(comparison, comparison.names[:1])
    rows = comparison.stimuli[comparison.stimuli["model"] == comparison.names[0]]
    expected = [p if label else 1 - p
                for p, label in zip(rows["p_contact"], rows["label"], strict=True)]  # fmt: skip
    assert table["p_right"].tolist() == pytest.approx(expected)
    plots = {plot.name: plot for plot in make_plots(ReportInputs(comparison))}
    figure = plots["right_answers"].draw(table, theme.LIGHT)
    points = np.vstack([np.asarray(line.get_xydata()) for line in figure.axes[0].lines[1:]])
    shift = SQUARE * (table["scenario"] == "drop")
    found = sorted(map(tuple, np.round(points, 9)))
    drawn = np.column_stack([table["p_right"] + shift, table["human_accuracy"]])
    assert found == sorted(map(tuple, np.round(drawn, 9)))
    assert figure.get_supylabel() == "accuracy of people"


def test_frames_are_of_the_stimuli_that_mislead_people_most(tmp_path: Path) -> None:
    names = [f"s{k}" for k in range(6)]
    rows = pd.DataFrame({"scenario": "drop", "stimulus": names, "count": 100,
                         "accuracy": [0.3, 0.1, 0.9, 0.2, 0.25, 0.05]})  # fmt: skip
    movies = {}
    for place, name in enumerate(names[:5]):  # of s5, the worst, there is no movie
        movie = np.full((50, 32, 32, 3), 40 * place, np.uint8)
        movie[45:] = 250
        movies[name] = tmp_path / f"{name}.mp4"
        movies[name].write_bytes(encode_movie(movie))
    plot = misleading_plot(below_chance_level(rows), movies)
    assert plot is not None
    assert plot.table["shown"].tolist() == [0, 1, 0, 2, 3, 0]
    figure = plot.draw(plot.table, theme.LIGHT)
    pictures = [axis.images[0].get_array() for axis in figure.axes if axis.images]
    means = [float(np.mean(picture)) for picture in pictures]  # type: ignore[arg-type]
    assert means == pytest.approx([40, 250, 120, 250, 160, 250], abs=4)
    words = [axis.get_title(loc="left") for axis in figure.axes]
    assert words[:3] == ["drop, 5 of 6", "10% of 100 right", "end"]
    assert misleading_plot(below_chance_level(rows), {}) is None
    assert misleading_plot(below_chance_level(rows.assign(accuracy=0.9)), movies) is None


# --- marks stand where the table says -----------------------------------------------------------


def segments(axis: Axes) -> list[tuple[float, float, float]]:
    """Height and ends of the horizontal lines of a panel that are no marks, from top to bottom."""
    lines = [np.asarray(line.get_xydata()) for line in axis.lines if line.get_linestyle() == "-"]
    flat = [line for line in lines if len(line) == 2 and line[0, 1] == line[1, 1]]
    return sorted((line[0, 1], line[0, 0], line[1, 0]) for line in flat)


def test_intervals_zones_and_written_values_belong_to_their_row(make_comparison: Maker) -> None:
    table = figure_tables.accuracy_table(make_comparison())
    figure = measure_figure(table, measure="accuracy")
    models = list(table["model"].unique())
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == models
    for axis, name in zip(figure.axes, ("collide", "drop", MEAN), strict=False):
        rows = table[table["panel"] == name].set_index("model").loc[models]
        known = rows[rows["low"].notna()]
        expected = [
            (models.index(model), row["low"], row["high"]) for model, row in known.iterrows()
        ]
        own = [line for line in segments(axis) if line[0] == int(line[0])]
        np.testing.assert_allclose(own, expected)
        words = [text.get_text() for text in axis.texts]
        assert words == [number(value) for value in rows["value"]]
        if rows["zone_low"].notna().any():
            (zone,) = (patch.get_extents() for patch in axis.patches)
            ends = axis.transData.inverted().transform(zone)[:, 0]
            np.testing.assert_allclose(ends, rows.iloc[0][["zone_low", "zone_high"]].astype(float))


def test_marks_of_conditions_stand_in_the_row_of_their_model() -> None:
    rows = [
        ("readout", model, group, value, value - 0.02, value + 0.05, 0.7, 9.0, "")
        for model, values in (("one", (0.5, 0.6)), ("two", (0.7, 0.8)), ("three", (0.3, 0.4)))
        for group, value in zip(("observed", "full"), values, strict=True)
    ]
    table = pd.DataFrame(
        rows,
        columns=["panel", "model", "group", "value", "low", "high", "people", "stimuli", "reason"],
    )
    axis = grouped_figure(table).axes[0]
    assert [text.get_text() for text in axis.get_yticklabels()] == ["one", "two", "three"]
    marks = [line for line in axis.lines if line.get_marker() not in ("None", None)]
    bars = list(axis.collections)
    for mark, bar, group, shift in zip(
        marks, bars, ("observed", "full"), (-0.12, 0.12), strict=True
    ):
        own = table[table["group"] == group]
        places = np.arange(3) + shift
        np.testing.assert_allclose(mark.get_xydata(), np.column_stack([own["value"], places]))
        ends = np.array(bar.get_segments())  # type: ignore[attr-defined]
        np.testing.assert_allclose(ends[:, :, 0], own[["low", "high"]])
        np.testing.assert_allclose(ends[:, 0, 1], places)
    texts = axis.get_legend().get_texts()  # type: ignore[union-attr]
    assert [text.get_text() for text in texts] == ["observed", "full", "people"]
    assert any(np.allclose(line.get_xdata(), 0.7) for line in axis.lines)


def test_a_condition_has_the_same_mark_in_all_panels() -> None:
    columns = ["panel", "model", "group", "value", "low", "high", "people"]
    rows = [
        (panel, "one", group, 0.5, 0.4, 0.6, np.nan)
        for panel, groups in (("left", ("all", "all-but", "only")), ("right", ("all", "only")))
        for group in groups
    ]
    drawn = [
        {line.get_label(): line.get_color() for line in axis.get_legend().legend_handles}  # type: ignore[union-attr]
        for axis in grouped_figure(pd.DataFrame(rows, columns=columns)).axes[:2]
    ]
    assert list(drawn[1]) == ["all", "only"] and drawn[1].items() < drawn[0].items()


def test_cells_of_the_generalization_are_of_their_row_and_column() -> None:
    rows = [
        ("m", trained, tested, 0.1 * i + 0.01 * j, 0.7)
        for i, trained in enumerate(("all", "drop", "roll"))
        for j, tested in enumerate(("drop", "roll"))
    ]
    table = pd.DataFrame(rows, columns=["model", "trained", "tested", "difference", "people"])
    axis = generalization_figure(table).axes[0]
    found = {text.get_position()[::-1]: text.get_text() for text in axis.texts}
    assert found[(0, 0)] == "0.00" and found[(2, 1)] == "+0.21" and found[(1, 0)] == "+0.10"
    assert [text.get_text() for text in axis.get_yticklabels()] == ["all", "drop", "roll"]
    assert [text.get_text() for text in axis.get_xticklabels()] == ["drop", "roll"]
    assert axis.images[0].get_array()[1, 1] == pytest.approx(0.11)  # type: ignore[index]


def test_parts_of_the_tail_have_their_colour() -> None:
    """Of 200 people 84 right is below chance by the study's rule only, 20 also when corrected."""
    rows = pd.DataFrame({"scenario": "drop", "stimulus": [f"s{i}" for i in range(30)],
                         "accuracy": [0.42, 0.1] + [0.9] * 28, "count": 200})  # fmt: skip
    axis = difficulty_figure(below_chance_level(rows)).axes[0]
    found = {
        round(patch.get_x(), 2): (to_hex(patch.get_facecolor()).upper(), patch.get_height())
        for patch in axis.patches
    }
    palette = theme.LIGHT.palette
    assert found == {0.9: (palette[0].upper(), 28), 0.4: (palette[4].upper(), 1),
                     0.1: (palette[5].upper(), 1)}  # fmt: skip
    assert axis.texts[0].get_text() == "2 of 30\nbelow chance"
    mean = [line for line in axis.lines if line.get_linestyle() == "--"]
    assert mean[0].get_xdata()[0] == pytest.approx((0.42 + 0.1 + 28 * 0.9) / 30)  # type: ignore[index]


def test_the_line_of_response_times_is_the_least_squares_line() -> None:
    x, y = np.array([0.2, 0.4, 0.5, 0.9]), np.array([7.0, 7.4, 7.1, 6.5])
    table = pd.DataFrame({"scenario": "drop", "accuracy": x, "mean_log_rt": y})
    axis = response_time_figure(table).axes[0]
    points, line = (np.asarray(drawn.get_xydata()) for drawn in axis.lines)
    np.testing.assert_allclose(points, np.column_stack([x, y]))
    slope, level, r, *_ = scipy.stats.linregress(x, y)
    np.testing.assert_allclose(line, [[0.2, level + 0.2 * slope], [0.9, level + 0.9 * slope]])
    assert axis.get_title(loc="right") == f"r = {number(r)}"


def test_the_key_tells_the_scenarios_apart() -> None:
    names = [*SCENARIOS, MEAN]
    table = pd.DataFrame({"model": "DPI", "scenario": names, "accuracy": 0.6, "people": 0.7})
    figure = model_and_people_figure(table)
    key = {text.get_text(): (line.get_color(), line.get_marker(), line.get_markerfacecolor())
           for text, line in zip(figure.legends[0].get_texts(), figure.legends[0].get_lines(),
                                 strict=True)}  # fmt: skip
    assert list(key) == [*SCENARIOS, "mean over scenarios"] and len(set(key.values())) == 9
    drawn = [(line.get_color(), line.get_marker(), line.get_markerfacecolor())
             for line in figure.axes[0].lines[1:]]  # fmt: skip
    assert drawn == list(key.values())


# --- readout and training -----------------------------------------------------------------------


def trained(make_comparison: Maker, trainings: list[str]) -> tuple[Comparison, pd.DataFrame]:
    """The comparison with both models as one, trained in as many ways."""
    comparison = make_comparison()
    stimuli = comparison.stimuli.assign(base_model="one", readout="observed")
    comparison = dataclasses.replace(comparison, stimuli=stimuli)
    column = dict(zip(comparison.names, trainings, strict=True))
    rows = stimuli[["model", "stimulus"]]
    return comparison, rows.assign(protocol=rows["model"].map(column))


def test_effects_hold_the_accuracy_of_each_training(make_comparison: Maker) -> None:
    comparison, predictions = trained(make_comparison, ["all", "only"])
    table = figure_tables.effects_table(comparison, predictions)
    assert table["group"].tolist() == ["all", figure_tables.ONLY]
    scores = comparison.scores[comparison.scores["scenario"] == "mean"]
    assert table["value"].tolist() == pytest.approx(scores["accuracy"].tolist())
    assert ((table["low"] < table["value"]) & (table["value"] < table["high"])).all()


def test_one_condition_makes_no_figure(make_comparison: Maker) -> None:
    comparison, predictions = trained(make_comparison, ["all", "all"])
    assert figure_tables.effects_table(comparison, predictions).empty
    assert figure_tables.generalization_table(comparison, predictions).empty
    names = {plot.name for plot in make_plots(ReportInputs(comparison, predictions=predictions))}
    assert names == {"overview", "accuracy", "r", "people_and_models", "scatter", "right_answers",
                     "thirds", "difficulty"}  # fmt: skip


def test_a_figure_without_a_value_is_left_out(
    make_comparison: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The correlation of a model that always answers alike is undefined."""
    inputs = ReportInputs(make_comparison())
    assert "r" in {plot.name for plot in make_plots(inputs)}
    table = figure_tables.r_table

    def empty(*given: object) -> pd.DataFrame:
        return table(*given)[:0]  # type: ignore[arg-type]

    monkeypatch.setattr(figure_tables, "r_table", empty)
    assert "r" not in {plot.name for plot in make_plots(inputs)}


def test_a_training_on_one_scenario_is_a_row_of_the_heat_map(make_comparison: Maker) -> None:
    """Protocol one: the column names the training scenario, whatever the tested one."""
    comparison = make_comparison()
    made = comparison.stimuli.drop(columns=["base_model", "scenario"])
    parts = []
    for place, scenario in enumerate(("collide", "drop")):
        own = made[made["model"] == comparison.names[place]]
        parts.append(own.assign(model="m", readout="full", protocol="one",
                                dynamics_training_dataset=scenario))  # fmt: skip
    rows = name_models(
        pd.concat(parts, ignore_index=True)[
            ["model", "readout", "protocol", "dynamics_training_dataset", "stimulus", "p_contact"]
        ]
    )
    assert list(rows["model"].unique()) == [f"m · full · trained on {name}"
                                            for name in ("collide", "drop")]  # fmt: skip
    stimuli = comparison.stimuli.merge(
        pd.DataFrame({"model": comparison.names, "named": rows["model"].unique()}), on="model"
    )
    stimuli = stimuli.assign(model=stimuli["named"], base_model="m", readout="full")
    comparison = dataclasses.replace(comparison, stimuli=stimuli)
    table = figure_tables.generalization_table(comparison, rows)
    assert table[["trained", "tested"]].to_numpy().tolist() == [
        ["collide", "collide"], ["collide", "drop"], ["drop", "collide"], ["drop", "drop"]
    ]  # fmt: skip
    for row in table.itertuples():
        own = stimuli[(stimuli["model"] == f"m · full · trained on {row.trained}")
                      & (stimuli["scenario"] == row.tested)]  # fmt: skip
        right = (own["predicted"] == own["label"]).mean()
        assert row.difference == pytest.approx(right - own["human_accuracy"].mean())
    effects = figure_tables.effects_table(comparison, rows)
    assert effects["group"].tolist() == [figure_tables.ONLY, ANOTHER]


def numbered(axis: Axes, which: str) -> tuple[bool, bool]:
    """Whether an axis has ticks on its outer side, and whether these have numbers."""
    ticks = (axis.xaxis if which == "x" else axis.yaxis).get_major_ticks()
    return ticks[0].tick1line.get_visible(), ticks[0].label1.get_visible()


def test_an_odd_number_of_models_leaves_no_column_without_scenarios() -> None:
    pairs = [(model, trained, tested) for model in "abc" for trained in ("all", "drop")
             for tested in SCENARIOS]  # fmt: skip
    table = pd.DataFrame(pairs, columns=["model", "trained", "tested"])
    figure = generalization_figure(table.assign(difference=0.1, people=0.7))
    figure.draw_without_rendering()
    first, right, lower = figure.axes[:3]
    for axis in (right, lower):
        assert [text.get_text() for text in axis.get_xticklabels()] == list(SCENARIOS)
        assert numbered(axis, "x") == (True, True)
    assert numbered(first, "x") == (False, False)
    assert numbered(first, "y") == (True, True) and numbered(right, "y") == (False, False)


def test_panels_inside_have_neither_ticks_nor_numbers(make_comparison: Maker) -> None:
    table = figure_tables.accuracy_table(make_comparison())
    table = pd.concat([table[table["panel"] == "drop"].assign(panel=name) for name in SCENARIOS])
    axes = measure_figure(table, measure="accuracy").axes
    ticks = [(numbered(axis, "x"), numbered(axis, "y")[0]) for axis in axes[: len(SCENARIOS)]]
    yes, no = (True, True), (False, False)
    assert [x for x, _ in ticks] == [no] * 5 + [yes] * 3
    assert [y for _, y in ticks] == [True, False, False] * 2 + [True, False]


# --- one file each ------------------------------------------------------------------------------


@pytest.mark.nightly
@pytest.mark.slow
def test_a_figure_of_another_package_is_found(tmp_path: Path) -> None:
    (tmp_path / "own_figure.py").write_text(
        "from physion.report.figures.theme import BY_SCENARIO, register_figure\n"
        "@register_figure('own', section=BY_SCENARIO, order=15)\n"
        "def own(inputs): return None\n"
    )
    (tmp_path / "own-1.0.dist-info").mkdir()
    (tmp_path / "own-1.0.dist-info" / "METADATA").write_text("Name: own\nVersion: 1.0\n")
    (tmp_path / "own-1.0.dist-info" / "entry_points.txt").write_text(
        "[physion.figures]\nown = own_figure:own\n"
    )
    code = (
        "from physion.report.figures.theme import all_figures\n"
        "print(*(entry.name for entry in all_figures()))"
    )
    paths = os.pathsep.join([str(tmp_path), str(ROOT / "src")])
    environment = os.environ | {"PYTHONPATH": paths}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split()[:4] == ["overview", "accuracy", "own", "r"]


# --- looks --------------------------------------------------------------------------------------


def test_kinds_differ_without_colour() -> None:
    assert len(set(theme.MARKERS)) == len(theme.MARKERS) == len(theme.LIGHT.palette)


@pytest.mark.parametrize("look", [theme.LIGHT, theme.DARK], ids=lambda look: look.name)
def test_marks_stand_out_from_the_paper(look: theme.Theme) -> None:
    def brightness(colour: str) -> float:
        linear = [
            c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)
        ]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    def contrast(one: str, other: str) -> float:
        dark, light = sorted((brightness(one), brightness(other)))
        return (light + 0.05) / (dark + 0.05)

    assert contrast(look.ink, look.paper) > 7
    assert contrast(look.faint, look.paper) > 3
    assert min(contrast(colour, look.paper) for colour in look.palette) > 1.5


@pytest.mark.nightly
@pytest.mark.slow
def test_figures_are_sound_files(make_comparison: Maker) -> None:
    for plot in make_plots(ReportInputs(make_comparison())):
        figure = plot.draw(plot.table, theme.LIGHT)
        assert ElementTree.fromstring(theme.figure_bytes(figure, "svg")).tag.endswith("svg")
        assert b"<text" not in theme.figure_bytes(figure, "svg")
        assert theme.figure_bytes(figure, "pdf").startswith(b"%PDF")
        image = Image.open(io.BytesIO(theme.figure_bytes(figure, "png")))
        assert image.width > 900 and np.asarray(image.convert("L")).std() > 10


@pytest.mark.nightly
@pytest.mark.slow
def test_a_darkened_figure_is_the_one_drawn_in_the_dark_theme(make_comparison: Maker) -> None:
    names = re.compile(rb"\b[mphC][0-9a-f]{10}(_\w+)?\b")  # of markers, clips and hatches
    for plot in make_plots(ReportInputs(make_comparison())):
        light, dark = (
            names.sub(b"", theme.figure_bytes(plot.draw(plot.table, look), "svg"))
            for look in (theme.LIGHT, theme.DARK)
        )
        assert light != dark and theme.darkened(light) == dark, plot.name


def test_model_names_are_text_and_not_formulas(make_comparison: Maker) -> None:
    table = figure_tables.accuracy_table(make_comparison(model="$x_1$ <b> & co"))
    figure = measure_figure(table, measure="accuracy")
    assert figure.axes[0].get_yticklabels()[0].get_text().startswith("$x_1$ <b>")
    assert theme.figure_bytes(figure, "png")


@pytest.mark.slow
def test_the_first_picture_has_one_mark_per_model_and_published_ones_hollow() -> None:
    """A reader sees accuracy to the right and kappa upwards, as the table of results has them."""
    labels = official().labels
    p = {name: 0.8 if contact else 0.3 for name, contact in labels.items()}
    result = compare({"mine": p}, humans="official")
    assert isinstance(result.inputs, ReportInputs)
    plot = overview(result.inputs)
    assert plot is not None
    table, shown = plot.table.set_index("row"), result.results.set_index("row")
    assert "V-JEPA 2 ViT-L *" not in table.index, "its likeness to people is not known"
    assert set(table.index) == set(shown.index) - {"V-JEPA 2 ViT-L *"}
    figure = plot.draw(plot.table, theme.LIGHT)
    (axis,), (legend,) = figure.axes, figure.legends
    figure.draw_without_rendering()
    assert len(legend.get_texts()) == 7 and not legend.get_window_extent().overlaps(axis.bbox)
    marks = [line for line in axis.lines if line.get_marker() != "None"]
    for line, (name, row) in zip(marks, table.iterrows(), strict=True):
        np.testing.assert_allclose(line.get_xydata(), [[row["accuracy"], row["kappa"]]])
        hollow = line.get_markerfacecolor() == theme.LIGHT.paper
        assert hollow == str(name).endswith(" *"), name
    written = {text.get_text() for text in axis.texts}
    assert written == {name.removesuffix(" *") for name in table.index}
    (zone,) = axis.patches
    low = official().results / "human_accuracy_by_scenario.csv"
    assert zone.get_x() == pytest.approx(pd.read_csv(low)["pct_2.5"].mean())


# --- errors of imagined motion ------------------------------------------------------------------


SECONDS = (0.03, 0.06)


def table() -> pd.DataFrame:
    rows = [
        (panel, model, kind, seconds, 5, slope * seconds, slope * seconds - 0.01,
         slope * seconds + 0.02)
        for panel in ("drop", "mean")
        for model, kind, slope in (
            ("one", "model", 1.0), ("two", "model", 2.0), (CONSTANT_VELOCITY, "baseline", 50.0)
        )
        for seconds in SECONDS
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=list(COLUMNS))


def test_curves_and_bands_match_the_table() -> None:
    figure = draw(table(), LIGHT)
    drop, mean = figure.axes[:2]
    assert drop.get_title("left") == "drop" and mean.get_title("left") == "mean over scenarios"
    drawn = [line.get_xydata() for line in drop.lines]
    for points, slope in zip(drawn, (1.0, 2.0, 50.0), strict=True):
        assert np.allclose(np.asarray(points), [[s, slope * s] for s in SECONDS])
    bands = [band for band in drop.collections if isinstance(band, PolyCollection)]
    heights = [band.get_paths()[0].get_extents() for band in bands]
    assert heights[1].ymin == pytest.approx(0.05) and heights[1].ymax == pytest.approx(0.14)
    # Constant velocity, here far above the models, does not make their curves flat.
    assert drop.get_ylim()[1] < 0.4 and drop.get_ylim()[0] == 0
    styles = {str(line.get_linestyle()) for line in drop.lines}
    assert len(styles) == 3, "lines differ without colour"
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["one", "two", CONSTANT_VELOCITY]


def test_no_errors_no_figure(make_comparison: Maker) -> None:
    comparison = make_comparison()
    assert rollout_error(ReportInputs(comparison)) is None
    plot = rollout_error(ReportInputs(comparison, rollout_errors=table()))
    assert plot is not None and plot.table.equals(table())


@pytest.mark.nightly
@pytest.mark.slow
def test_compare_draws_the_errors_that_it_is_given(tmp_path: Path) -> None:
    predictions = pd.DataFrame(
        {
            "Model": "sim",
            "Readout Type": "B",
            "Predicted Prob_true": [0.9, 0.2, 0.7, 0.1],
            "Predicted Outcome": [True, False, True, False],
            "Actual Outcome": [True, False, False, False],
            "Stimulus Name": [f"pilot_it2_drop_simple_box_{i:04d}" for i in range(4)],
        }
    )
    predictions.to_csv(tmp_path / "p.csv", index=False)
    errors = pd.DataFrame(
        [("sim", "drop", f"drop_testing_{i:04d}", 3, 0.1 * i, 0.4) for i in range(4)],
        columns=[column.name for column in ERRORS],
    )
    errors.to_csv(tmp_path / "e.csv", index=False)
    arguments = ["compare", str(tmp_path / "p.csv"), "--resamples", "20"]
    arguments += ["--out", str(tmp_path / "report"), "--rollout-errors"]
    assert main([*arguments, str(tmp_path / "e.csv")]) == 0
    drawn = pd.read_csv(tmp_path / "report" / "figures" / "rollout_error.csv")
    assert drawn["value"].tolist() == pytest.approx([0.15, 0.4])
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "Error of imagined motion" in page
    assert main([*arguments, str(tmp_path / "p.csv")]) == 2
