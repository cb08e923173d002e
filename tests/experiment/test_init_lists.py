"""Studies from official stimulus lists: names, labels, looks, movies and maps."""

from __future__ import annotations

import csv
import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from physion.cli.main import main
from physion.core.errors import BadInputError
from physion.core.names import OFFICIAL_SCENARIOS, canonical_name
from physion.experiment.study.choose import choose_listed, list_scenario, read_list
from physion.experiment.study.study import load_study
from physion.trials.video import encode_movie, read_frames
from support.experiment.tiny_dataset import make_tiny_dataset
from support.experiment.tiny_study import CONTACT, FULL, OBSERVED, draw, draw_map, read_number

LIST = "human-physics-benchmarking-collision-pilot_production_2_experimental_stims.json"
SIZE = 64


def ids_of(count: int, config: str = "pilot_it2_collision_yeet_box") -> list[str]:
    return [f"{config}_{number:04d}_img" for number in range(count)]


def columns_of(ids: list[str]) -> dict[str, dict[str, Any]]:
    """Write a list as published: one object per column, keyed by row."""
    base = "https://bucket.s3.amazonaws.com"
    columns = {
        "stim_ID": ids,
        "stim_url": [f"{base}/{name}.mp4" for name in ids],
        "map_url": [f"{base}/{name.removesuffix('_img')}_map.png" for name in ids],
        "target_hit_zone_label": [number % 2 == 0 for number in range(len(ids))],
    }
    return {name: {str(i): v for i, v in enumerate(values)} for name, values in columns.items()}


def write_list(path: Path, ids: list[str]) -> Path:
    path.write_text(json.dumps(columns_of(ids)))
    return path


def write_media(folder: Path, ids: list[str], maps: Path | None = None) -> None:
    for place in (folder, maps or folder):
        place.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(ids):
        (folder / f"{name}.mp4").write_bytes(encode_movie(draw(number, number % 2 == 0, SIZE)))
        picture = (maps or folder) / f"{name.removesuffix('_img')}_map.png"
        picture.write_bytes(draw_map(number, SIZE))


def make_listed(
    folder: Path, stimuli: Path, familiarization: Path | None, *more: str, code: int = 0
) -> Path:
    """Make a study of two lists with the movies in ``folder``; return its folder."""
    words = ["--stimuli", str(stimuli), "--movies", str(folder / "movies"), *more]
    if familiarization is not None:
        words += ["--familiarization", str(familiarization)]
    assert main(["experiment", "init", *CONTACT, str(folder / "study"), *words]) == code
    assert (folder / "study").exists() == (code == 0)
    return folder / "study"


def test_the_command_makes_a_study_of_lists(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ids, practice = ids_of(6), ids_of(4, "pilot_it2_collision_simple_box")
    stimuli = write_list(tmp_path / LIST, ids)
    fam = write_list(tmp_path / "collision_familiarization.json", practice)
    write_media(tmp_path / "movies" / "mp4s", ids + practice, tmp_path / "movies" / "maps")
    study = load_study(make_listed(tmp_path, stimuli, fam, "--json"))
    assert json.loads(capsys.readouterr().out)["notes"] == []
    assert study.scenarios == ("collide",)
    assert [s.stimulus for s in study.phase("collide", "test")] == [n[:-4] for n in ids]
    # Those to practise on keep the order of their list.
    assert [s.stimulus for s in study.phase("collide", "familiarization")] == [
        name[:-4] for name in practice
    ]
    for stimulus in study.stimuli:
        number = int(stimulus.stimulus[-4:])
        assert stimulus.label == (number % 2 == 0) and stimulus.look == "free"
        numbers = [read_number(f) for f in read_frames(study.folder / stimulus.movie)]
        assert numbers == list(range(OBSERVED))
    assert {s.full_frames for s in study.phase("collide", "familiarization")} == {FULL}


def test_familiarization_may_come_from_a_dataset(tmp_path: Path) -> None:
    ids = ids_of(4)
    stimuli = write_list(tmp_path / LIST, ids)
    write_media(tmp_path / "movies", ids)
    make_tiny_dataset(tmp_path / "dataset", test=0, familiarization=4)
    words = ["--practice", "4", "--familiarization-trials", str(tmp_path / "dataset")]
    study = load_study(make_listed(tmp_path, stimuli, None, *words))
    assert Counter(s.phase for s in study.stimuli) == {"test": 4, "familiarization": 4}


@pytest.mark.parametrize("missing", [3, 8])
def test_missing_movies_are_named_all_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], missing: int
) -> None:
    ids = ids_of(8)
    stimuli = write_list(tmp_path / LIST, ids)
    write_media(tmp_path / "movies", ids)
    for name in ids[-missing:]:
        (tmp_path / "movies" / f"{name}.mp4").unlink()
    make_listed(tmp_path, stimuli, stimuli, code=2)
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.count(str(tmp_path / "movies")) == 3
    if missing == 3:
        assert all(f"{name}.mp4" in error for name in ids[-3:])
        assert "3 of 16 files are missing" in error and f"{ids[0]}.mp4" not in error
    else:
        assert "8 of 16 files are missing" in error and error.endswith(", and 5 more\n")


