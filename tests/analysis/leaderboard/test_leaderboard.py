"""Many files in one table: the scores are those of a comparison, versions and drops are there."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import cohen_kappa_score

from physion.analysis import Bootstrap, compare_scores, read_predictions
from physion.analysis.leaderboard.leaderboard import leaderboard
from physion.analysis.leaderboard.order import columns, sort_leaderboard
from physion.analysis.leaderboard.submissions import Filters, read_sidecar
from physion.analysis.people.exclusions import ExclusionRules
from physion.analysis.people.participants import Responses, clean
from physion.analysis.people.response_schema import TRIAL_COLUMNS, check_table
from physion.core.errors import BadInputError, UnknownNameError
from physion.report.leaderboard_page import leaderboard_page

QUICK = Bootstrap(resamples=200)
STEMS = {"collide": "pilot_it2_collision_simple_box", "drop": "pilot_it2_drop_simple_box"}
STIMULI = [(scenario, f"{stem}_{i:04d}") for scenario, stem in STEMS.items() for i in range(20)]
LABELS = {name: i % 2 == 0 for i, (_, name) in enumerate(STIMULI)}


def humans() -> pd.DataFrame:
    share = np.random.default_rng(0).integers(5, 20, len(STIMULI)) / 20
    return pd.DataFrame(
        {
            "stimulus": [name for _, name in STIMULI],
            "scenario": [scenario for scenario, _ in STIMULI],
            "accuracy": share,
            "count": 20.0,
        }
    )


def answers(people: int = 5) -> Responses:
    """Answers at random of ``people`` in each scenario."""
    generator = np.random.default_rng(3)
    rows = [
        {"session": f"{scenario} {k}", "participant": f"{scenario} {k}", "scenario": scenario,
         "stimulus": name, "phase": "test", "trial": int(name[-4:]), "simulated": False,
         "response": "yes" if generator.random() < 0.5 else "no", "label": LABELS[name],
         "rt_ms": 1000 + 100 * generator.random()}
        for scenario, name in STIMULI
        for k in range(people)
    ]  # fmt: skip
    return clean(check_table(pd.DataFrame(rows), TRIAL_COLUMNS, "answers"))


def constant(responses: Responses, session: str) -> Responses:
    """The same, but one session says yes throughout."""
    trials = responses.trials.copy()
    own = trials["session"] == session
    trials.loc[own, "yes"] = True
    trials["correct"] = trials["yes"] == trials["label"]
    return replace(responses, trials=trials)


def write(path: Path, model: str, skill: float, **columns: object) -> Path:
    generator = np.random.default_rng(len(model))
    truth = np.array(list(LABELS.values()))
    right = generator.random(len(truth)) < skill
    p = np.where(right == truth, 0.9, 0.1)
    pd.DataFrame(
        {
            "Model": model,
            "Readout Type": "B",
            "Predicted Prob_true": p,
            "Predicted Outcome": p > 0.5,
            "Actual Outcome": truth,
            "Stimulus Name": list(LABELS),
            **columns,
        }
    ).to_csv(path, index=False)
    return path


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    return [
        write(tmp_path / "good.csv", "good", 0.95, Versions="torch 2.1"),
        write(tmp_path / "poor.csv", "poor", 0.5),
        write(tmp_path / "middle.csv", "middle", 0.75),
    ]


def test_scores_are_those_of_a_comparison(files: list[Path]) -> None:
    board = leaderboard(files, humans(), LABELS, bootstrap=QUICK)
    assert list(board.table.columns) == columns()
    assert list(board.table["model"]) == ["good", "middle", "poor"]
    assert list(board.table["rank"]) == [1, 2, 3]
    for row in board.table.to_dict("records"):
        found = compare_scores(
            read_predictions([Path(row["file"])]), humans(), LABELS, bootstrap=QUICK
        ).scores
        one = found[found["scenario"] == "mean"].iloc[0]
        for score in ("accuracy", "difference", "r", "rmsd"):
            for end in ("", "_low", "_high"):
                assert row[score + end] == one[score + end]
        assert (row["scenarios"], row["stimuli"]) == (2, 40)
        assert np.isnan(row["kappa"]) and "kappa: needs the answers" in row["reason"]


def test_any_column_sorts(files: list[Path]) -> None:
    table = leaderboard(files, humans(), LABELS, bootstrap=QUICK).table
    assert list(sort_leaderboard(table, "model")["model"]) == ["good", "middle", "poor"]
    assert list(sort_leaderboard(table, "model", False)["model"]) == ["poor", "middle", "good"]
    assert sort_leaderboard(table, "rmsd")["rmsd"].is_monotonic_increasing
    assert sort_leaderboard(table, "r")["r"].is_monotonic_decreasing
    assert sort_leaderboard(table, "r", True)["r"].is_monotonic_increasing
    for column in columns()[1:]:
        assert list(sort_leaderboard(table, column)["rank"]) == [1, 2, 3]
    with pytest.raises(UnknownNameError, match="accuracy"):
        sort_leaderboard(table, "acuracy")


def test_undefined_scores_come_last(files: list[Path], tmp_path: Path) -> None:
    flat = write(tmp_path / "flat.csv", "flat", 0.5, **{"Predicted Prob_true": 0.5})
    table = leaderboard([flat, *files], humans(), LABELS, bootstrap=QUICK).table
    for ascending in (True, False):
        last = sort_leaderboard(table, "r", ascending).iloc[-1]
        assert last["model"] == "flat" and np.isnan(last["r"]) and "r: undefined" in last["reason"]


def test_ties_do_not_depend_on_the_order_of_files(tmp_path: Path) -> None:
    files = [write(tmp_path / f"{name}.csv", "same", 0.7) for name in "abc"]
    boards = [leaderboard(order, humans(), LABELS, bootstrap=QUICK).table
              for order in (files, files[::-1])]  # fmt: skip
    pd.testing.assert_frame_equal(*boards)


def test_versions_come_from_the_column_or_from_a_file_beside(
    files: list[Path], tmp_path: Path
) -> None:
    (tmp_path / "poor.json").write_text(json.dumps({"versions": {"physion": "1", "torch": "2"}}))
    (tmp_path / "middle.csv.json").write_text(json.dumps({"versions": "by hand"}))
    (tmp_path / "good.json").write_text(json.dumps({"versions": "not this"}))
    table = leaderboard(files, humans(), LABELS, bootstrap=QUICK).table.set_index("model")
    assert dict(table["versions"]) == {
        "good": "torch 2.1", "poor": "physion 1, torch 2", "middle": "by hand",
    }  # fmt: skip


@pytest.mark.parametrize("content", ["{", '["a"]', '{"versions": 3}'])
def test_a_broken_file_of_versions_refuses_the_file(
    files: list[Path], tmp_path: Path, content: str
) -> None:
    (tmp_path / "poor.json").write_text(content)
    with pytest.raises(BadInputError, match=r"poor\.json"):
        read_sidecar(files[1])
    board = leaderboard(files, humans(), LABELS, bootstrap=QUICK)
    assert len(board.table) == 2 and "poor.json" in board.refused["reason"].item()


def test_bad_files_are_refused_and_named(files: list[Path], tmp_path: Path) -> None:
    alien = write(
        tmp_path / "alien.csv", "alien", 0.5, **{"Stimulus Name": [f"x{i}" for i in range(40)]}
    )
    broken = tmp_path / "broken.csv"
    broken.write_text("Model\nm\n")
    board = leaderboard([alien, files[0], broken], humans(), LABELS, bootstrap=QUICK)
    assert [Path(name).name for name in board.refused["file"]] == ["alien.csv", "broken.csv"]
    assert board.refused["reason"].str.len().gt(0).all()
    assert list(board.table["model"]) == ["good"]
    with pytest.raises(BadInputError, match="no file can be compared"):
        leaderboard([alien, broken], humans(), LABELS, bootstrap=QUICK)
    with pytest.raises(BadInputError, match="no file of predictions"):
        leaderboard([], humans(), LABELS)


def test_what_is_left_out_is_counted(files: list[Path]) -> None:
    board = leaderboard(
        files[:1], humans().iloc[:30], LABELS, exclude=[STIMULI[0][1]], bootstrap=QUICK
    )
    counts = board.dropped.groupby("reason")["stimuli"].sum()
    assert counts["people did not see it"] == 10
    assert counts.drop("people did not see it").sum() >= 1
    assert board.table["stimuli"].item() == 29


def test_files_about_different_outcomes_stand_in_one_table(
    files: list[Path], tmp_path: Path
) -> None:
    other = write(tmp_path / "other.csv", "other", 0.7, **{"Actual Outcome": True})
    assert len(leaderboard([*files, other], humans(), LABELS, bootstrap=QUICK).table) == 4


def test_without_people_there_is_accuracy_alone(files: list[Path]) -> None:
    table = leaderboard(files, bootstrap=QUICK).table
    assert table["accuracy"].notna().all() and table["accuracy_low"].notna().all()
    assert table[["r", "rmsd", "kappa", "difference"]].isna().all(axis=None)


def test_one_scenario_can_be_asked_for(files: list[Path]) -> None:
    table = leaderboard(files, humans(), LABELS, scenario="drop", bootstrap=QUICK).table
    assert set(table["stimuli"]) == {20} and set(table["scenarios"]) == {1}
    with pytest.raises(UnknownNameError, match="drop"):
        leaderboard(files, humans(), LABELS, scenario="drp")
    with pytest.raises(BadInputError, match="link"):
        leaderboard(files, humans(), LABELS, scenario="link", bootstrap=QUICK)


def test_kappa_is_the_mean_over_participants_then_scenarios(files: list[Path]) -> None:
    responses = answers()
    test = responses.test
    table = leaderboard(files, None, None, responses, bootstrap=QUICK).table.set_index("model")
    rows = read_predictions([files[0]]).set_index("stimulus")["predicted"]
    by_scenario = [
        np.mean([cohen_kappa_score(own["yes"], rows.loc[own["stimulus"]].to_numpy())
                 for _, own in part.groupby("session")])
        for _, part in test.groupby("scenario")
    ]  # fmt: skip
    good = table.loc["good"]
    assert good["kappa"] == pytest.approx(np.mean(by_scenario), abs=1e-12)
    assert good["kappa_low"] < good["kappa"] < good["kappa_high"]
    # One stimulus alone differs from the outcome given by "good": without it nothing varies.
    assert "r beyond the outcome: no interval" in good["reason"]
    assert table["reason"].drop("good").eq("").all()
    people = test.groupby("stimulus")["yes"].mean()
    p = read_predictions([files[0]]).set_index("stimulus")["p_contact"]
    r = [np.corrcoef(p.loc[names], people.loc[names])[0, 1]
         for names in ([n for s, n in STIMULI if s == name] for name in STEMS)]  # fmt: skip
    assert good["r"] == pytest.approx(np.mean(r), abs=1e-12)


def test_kappa_says_why_it_is_missing(files: list[Path]) -> None:
    both = answers()
    drop = both.keep_sessions({f"drop {k}" for k in range(5)}, "not asked")
    board = leaderboard(files, humans(), LABELS, drop, bootstrap=QUICK)
    assert board.table["kappa"].isna().all()
    assert board.table["reason"].str.contains("single participants").all()
    pooled = leaderboard(files, humans(), LABELS, both, scenario="pooled", bootstrap=QUICK).table
    assert pooled["kappa"].isna().all() and pooled["reason"].str.contains("pooled").all()


def test_trainings_of_one_file_are_rows_of_their_own(tmp_path: Path) -> None:
    path = write(tmp_path / "both.csv", "m", 0.8)
    rows = pd.read_csv(path)
    pd.concat(
        [rows.assign(**{"Dynamics Training Dataset": name}) for name in ("all", "all_but")]
    ).to_csv(path, index=False)
    table = leaderboard([path], humans(), LABELS, bootstrap=QUICK).table
    assert set(table["training"]) == {"all", "all but this"} and len(table) == 2


def cut(path: Path, model: str, keep: list[str]) -> Path:
    """A submission that is always right, about some of the stimuli alone."""
    rows = pd.read_csv(write(path, model, 1.0))
    rows[rows["Stimulus Name"].isin(keep)].to_csv(path, index=False)
    return path


@pytest.mark.parametrize("with_people", [True, False])
def test_a_partial_submission_ranks_after_the_whole_ones(
    files: list[Path], tmp_path: Path, with_people: bool
) -> None:
    names = list(LABELS)
    partial = cut(tmp_path / "partial.csv", "partial", names[20:])
    few = cut(tmp_path / "few.csv", "few", names[:4] + names[20:24])
    given = (humans(), LABELS) if with_people else ()
    table = leaderboard([partial, few, *files], *given, bootstrap=QUICK).table
    assert list(table["model"])[:3] == ["good", "middle", "poor"]
    last = table.set_index("model").loc[["few", "partial"]]
    assert (last["accuracy"] == 1).all() and (last["rank"] > 3).all()
    assert last.loc["partial", "reason"].startswith("mean over 1 of 2 scenarios")
    assert last.loc["few", "reason"].startswith("over 8 of 40 stimuli")
    for ascending in (True, False):
        order = list(sort_leaderboard(table, "accuracy", ascending)["model"])
        assert set(order[3:]) == {"few", "partial"}
    assert sort_leaderboard(table, "stimuli", True)["model"].iloc[0] == "few"
    drop = leaderboard([partial, *files], *given, scenario="drop", bootstrap=QUICK).table
    assert drop["model"].iloc[0] == "partial" and "over" not in drop["reason"].iloc[0]


def test_flagged_sessions_do_not_count(files: list[Path]) -> None:
    broken = constant(answers(), "drop 1")
    rest = answers().keep_sessions(set(broken.sessions["session"]) - {"drop 1"}, "not asked")
    board = leaderboard(files, None, None, broken, bootstrap=QUICK)
    same = leaderboard(files, None, None, rest, bootstrap=QUICK)
    pd.testing.assert_frame_equal(board.table, same.table)
    assert board.dropped_answers is not None
    assert list(board.dropped_answers["reason"]) == ["session is flagged"]
    assert "1 of 10 sessions" in board.settings["Exclusions"]
    assert "preregistered" in board.settings["Exclusions"]
    lenient = ExclusionRules("none", streak_percentile=None, alternation=None, accuracy_sd=None,
                             rt_sd=None)  # fmt: skip
    everybody = leaderboard(files, None, None, broken, rules=lenient, bootstrap=QUICK)
    assert not np.allclose(everybody.table["kappa"], board.table["kappa"])
    assert "“none”" in everybody.settings["Exclusions"]


def test_outcomes_of_responses_must_be_those_of_the_labels(files: list[Path]) -> None:
    other = {**LABELS, STIMULI[0][1]: not LABELS[STIMULI[0][1]]}
    with pytest.raises(BadInputError, match=STIMULI[0][1]):
        leaderboard(files, None, other, answers(), bootstrap=QUICK)


def test_a_session_that_lacks_expected_trials_is_flagged(files: list[Path]) -> None:
    drop = {name for scenario, name in STIMULI if scenario == "drop"}
    asked = {
        "collide": frozenset(LABELS) - drop,
        "drop 1": frozenset({*drop, "pilot_it2_drop_simple_box_0020"}),
    }
    board = leaderboard(files, None, None, answers(), expected=asked, bootstrap=QUICK)
    assert "1 of 10 sessions" in board.settings["Exclusions"]


# --- ranks, groups, filters ---------------------------------------------------------------------


def test_models_that_see_the_whole_movie_have_no_rank(files: list[Path], tmp_path: Path) -> None:
    seen = write(tmp_path / "seen.csv", "seen", 1.0, **{"Readout Type": "A"})
    table = leaderboard([*files, seen], humans(), LABELS, bootstrap=QUICK).table
    assert list(table["model"]) == ["good", "middle", "poor", "seen"]
    assert list(table["kind"]) == ["model"] * 3 + ["detection"]
    assert list(table["rank"][:3]) == [1, 2, 3] and table["rank"].isna().iloc[3]
    assert table["first"].isna().iloc[3]


def test_equal_scores_have_the_same_rank(files: list[Path], tmp_path: Path) -> None:
    again = write(tmp_path / "good2.csv", "good", 0.95)
    table = leaderboard([*files, again], humans(), LABELS, bootstrap=QUICK).table
    assert list(table["model"]) == ["good", "good", "middle", "poor"]
    assert list(table["rank"]) == [1, 1, 3, 4]
    assert table["first"].iloc[0] == table["first"].iloc[1]


@pytest.mark.parametrize("by", ["accuracy", "rmsd", "r"])
def test_ranks_have_intervals_over_draws_of_stimuli(files: list[Path], by: str) -> None:
    near = write(files[0].parent / "rival.csv", "rival", 0.9)
    table = leaderboard([*files, near], humans(), LABELS, by=by, bootstrap=QUICK).table
    assert table["rank"].between(table["rank_low"], table["rank_high"]).all()
    assert table["first"].sum() >= 1 and table["rank_high"].max() <= 4
    draws = QUICK
    if by == "accuracy":  # by hand: accuracy by draw, mean of scenarios
        right = {
            row["model"]: read_predictions([Path(row["file"])]).set_index("stimulus")
            for row in table.to_dict("records")
        }
        scores = []
        for rows in right.values():
            correct = rows["predicted"] == rows["actual"]
            parts = []
            for scenario in STEMS:
                names = sorted(name for own, name in STIMULI if own == scenario)
                weights = draws.weights(scenario, len(names))
                parts.append(weights @ correct.loc[names].to_numpy(float) / len(names))
            scores.append(np.mean(parts, axis=0))
        best = np.max(scores, axis=0)
        expected = [float(np.mean(one >= best - 1e-12)) for one in scores]
        assert list(table["first"]) == pytest.approx(expected)


def test_ranks_draw_people_where_they_are_known(files: list[Path]) -> None:
    people = answers()
    board = leaderboard(files, None, None, people, by="kappa", bootstrap=QUICK)
    assert board.table["rank_low"].notna().all() and list(board.table["rank"]) == [1, 2, 3]
    pooled = leaderboard(files, None, None, people, by="r", scenario="pooled", bootstrap=QUICK)
    assert pooled.table["rank_low"].notna().all()
    averages = leaderboard(files, humans(), LABELS, by="kappa", bootstrap=QUICK).table
    assert averages["rank_low"].isna().all()


def test_scores_are_given_relative_to_what_can_be_reached(files: list[Path]) -> None:
    board = leaderboard(files, humans(), LABELS, bootstrap=QUICK)
    people = board.anchors[board.anchors["kind"] == "people"].iloc[0]
    assert people["agent"] == "one person with another" and board.anchors.index[0] == people.name
    table = board.table
    assert table["r_of_ceiling"].tolist() == pytest.approx((table["r"] / table["ceiling"]).tolist())
    expected = table["kappa_from_averages"] / people["kappa_from_averages"]
    assert table["kappa_of_people"].tolist() == pytest.approx(expected.tolist())
    rows = board.by_scenario
    assert set(rows["scenario"]) == {"collide", "drop"} and rows["r"].notna().any()
    good = rows[rows["agent"].str.startswith("good")]
    assert good["accuracy"].mean() == pytest.approx(table["accuracy"].iloc[0])


def test_filters_choose_models_before_they_are_ranked(files: list[Path], tmp_path: Path) -> None:
    other = write(tmp_path / "full.csv", "good too", 0.9, **{"Readout Type": "A"})
    given = ([*files, other], humans(), LABELS)
    one = leaderboard(*given, filters=Filters(models=("GOOD",)), bootstrap=QUICK).table
    assert list(one["model"]) == ["good", "good too"]
    full = leaderboard(*given, filters=Filters(readouts=("Full",)), bootstrap=QUICK).table
    assert list(full["model"]) == ["good too"]
    with pytest.raises(BadInputError, match="no model passes"):
        leaderboard(*given, filters=Filters(trainings=("none",)), bootstrap=QUICK)
    partial = cut(tmp_path / "partial.csv", "partial", list(LABELS)[:20])
    every = leaderboard([*files, partial], humans(), LABELS, complete=True, bootstrap=QUICK).table
    assert "partial" not in set(every["model"])


def test_files_are_named_by_digest_and_licence(files: list[Path], tmp_path: Path) -> None:
    (tmp_path / "poor.json").write_text(json.dumps({"license": "CC-BY-4.0"}))
    table = leaderboard(files, humans(), LABELS, bootstrap=QUICK).table.set_index("model")
    assert table.loc["poor", "license"] == "CC-BY-4.0" and table.loc["good", "license"] == ""
    assert table.loc["poor", "sha256"] == hashlib.sha256(files[1].read_bytes()).hexdigest()


def test_the_page_shows_ranks_groups_and_digests(files: list[Path], tmp_path: Path) -> None:
    seen = write(tmp_path / "seen.csv", "<seen>", 1.0, **{"Readout Type": "A"})
    board = leaderboard([*files, seen], humans(), LABELS, bootstrap=QUICK)
    page = leaderboard_page(board)
    assert "&lt;seen&gt;" in page and "<seen>" not in page
    for words in ("not ranked", "one person with another", "drop", "r of its ceiling", "SHA-256"):
        assert words in page
    assert board.table["sha256"].iloc[0][:12] in page
    bare = leaderboard_page(leaderboard(files, bootstrap=QUICK))
    assert "Models that predict" in bare
