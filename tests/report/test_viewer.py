"""The viewer's page without a browser: what it holds, what it refuses, that nothing escapes."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.cli import view
from physion.cli.main import main as cli
from physion.core.errors import BadInputError, UnknownNameError
from physion.report.viewer import build as viewer
from physion.report.viewer import facts as viewer_facts
from physion.report.viewer.build import ViewerOptions, build_viewer, choose_trials, embed_json
from physion.report.viewer.imagined import STEPS, pack_grid
from physion.report.viewer.movies import fitted
from physion.trials.dataset import Dataset
from physion.trials.video import read_frames
from support.viewer_dataset import EVIL, FRAMES, PLANS, Plan, make_dataset

SMALL = ViewerOptions(card_size=32, pass_size=32, stride=6)


class Page(HTMLParser):
    """The blocks of a page by name, and its other elements."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.raw = path.read_text(encoding="utf-8")
        self.blocks: dict[str, str] = {}
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self._in: str | None = None
        self.feed(self.raw)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag in ("script", "style", "title"):
            self._in = str(dict(attrs).get("id") or tag)
            self.blocks[self._in] = ""

    def handle_endtag(self, tag: str) -> None:
        self._in = None

    def handle_data(self, data: str) -> None:
        if self._in:
            self.blocks[self._in] += data

    def json(self, name: str) -> Any:
        return json.loads(self.blocks[name])


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_dataset(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture(scope="module")
def page(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Page:
    out = tmp_path_factory.mktemp("page") / "view.html"
    report = build_viewer(dataset, out, SMALL)
    assert (report.page, report.size, report.shown, report.left_out) == (
        *(out, out.stat().st_size, 4, 0),
    )
    return Page(out)


# --- the whole page ------------------------------------------------------------------------------


def test_page_holds_every_trial_with_its_label(page: Page) -> None:
    cards = {card["trial"]: card for card in page.json("cards")}
    assert list(cards) == ["drape_0", "drop_0", "drop_1", "drop_2"]
    assert [cards[n]["contact"] for n in cards] == [True, True, False, True]
    assert [cards[n]["firstContact"] for n in cards] == [55, 50, None, 20]
    assert [cards[n]["observed"] for n in cards] == [False, False, False, True]
    assert [cards[n]["robust"] for n in cards] == [1.0, 1.0, 0.5, None]
    assert page.json("totals") == {"drop": 3, "drape": 1}
    assert page.json("detail-3")["runs"] == [[20, 21], [30, 30]]
    assert page.json("detail-0")["runs"] == [[55, 55]]
    assert page.blocks["title"] == "by-hand"


def test_movies_match_the_trials(page: Page, tmp_path: Path) -> None:
    movie = page.json("movie-1")
    assert (movie["width"], movie["height"], movie["stride"], movie["rate"]) == (32, 32, 1, 30)
    path = tmp_path / "m.mp4"
    path.write_bytes(base64.b64decode(movie["data"]))
    grey = read_frames(path).mean(axis=(1, 2, 3))
    assert np.abs(grey - (np.arange(FRAMES) * 3 + 40)).max() < 4


def test_passes_lie_side_by_side(page: Page, tmp_path: Path) -> None:
    strip = page.json("detail-1")["passes"]
    assert strip["tiles"] == ["color", "depth", "normals", "ids", "flow"]
    path = tmp_path / "m.mp4"
    path.write_bytes(base64.b64decode(strip["data"]))
    frames = read_frames(path)
    assert frames.shape == (FRAMES // 6, 32, 5 * 32, 3)
    assert strip["rate"] * strip["stride"] == 30
    ids = frames[0, :, 96:128].astype(int)
    red = (ids[..., 0] > 150) & (ids[..., 1] < 90)
    yellow = (ids[..., 0] > 170) & (ids[..., 1] > 140) & (ids[..., 2] < 110)
    assert red.sum() > 5 and yellow.sum() > 20
    # The ball comes down, and with it the red of the ids.
    last = frames[-1, :, 96:128].astype(int)
    later = (last[..., 0] > 150) & (last[..., 1] < 90)
    assert np.nonzero(later)[0].mean() > np.nonzero(red)[0].mean() + 2


def test_trials_without_movies_are_rendered(tmp_path: Path) -> None:
    folder = make_dataset(tmp_path / "set", (Plan("state", movies=False),))
    build_viewer(folder, tmp_path / "v.html", dataclasses.replace(SMALL, details=0))
    path = tmp_path / "m.mp4"
    path.write_bytes(base64.b64decode(Page(tmp_path / "v.html").json("movie-0")["data"]))
    frames = read_frames(path)
    assert frames.shape == (FRAMES, 32, 32, 3) and frames.std() > 10


def test_same_trials_same_bytes_in_any_folder(dataset: Path, page: Page, tmp_path: Path) -> None:
    other = make_dataset(tmp_path / "elsewhere")
    build_viewer(other, tmp_path / "v.html", SMALL)
    assert (tmp_path / "v.html").read_text(encoding="utf-8") == page.raw


def test_policy_allows_its_own_script_and_style_and_no_network(page: Page) -> None:
    policy = next(a["content"] for t, a in page.tags if t == "meta" and "http-equiv" in a)
    assert policy is not None
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    for name, kind in (("script-src", "script"), ("style-src", "style")):
        parts = re.findall(rf"<{kind}>(.*?)</{kind}>", page.raw, flags=re.S)
        digests = [base64.b64encode(hashlib.sha256(p.encode()).digest()).decode() for p in parts]
        assert rules.pop(name).split() == [f"'sha256-{digest}'" for digest in digests]
    assert rules.pop("media-src") == "blob:"
    assert set(rules.values()) == {"'none'"} and "default-src" in rules
    own = re.sub(r"<script>var Three.*?</script>", "", page.raw, flags=re.S)
    assert len(own) < len(page.raw) - 500_000
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)|@import|url\(|<link", own)
    names = ("src", "href", "srcset", "poster", "data", "action", "style")
    assert not [name for _, a in page.tags for name in names if name in a]
    assert not [name for _, a in page.tags for name in a if name.startswith("on")]


def test_foreign_text_cannot_leave_its_block(tmp_path: Path) -> None:
    folder = make_dataset(tmp_path / "set", (Plan("evil", foreign=EVIL),))
    build_viewer(folder, tmp_path / "v.html", SMALL)
    page = Page(tmp_path / "v.html")
    assert "img" not in {tag for tag, _ in page.tags}
    assert [a.get("id") for t, a in page.tags if t == "script"] == [
        *("cards", "totals", "unusable", "movie-0", "detail-0"),
        *(None, None),
    ]
    assert page.blocks["title"] == "by-hand" + EVIL
    detail = page.json("detail-0")
    tables = {table["title"]: table["rows"] for table in detail["tables"]}
    assert tables["Bodies"][0][0] == "ball" + EVIL
    assert {("nested.evil", EVIL), (EVIL, "1")} <= {
        tuple(row) for row in tables["Parameters of the scenario"]
    }
    assert detail["legend"][0]["name"] == "ball" + EVIL


def test_embedded_json_has_no_markup_and_no_numbers_that_are_none() -> None:
    text = embed_json({EVIL: ["<!--", "<script>"]})
    assert not set("<>&") & set(text)
    assert json.loads(text) == {EVIL: ["<!--", "<script>"]}
    with pytest.raises(BadInputError, match="number that is none"):
        embed_json([float("nan")])


# --- which trials --------------------------------------------------------------------------------


def _index(rows: list[tuple[str, str]]) -> pd.DataFrame:
    table = pd.DataFrame(rows, columns=["scenario", "split"])
    return table.assign(trial=[f"t{i:02d}" for i in range(len(rows))])


def test_splits_take_turns_and_the_rest_is_counted() -> None:
    index = _index([("drop", "testing")] * 5 + [("drop", "training")] * 2 + [("roll", "testing")])
    chosen, totals = choose_trials(index, ViewerOptions(trials=4, details=1))
    assert totals == {"drop": 7, "roll": 1}
    assert chosen["trial"].tolist() == ["t00", "t01", "t05", "t06", "t07"]
    assert chosen["detailed"].tolist() == [True, False, False, False, True]


def test_one_scenario_or_split_can_be_asked_for() -> None:
    index = _index([("drop", "testing")] * 2 + [("drop", "training"), ("roll", "training")])
    chosen, totals = choose_trials(index, ViewerOptions(scenario="drop", split="training"))
    assert chosen["trial"].tolist() == ["t02"] and totals == {"drop": 1}
    with pytest.raises(UnknownNameError, match="roll"):
        choose_trials(index, ViewerOptions(scenario="rol"))
    with pytest.raises(UnknownNameError, match="closest: testing"):
        choose_trials(index, ViewerOptions(split="testin"))


def test_details_only_where_asked(dataset: Path, tmp_path: Path) -> None:
    options = dataclasses.replace(SMALL, trials=1, details=0, scenario="drop")
    report = build_viewer(dataset, tmp_path / "v.html", options)
    assert (report.shown, report.left_out) == (1, 2)
    page = Page(tmp_path / "v.html")
    assert not {"passes", "gltf"} & page.json("detail-0").keys()
    assert page.raw.count("<script>") == 1, "no library where nothing is in 3D"


@pytest.mark.parametrize(
    "wrong", [{"trials": 0}, {"details": -1}, {"stride": 0}, {"card_size": 8}, {"pass_size": 5000}]
)
def test_impossible_options_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(BadInputError, match=next(iter(wrong))):
        ViewerOptions(**wrong)  # type: ignore[arg-type]


def test_bad_places_and_broken_trials_leave_no_page(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="is a folder"):
        build_viewer(dataset, tmp_path)
    with pytest.raises(BadInputError, match="does not exist"):
        build_viewer(dataset, tmp_path / "none" / "v.html")
    with pytest.raises(BadInputError, match="no index"):
        build_viewer(tmp_path, tmp_path / "v.html")
    broken = make_dataset(tmp_path / "set", PLANS[:1])
    path = broken / "testing" / "drop" / "drop_0.h5"
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)
    with pytest.raises(BadInputError, match=r"drop_0\.h5 was changed since it was made"):
        build_viewer(broken, tmp_path / "v.html", SMALL)
    with pytest.raises(BadInputError, match=r"drop_0\.h5 is damaged"):
        build_viewer(broken, tmp_path / "v.html", SMALL, verify=False)
    assert not (tmp_path / "v.html").exists()


def test_movie_of_another_length_is_refused(tmp_path: Path) -> None:
    folder = make_dataset(tmp_path / "set", PLANS[:1])
    stem = folder / "testing" / "drop" / "drop_0"
    Path(f"{stem}_img.mp4").write_bytes(Path(f"{stem}_observed.mp4").read_bytes())
    with pytest.raises(BadInputError, match=r"drop_0_img\.mp4 was changed since it was made"):
        build_viewer(folder, tmp_path / "v.html", SMALL)
    with pytest.raises(BadInputError, match="45 frames, its trial 60"):
        build_viewer(folder, tmp_path / "v.html", SMALL, verify=False)


def test_verb_writes_and_says_where(dataset: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "v.html"
    assert view.main(view.Options(dataset, out, trials=1, details=0)) == 0
    assert re.fullmatch(
        rf"2 trials, 2 left out, \d\.\d MB: {re.escape(str(out))}\n", capsys.readouterr().out
    )
    assert view.main(view.Options(dataset, out, trials=1, details=0, json=True)) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == {"page": str(out), "bytes": out.stat().st_size, "shown": 2, "left_out": 2}


def test_read_only_datasets_say_what_to_do(
    dataset: Path, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything is rendered; root may write everywhere, so the system's answer is faked."""
    monkeypatch.setattr(viewer.os, "access", lambda path, mode: path != dataset)
    monkeypatch.setattr(viewer, "_trial_data", None)
    assert cli(["view", str(dataset)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"physion: cannot write {dataset / 'view.html'}: ") and "--out" in said
    assert said.count("\n") == 1


def test_a_page_that_cannot_be_written_is_named(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path, data: bytes) -> None:
        raise OSError(28, "No space left on device", str(tmp_path / ".1-ab.part"))

    monkeypatch.setattr(viewer, "write_atomic", fail)
    with pytest.raises(BadInputError, match=r"v\.html: No space left on device; .*--out") as caught:
        build_viewer(dataset, tmp_path / "v.html", ViewerOptions(trials=1, details=0))
    assert ".part" not in str(caught.value)


# --- tables --------------------------------------------------------------------------------------


def test_tables_say_what_is_in_the_trial(dataset: Path) -> None:
    trial = Dataset(dataset).trial("drop_0")
    tables = {table["title"]: table for table in viewer_facts.tables(trial)}
    assert list(tables) == [
        *("Bodies", "Pushes", "Trial", "Parameters of the scenario", "Camera, room, ending")
    ]
    ball = dict(zip(tables["Bodies"]["header"], tables["Bodies"]["rows"][0], strict=True))
    assert ball["role"] == "agent" and ball["mass (kg)"] == "1.25"
    assert ball["scale"] == "0.5, 0.5, 0.5" and ball["static friction"] == "0.5"
    assert ball["dynamic friction"] == "0.4" and ball["restitution"] == "0.3"
    assert [row[9] for row in tables["Bodies"]["rows"]] == ["free", "fixed", "scenery"]
    assert tables["Pushes"]["rows"] == [["ball", "3, 4, 0", "5", "centre of mass", "7"]]
    facts = {row[0]: row[1] for row in tables["Trial"]["rows"]}
    assert facts["seconds of physics"] == "0.59" and facts["seconds of playback"] == "2"
    assert facts["seed"] == "ff01" and facts["digest of the motion"] == trial.metadata.digest
    hidden = {tables["Trial"]["rows"][i][0] for i in tables["Trial"]["outcome"]}
    assert {"contact", "first frame of contact", "contact while observed"} <= hidden
    assert tables["Parameters of the scenario"]["rows"][:2] == [*(["height", "1"], ["key", "1"])]


def test_values_as_people_read_them() -> None:
    assert viewer_facts.text(None) == viewer_facts.text(float("nan")) == "–"
    assert viewer_facts.text(True) == "yes" and viewer_facts.text(()) == "none"
    assert viewer_facts.text((0.123456, 2)) == "0.1235, 2" and viewer_facts.text(7) == "7"


def test_search_knows_objects_but_not_outcomes(page: Page) -> None:
    words = next(card for card in page.json("cards") if card["trial"] == "drop_0")["searchText"]
    assert {"drop_0", "ball", "sphere", "prop:vase", "plain", "ff01"} <= set(words.split())
    assert "contact" not in words and words == words.lower()


# --- motion --------------------------------------------------------------------------------------


def _unpack(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def _points(grid: dict[str, Any]) -> np.ndarray:
    steps = _unpack(grid["data"], "<u2").reshape(-1, 3)
    return np.array(grid["low"]) + steps / STEPS * np.array(grid["size"])


def test_points_come_back_to_half_a_step() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) * (1, 10, 0)
    back = _points(pack_grid(points))
    assert (np.abs(back - points) <= np.ptp(points, axis=0) / STEPS * 0.51 + 1e-12).all()
    assert _points(pack_grid(np.zeros((0, 3)))).shape == (0, 3)


def test_paths_and_touch_points_match_the_trial(dataset: Path) -> None:
    trial = Dataset(dataset).trial("drop_0")
    (path,) = (_unpack(text, "<f4") for text in viewer_facts.paths(trial).values())
    centres = trial.trajectory.positions[:, 0] + [0, 0, 0.25]  # the pivot of a sphere is its foot
    np.testing.assert_allclose(path.reshape(FRAMES, 3)[:, :2], centres[:, :2], atol=1e-6)
    np.testing.assert_allclose(np.ptp(path.reshape(FRAMES, 3)[:, 2]), 0.8, atol=1e-5)
    touches = viewer_facts.touches(trial)
    assert touches[0] == pytest.approx([50, 0.1, 0.2, 0.2])
    assert [touch[0] for touch in touches] == list(PLANS[0].touch)
    sheet = Dataset(dataset).trial("drape_0")
    (path,) = (_unpack(text, "<f4") for text in viewer_facts.paths(sheet).values())
    np.testing.assert_allclose(
        path.reshape(FRAMES, 3), sheet.trajectory.cloth_vertices.mean(axis=1), atol=1e-5
    )


def test_the_scene_in_3d_is_a_gltf_file(page: Page) -> None:
    for number, things in ((0, ["plate", "vase", "sheet"]), (1, ["ball", "plate", "vase"])):
        data = base64.b64decode(page.json(f"detail-{number}")["gltf"])
        size = int.from_bytes(data[12:16], "little")
        parts = json.loads(data[20 : 20 + size])
        assert data[:4] == b"glTF" and [n["name"] for n in parts["nodes"]][:3] == things
        assert parts["scenes"][0]["extras"]["trial"] == ("drape_0", "drop_0")[number]


def test_the_library_of_the_3d_view_is_the_one_of_the_lock_with_its_licence(page: Page) -> None:
    folder = Path(viewer.__file__).parent / "vendor"
    (lock,) = json.loads((folder / "vendor.lock.json").read_text())["files"]
    data = (folder / lock["file"]).read_bytes()
    assert hashlib.sha256(data).hexdigest() == lock["sha256"] and len(data) < 1_000_000
    assert "three.js authors" in (folder / lock["license"]).read_text()
    assert data.decode() in page.raw


def test_sizes_are_even_and_keep_the_shape() -> None:
    assert fitted(256, 256, 128) == (128, 128)
    assert fitted(640, 480, 128) == (128, 96)
    assert fitted(1000, 3, 160) == (160, 2)
    assert fitted(64, 32, 128) == (64, 32)


def test_the_verb_marks_trials_and_the_page_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_dataset(tmp_path / "set", (Plan("drop_0"), Plan("drop_1")))
    words = ["view", str(folder), "--details", "0", "--mark"]
    assert cli([*words, "drop_1=a block = flickers"]) == 0
    page = Page(folder / "view.html")
    cards = {card["trial"]: card["unusable"] for card in page.json("cards")}
    assert cards == {"drop_0": "", "drop_1": "a block = flickers"}
    assert page.json("unusable") == {"drop_1": "a block = flickers"}
    capsys.readouterr()
    assert cli([*words, "drop_1"]) == 2
    assert "--mark takes TRIAL=REASON, not 'drop_1'" in capsys.readouterr().err