def test_names_that_are_one_to_the_analysis_are_refused_before_movies_are_cut(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ids = ids_of(2)
    looks = [name.replace("_0", "-redyellow_0", 1) for name in ids]
    lists = [write_list(tmp_path / LIST, ids), write_list(tmp_path / f"looks_{LIST}", looks)]
    write_media(tmp_path / "movies", ids + looks)
    make_listed(tmp_path, *lists, code=2)
    error = capsys.readouterr().err
    assert "one stimulus to the analysis" in error and error.count("\n") == 1
    assert looks[0].removesuffix("_img") in error
    # A stimulus in both lists.
    make_listed(tmp_path, lists[0], lists[0], code=2)
    assert "is already in row" in capsys.readouterr().err


@pytest.mark.parametrize("layout", ["flat", "core", "core of a scenario", "maps apart"])
def test_movies_and_maps_are_found_in_the_usual_places(tmp_path: Path, layout: str) -> None:
    ids, apart = ids_of(2), None
    stimuli = write_list(tmp_path / LIST, ids)
    root = tmp_path / "files"
    if layout == "flat":
        write_media(root, ids)
    elif layout == "core":
        write_media(root / "mp4s", ids, root / "maps")
    elif layout == "core of a scenario":
        write_media(root / "Collide" / "mp4s", ids, root / "Collide" / "maps")
    else:
        apart = tmp_path / "elsewhere"
        write_media(root, ids, apart)
    chosen = choose_listed([stimuli], [], root, apart)
    assert all(source.movie.is_file() and source.map.is_file() for source in chosen.sources)


def test_both_looks_share_their_map(tmp_path: Path) -> None:
    ids = ["pilot_dominoes_4mid_boxroom-redyellow_0001_img"]
    stimuli = write_list(tmp_path / "dominoes.json", ids)
    write_media(tmp_path / "mp4s-redyellow", ids)
    maps = tmp_path / "maps"
    maps.mkdir()
    (tmp_path / "mp4s-redyellow" / "pilot_dominoes_4mid_boxroom-redyellow_0001_map.png").rename(
        maps / "pilot_dominoes_4mid_boxroom_0001_map.png"
    )
    (source,) = choose_listed([stimuli], [], tmp_path).sources
    assert source.look == "redyellow" and source.movie.is_file() and source.map.is_file()
    # The analysis joins looks by the canonical name.
    assert canonical_name(source.stimulus) == "pilot_dominoes_4mid_boxroom_0001"


def test_addresses_in_a_list_lead_nowhere(tmp_path: Path) -> None:
    columns = columns_of(ids_of(1))
    (tmp_path / "secret.png").write_bytes(draw_map(0, SIZE))
    columns["map_url"]["0"] = "https://x/../../secret.png/.."
    path = tmp_path / "collide.json"
    path.write_text(json.dumps(columns))
    write_media(tmp_path / "movies", ids_of(1))
    (source,) = choose_listed([path], [], tmp_path / "movies").sources
    assert source.map.parent == tmp_path / "movies"


def test_lists_may_be_csv(tmp_path: Path) -> None:
    path = tmp_path / "collide.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["target_hit_zone_label", "stim_ID", "anything"])
        writer.writerows([["TRUE", "a_0001_img", ""], ["False", "a_0002", "x"], ["1", "b.mp4", ""]])
    rows = read_list(path)
    assert [(row.stimulus, row.contact) for row in rows] == [
        ("a_0001", True), ("a_0002", False), ("b", True)]  # fmt: skip
    assert list_scenario(path, rows) == "collide"


def test_fewer_may_be_taken_and_are_balanced(tmp_path: Path) -> None:
    stimuli = write_list(tmp_path / LIST, ids_of(20))
    (tmp_path / "m").mkdir()
    chosen = choose_listed([stimuli], [], tmp_path / "m", test=8)
    assert Counter(source.label for source in chosen.sources) == {True: 4, False: 4}
    assert chosen == choose_listed([stimuli], [], tmp_path / "m", test=8)
    with pytest.raises(BadInputError, match="10 stimuli with and 10 without contact, not 11"):
        choose_listed([stimuli], [], tmp_path / "m", test=22)


REFUSED: dict[str, tuple[Any, str]] = {
    "no JSON": ("{", "is not JSON"),
    "another form": ([{"stim_ID": "a"}], "one object per column"),
    "no names": ({"target_hit_zone_label": {"0": True}}, r"lacks the column\(s\) stim_ID"),
    "no labels": ({"stim_ID": {"0": "a"}}, r"lacks the column\(s\) target_hit_zone_label"),
    "columns of other rows": (
        {"stim_ID": {"0": "a", "1": "b"}, "target_hit_zone_label": {"0": True}},
        "row 2 .*expected a value"),
    "a path for a name": (
        {"stim_ID": {"0": "../a"}, "target_hit_zone_label": {"0": True}}, "row 1: stim_ID must be"),
    "a list for a name": (
        {"stim_ID": {"0": ["a"]}, "target_hit_zone_label": {"0": True}}, "row 1: stim_ID must be"),
    "no outcome": (
        {"stim_ID": {"0": "a"}, "target_hit_zone_label": {"0": None}}, "expected a value"),
    "a stimulus twice": (
        {"stim_ID": {"0": "a", "1": "a_img"}, "target_hit_zone_label": {"0": 1, "1": 0}},
        "row 2: a_img is there already"),
    "no rows": ({"stim_ID": {}, "target_hit_zone_label": {}}, "lists no stimulus"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_bad_lists_are_refused(tmp_path: Path, case: str) -> None:
    content, message = REFUSED[case]
    path = tmp_path / "collide.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(BadInputError, match=message) as raised:
        read_list(path)
    assert str(path) in str(raised.value)


def test_a_list_that_betrays_no_scenario_is_asked_for_it(tmp_path: Path) -> None:
    path = write_list(tmp_path / "mine.json", ids_of(2, "own"))
    with pytest.raises(BadInputError, match="which scenario is it"):
        choose_listed([path], [], tmp_path)
    path = write_list(tmp_path / "my-drop_list.json", ids_of(2, "own"))
    assert choose_listed([path], [], tmp_path).scenarios == ("drop",)
    lists = [write_list(tmp_path / f"{name}.json", ids_of(2)) for name in "ab"]
    with pytest.raises(BadInputError, match="both lists of collide"):
        choose_listed(lists, [], tmp_path)


def test_the_published_lists_are_read(official: Path) -> None:
    lists = sorted((official / "stimuli").glob("*_experimental_stims.json"))
    found = {path: read_list(path) for path in lists}
    assert len(found) == 9
    for path, rows in found.items():
        assert Counter(row.contact for row in rows) == {True: 75, False: 75}
        word = path.stem.split("benchmarking-")[1].split("-")[0]
        assert list_scenario(path, rows) == OFFICIAL_SCENARIOS[word]
        looks = {row.look for row in rows}
        assert looks == {"redyellow" if "redyellow" in path.name else "free"}
    labels = official / "stimuli" / "stimulus_names_and_labels.csv"
    outcomes = {
        canonical_name(row["stim_ID"]): row["label"] == "True"
        for row in csv.DictReader(labels.open(newline=""))
    }
    listed = {canonical_name(r.stimulus): r.contact for rows in found.values() for r in rows}
    shared = outcomes.keys() & listed.keys()
    assert len(shared) > 1000
    assert all(outcomes[name] == listed[name] for name in shared)


def write_own(path: Path, names: list[str], **columns: Any) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["stim_ID", "target_hit_zone_label", *columns])
        writer.writeheader()
        for number, name in enumerate(names):
            row = {key: values[number] for key, values in columns.items()}
            writer.writerow({"stim_ID": name, "target_hit_zone_label": number % 2 == 0, **row})
    return path


def test_own_movies_have_any_scenario_and_length(tmp_path: Path) -> None:
    names, practice = [f"ball-{i}" for i in range(3)], ["try-0", "try-1"]
    own = {"scenario": ["billiards"] * 3, "observed_frames": [20, "", 50]}
    listed = write_own(tmp_path / "mine.csv", names, **own)
    fam = write_own(tmp_path / "first.csv", practice, scenario=["billiards"] * 2)
    write_media(tmp_path / "movies", names + practice)
    study = load_study(make_listed(tmp_path, listed, fam))
    assert study.scenarios == ("billiards",)
    test = study.phase("billiards", "test")
    assert [stimulus.frames for stimulus in test] == [20, OBSERVED, 50]
    for stimulus in test:
        shown = [read_number(frame) for frame in read_frames(study.folder / stimulus.movie)]
        assert shown == list(range(stimulus.frames))


@pytest.mark.parametrize(
    ("scenario", "frames", "told"),
    [
        (["a b", "a b"], None, r"row 1: scenario must be letters"),
        (["pool", "snooker"], None, r"of one scenario, not of pool and snooker"),
        (["pool", ""], None, r"of one scenario"),
        (["pool", "pool"], [0, 9], r"row 1 of column .obs.* holds .0."),
        (["pool", "pool"], [9, 2.5], r"row 2 of column .obs.* holds .2\.5."),
    ],
)
def test_bad_columns_of_own_movies_are_named(
    tmp_path: Path, scenario: list[str], frames: list[Any] | None, told: str
) -> None:
    more = {} if frames is None else {"observed_frames": frames}
    path = write_own(tmp_path / "list.csv", ["a", "b"], scenario=scenario, **more)
    with pytest.raises(BadInputError, match=told):
        list_scenario(path, read_list(path))
