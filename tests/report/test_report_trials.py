"""Trials as movies: which are shown, within how many bytes, and the page of each stimulus."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from physion.analysis.comparison import Comparison
from physion.report.compare import compare
from physion.report.html import PageMovies, make_poster
from physion.report.inputs import ReportInputs
from physion.report.page import DISAGREE, OPENING, render_page
from physion.report.scores import inputs_sentence, weights_sentence
from physion.report.trials import (
    MOST_ANSWERS,
    OPENING_RULE,
    WIDE,
    answers,
    card,
    opening_trials,
    outcome,
    pick_readouts,
    widest_gaps,
)
from physion.trials.video import encode_movie

Maker = Callable[..., Comparison]
PREFIX = "data:video/mp4;base64,"


def video_file(path: Path, frames: int = 60) -> Path:
    """Write a movie whose pictures are as bright as their index, and a still larger one."""
    grey = np.arange(frames, dtype=np.uint8)[:, None, None, None]
    path.write_bytes(encode_movie(np.broadcast_to(4 * grey, (frames, 32, 32, 3)).copy()))
    return path


@pytest.fixture
def movie(tmp_path: Path) -> Path:
    return video_file(tmp_path / "movie.mp4")


def with_stimuli(comparison: Comparison, rows: pd.DataFrame) -> Comparison:
    return dataclasses.replace(comparison, stimuli=rows)


def some_rows(**columns: object) -> pd.DataFrame:
    """Return rows of ``comparison.stimuli``: one model on a stimulus each, but for ``columns``."""
    count = max(len(value) for value in columns.values() if isinstance(value, list))
    rows: dict[str, object] = {
        "model": "m · observed", "base_model": "m", "readout": "observed", "scenario": "drop",
        "stimulus": [f"s{k}" for k in range(count)], "p_contact": 0.9, "predicted": True,
        "label": True, "human_accuracy": 0.9, "count": 20.0,
    } | columns  # fmt: skip
    table = pd.DataFrame(rows)
    table["simulated"] = columns.get("simulated", table["label"])
    right = table["human_accuracy"]
    table["p_yes"] = right.where(table["label"].astype(bool), 1 - right)
    table["gap"] = table["p_contact"] - table["p_yes"]
    return table


# --- which trials ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_opening_trial_is_clear_to_people_and_missed_by_models(make_comparison: Maker) -> None:
    def chosen(**columns: object) -> list[str]:
        return opening_trials(with_stimuli(make_comparison(), some_rows(**columns)))

    assert chosen(human_accuracy=[0.7, 0.92, 0.8]) == ["s1"], "most people are right"
    # 0.96 and 0.99 count as equal; the models miss the first one.
    assert chosen(human_accuracy=[0.96, 0.99, 0.8], p_contact=[0.1, 0.9, 0.0]) == ["s0"]
    assert chosen(human_accuracy=[0.9, 0.9, 0.9]) == ["s0"], "by name"
    # The first scenario shows contact, if people are right about one.
    assert chosen(human_accuracy=[0.9, 0.6], label=[False, True]) == ["s1"]
    assert chosen(human_accuracy=[0.9, 0.4], label=[False, True]) == ["s0"]
    assert chosen(human_accuracy=[0.9, 0.6], simulated=[False, True]) == ["s1"], "as in the study"
    assert chosen(human_accuracy=[np.nan, np.nan], p_contact=[0.9, 0.4]) == ["s1"], "no people"


def test_scenarios_alternate_between_contact_and_none(make_comparison: Maker) -> None:
    names = ["drop", "support", "dominoes", "dominoes", "support", "drop"]
    rows = some_rows(scenario=names, label=[True, True, False, True, False, False])
    assert opening_trials(with_stimuli(make_comparison(), rows)) == ["s3", "s4", "s0"]


def test_the_opening_prefers_trials_with_a_movie_and_all_models(make_comparison: Maker) -> None:
    comparison = make_comparison()
    named = set(comparison.stimuli["stimulus"].iloc[[3, 20]])
    assert set(opening_trials(comparison, named)) == named
    rows = some_rows(human_accuracy=[0.99, 0.8], model=["a", "a"])
    more = pd.concat([rows, rows.iloc[1:].assign(model="b")])
    assert opening_trials(with_stimuli(comparison, more)) == ["s1"]


def test_the_order_of_the_rows_does_not_matter(make_comparison: Maker) -> None:
    comparison = make_comparison()
    mixed = with_stimuli(comparison, comparison.stimuli.sample(frac=1, random_state=3))
    assert opening_trials(mixed) == opening_trials(comparison)


def test_widest_gaps_take_turns_and_pass_over_changed_trials(make_comparison: Maker) -> None:
    comparison = make_comparison()
    chosen = widest_gaps(comparison, 4)
    assert list(chosen["model"]) == comparison.names * 2
    assert chosen["stimulus"].is_unique
    assert not set(chosen["stimulus"]) & set(comparison.changed["stimulus"])
    same = comparison.stimuli[comparison.stimuli["label"] == comparison.stimuli["simulated"]]
    own = same[same["model"] == comparison.names[0]]
    assert chosen["size"].iloc[0] == own["gap"].abs().max()
    wide = same[same["gap"].abs() >= WIDE]["stimulus"].nunique()
    assert 4 < wide < 23 and len(widest_gaps(comparison, 1000)) == wide
    assert widest_gaps(comparison, 0).empty


def test_a_model_has_one_turn_and_none_without_an_opinion(make_comparison: Maker) -> None:
    p = [0.0, 0.0, 0.1, 0.3, 0.0, 0.05, 0.0, 0.0]
    rows = some_rows(
        stimulus=["a", "b", "a", "b", "a", "b", "a", "b"],
        model=["m1", "m1", "m2", "m2", "told", "told", "flat", "flat"],
        base_model=["m", "m", "m", "m", "told", "told", "flat", "flat"],
        readout=[
            name for name in ("observed", "observed+simulated", "full", "observed") for _ in "ab"
        ],
        p_contact=p,
    )
    rows.loc[1, "p_contact"] = 0.01
    chosen = widest_gaps(with_stimuli(make_comparison(), rows), 8)
    assert list(chosen["model"]) == ["m1", "m1"] and list(chosen["stimulus"]) == ["a", "b"]


# --- cards ----------------------------------------------------------------------------------------


def test_a_card_says_what_happened_and_what_all_said() -> None:
    rows = some_rows(stimulus=["s", "s"], model=["a", "b"], base_model=["a", "b"],
                     p_contact=[0.25, 0.75], predicted=[False, True])  # fmt: skip
    html = card(rows, "", {"s": "trials/s.html"}, named="a")
    assert '<span class="outcome contact">contact</span>' in html
    assert "people say yes</span><b>90 % <small>of 20</small></b>" in html
    assert html.count('aria-label="right"') == 2 and html.count('aria-label="wrong"') == 1
    assert '<li class="model named"><span title="a">a</span><b>0.25</b><em class="wrong"' in html
    assert "width:25%" in html and "width:90%" in html and 'href="trials/s.html"' in html
    divided = answers(rows.assign(human_accuracy=0.5, p_yes=0.5))
    assert 'aria-label="divided"' in divided
    assert "people say yes" not in answers(rows.assign(p_yes=np.nan))


def test_a_label_tells_when_the_movie_shows_something_else() -> None:
    label = some_rows(label=[True, True, False], simulated=[True, False, True])
    words = [outcome(row) for _, row in label.iterrows()]
    assert "contact, not in the movie" in words[1] and "no contact, but in the movie" in words[2]
    assert "movie" not in words[0]


def test_cards_show_one_readout_of_a_model_and_open_the_rest() -> None:
    rows = some_rows(
        stimulus=["s"] * 4, model=["a1", "a2", "a3", "told"], base_model=["a", "a", "a", "told"],
        readout=["full", "observed", "observed+simulated", "full"],
    )  # fmt: skip
    assert list(pick_readouts(rows)["model"]) == ["a3"]
    assert list(pick_readouts(rows, named="a2")["model"]) == ["a2"]
    assert list(pick_readouts(rows.iloc[[3]])["model"]) == ["told"]
    mixed = some_rows(stimulus=["s"] * 2, model=["chance", "a"], base_model=["chance", "a"])
    assert list(pick_readouts(mixed)["model"]) == ["a", "chance"]
    names = [f"m{k}" for k in range(MOST_ANSWERS + 2)]
    html = answers(some_rows(stimulus=["s"] * len(names), model=names, base_model=names))
    before, after = html.split("<details>")
    assert before.count("<li") == MOST_ANSWERS + 1 and after.count("<li") == 2
    assert "2 further models" in after


# --- movies ---------------------------------------------------------------------------------------


def test_the_still_is_the_last_observed_picture(tmp_path: Path) -> None:
    for frames, last in ((60, 44), (20, 19)):
        poster = make_poster(video_file(tmp_path / f"{frames}.mp4", frames))
        picture = np.asarray(Image.open(BytesIO(poster)).convert("L"), float)
        assert picture.shape == (32, 32) and abs(picture.mean() - 4 * last) < 4
    other = tmp_path / "other.webm"
    other.write_bytes(b"nothing that can be decoded here")
    assert make_poster(other) == b""
    assert "poster" not in PageMovies({"s": other}, 10_000).show("s", "words")


def test_movies_play_without_sound_and_with_controls(movie: Path) -> None:
    html = PageMovies({"s": movie}, 1_000_000).show("s", 'a "movie"')
    for word in ("autoplay", "controls", "loop", "muted", "playsinline", 'preload="none"'):
        assert word in html
    assert 'aria-label="a &#34;movie&#34;"' in html and 'poster="data:image/jpeg' in html
    data = html.partition(PREFIX)[2].partition('"')[0]
    assert base64.b64decode(data) == movie.read_bytes()


@pytest.mark.nightly
@pytest.mark.slow
def test_movies_stay_within_the_size_of_the_page(make_comparison: Maker, tmp_path: Path) -> None:
    large = tmp_path / "large.mp4"
    noise = np.random.default_rng(0).integers(0, 255, (46, 64, 64, 3), np.uint8)
    large.write_bytes(encode_movie(noise))
    comparison = make_comparison()
    movies = dict.fromkeys(comparison.stimuli["stimulus"], large)
    for room in (1_000_000, 150_000):
        page = render_page(ReportInputs(comparison, movies=movies, page_bytes=room), [])
        assert len(page.encode()) < room
        assert page.count("the page would grow too large") == 10 - page.count("<video") >= 1
        assert page.count('<div class="still">') >= 1
    assert render_page(ReportInputs(comparison, movies=movies), []).count("<video") == 10


@pytest.mark.slow
def test_the_page_opens_with_the_trials(make_comparison: Maker, movie: Path) -> None:
    comparison = make_comparison()
    movies = dict.fromkeys(comparison.stimuli["stimulus"], movie)
    asked = "Will red touch yellow?"
    page = render_page(ReportInputs(comparison, movies=movies, question=asked), [])
    places = [page.index(f"<h2>{title}</h2>") for title in (OPENING, "Scores", DISAGREE)]
    assert places == sorted(places) and asked in page and OPENING_RULE[:40] in page
    opening = page[places[0] : places[1]]
    assert opening.count("<video") == 2 and page[places[2] :].count("<video") == 8
    alone = render_page(ReportInputs(make_comparison(with_people=False)), [])
    assert DISAGREE not in alone and "<video" not in alone and "no movie given" not in alone
    some = render_page(ReportInputs(comparison, movies=dict([movies.popitem()])), [])
    assert "no movie given" in some and some.count("<video") >= 1


# --- what models were given -----------------------------------------------------------------------


def test_one_sentence_says_what_each_model_was_given(
    make_comparison: Maker, tmp_path: Path
) -> None:
    head = "stimulus,p_contact,model"
    (tmp_path / "a.csv").write_text(f"{head},inputs\ns,0.5,simulation,state\n")
    (tmp_path / "b.csv").write_text(f'{head},Inputs\ns,0.5,encoder,"rgb, depth"\n')
    (tmp_path / "c.csv").write_text(f"{head}\nt,0.5,encoder\n")
    files = [tmp_path / name for name in ("a.csv", "b.csv", "c.csv")]
    people = pd.DataFrame(
        {"stimulus": ["s", "t"], "scenario": "drop", "accuracy": 0.6, "count": 9.0}
    )
    given = compare(files, humans=people, labels={"s": True, "t": False}).inputs.model_inputs
    assert given == {"simulation": "state", "encoder": "rgb, depth"}
    comparison = make_comparison()
    words = inputs_sentence(ReportInputs(comparison, model_inputs=given))
    assert words.startswith("People saw the movie.")
    assert "simulation: the true state of the scene" in words
    assert "encoder: the pixels of the movie and the distance of every pixel." in words
    partly = inputs_sentence(ReportInputs(comparison, model_inputs={"encoder": "rgb"}))
    assert partly.endswith("simulation: not stated.")
    assert inputs_sentence(ReportInputs(comparison)) == ""


@pytest.mark.slow
def test_one_sentence_says_which_weights_each_model_started_from(make_comparison: Maker) -> None:
    found = {"simulation": "none", "encoder": "imagenet"}
    inputs = ReportInputs(make_comparison(), model_weights=found)
    sentence = "Weights that each network started from: encoder: imagenet."
    assert weights_sentence(inputs) == sentence and sentence in render_page(inputs, [])
    assert weights_sentence(ReportInputs(make_comparison())) == ""
    table = inputs.tables()["comparison"].set_index("base_model")["init"]
    assert set(table["encoder"]) == {"imagenet"} and set(table["simulation"]) == {"none"}
    assert set(table.drop(["encoder", "simulation"])) == {""}, "baselines that were computed"
