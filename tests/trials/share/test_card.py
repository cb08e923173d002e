"""Dataset cards: statements agree with the index, metadata follow the rules of Croissant."""

from __future__ import annotations

import dataclasses
import fnmatch
import hashlib
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from physion.cli.main import main as cli
from physion.core.errors import BadInputError
from physion.physics.replay import RECORDED_OUTCOMES
from physion.trials.files import TrialPaths, encode_png, find_trials, write_files
from physion.trials.index import COLUMNS, INDEX_COLUMNS, build_index, read_index, write_index
from physion.trials.share.card import about_states, write_card
from support.hand_made import SIZE, make_parts
from support.programs import find_program

RAI_WORDS = {
    "dataCollection", "dataCollectionType", "dataCollectionMissingData", "dataCollectionRawData",
    "dataCollectionTimeframe", "dataImputationProtocol", "dataManipulationProtocol",
    "dataPreprocessingProtocol", "dataAnnotationProtocol", "dataAnnotationPlatform",
    "dataAnnotationAnalysis", "dataReleaseMaintenancePlan", "personalSensitiveInformation",
    "dataSocialImpact", "dataBiases", "dataLimitations", "dataUseCases", "annotationsPerItem",
    "annotatorDemographics", "machineAnnotationTools",
}  # fmt: skip
"""All properties of the responsible-AI vocabulary 1.0."""
SCHEMA_ORG_WORDS = {
    "name", "description", "url", "license", "version", "datePublished", "creator", "keywords",
    "distribution", "contentUrl", "contentSize", "encodingFormat", "sha256",
}  # fmt: skip
TYPES = {"sc:Text", "sc:Integer", "sc:Float", "sc:Boolean", "sc:VideoObject"}


def _make(folder: Path, split: str, trial: str, **changes: Any) -> None:
    """A hand-made trial; its movies and map are no more than names with bytes."""
    changes = {"seed": "ff", **changes}
    contact = changes.pop("contact", True)
    robust = changes.pop("robust", None)
    parts = make_parts(trial, cloth=False, contact_frame=50 if contact else None)
    meta = dataclasses.replace(parts.metadata, split=split, dataset="mine", **changes)
    labels = dataclasses.replace(parts.labels, robust=robust)
    files = {
        "movie": f"movie {trial}".encode(),
        "observed_movie": b"observed",
        "map": encode_png(np.zeros((SIZE, SIZE, 4), np.uint8)),
        "trial_file": parts._replace(metadata=meta, labels=labels).pack(),
    }
    write_files(TrialPaths(folder, split, "drop", trial), files)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four training trials, one with contact, and two testing trials, one of them imported."""
    folder = tmp_path_factory.mktemp("mine")
    for number in range(4):
        _make(folder, "training", f"train{number}", contact=number == 0, completed=number < 3)
    _make(folder, "testing", "test0", robust=0.75, look="redyellow")
    _make(folder, "testing", "test1", robust=1.0, look="redyellow", seed=None)
    table, problems = build_index(folder)
    assert not problems
    write_index(folder, table)
    chosen = {"min_visible": 0.0005, "robust": 0.5, "observed_contact": False}
    (folder / "dataset.json").write_text(json.dumps({"dataset": "mine", "settings": chosen}))
    return folder


@pytest.fixture(scope="module")
def metadata(dataset: Path) -> dict[str, Any]:
    """What `croissant.json` says."""
    card = write_card(dataset, published="2026-11-21")
    data = json.loads(card.metadata.read_text())
    assert isinstance(data, dict)
    return data


def _front_matter(text: str) -> dict[str, Any]:
    yaml = pytest.importorskip("yaml")
    _, front, _ = text.split("---\n", 2)
    return dict(yaml.safe_load(front))


def test_the_card_says_whose_states_these_are_and_how_good(dataset: Path, tmp_path: Path) -> None:
    text = write_card(dataset, tmp_path).readme.read_text()
    assert about_states(["by hand 1"]) in text
    ours = about_states(["physion-3.97b", "physion-3.97b"])
    assert ours.startswith("States, contacts and labels are computed by the engine physion-3.97b,")
    results = Path(__file__).parents[3] / "benchmarks" / "results" / "replay.json"
    for engine, known in RECORDED_OUTCOMES.items():
        table = pd.DataFrame(json.loads(results.read_text())["scenarios"])
        found = table[table["engine"] == engine].set_index("scenario")["agreement"]
        assert found.drop("drape", errors="ignore").size == 7
        assert known["rigid"] == round(found.drop("drape", errors="ignore").mean(), 3)
        assert known.get("drape") == (round(found["drape"], 3) if "drape" in found else None)
        said = about_states([f"{engine}-1"])
        assert all(f"{number:.3f}" in said for number in known.values())
    assert "was not measured" in about_states(["own-1"])
    assert about_states(["imported: TDW"]) == (
        "States, contacts and labels of some trials are imported (TDW)."
    )


def test_the_front_matter_is_what_the_hub_reads(dataset: Path, tmp_path: Path) -> None:
    card = write_card(dataset, tmp_path, license="CC-BY-4.0")
    front = _front_matter(card.readme.read_text())
    assert front["license"] == "cc-by-4.0"
    assert front["pretty_name"] == "Physion: mine"
    assert front["size_categories"] == ["n<1K"]
    assert front["task_categories"] == ["video-classification"]
    assert [config["config_name"] for config in front["configs"]] == ["index", "videos"]
    assert [config.get("default", False) for config in front["configs"]] == [True, False]


def load_dataset(folder: Path, name: str) -> dict[str, pa.Table]:
    """What ``datasets.load_dataset(folder, name)`` reads: the files of each split in the card.

    As in ``MetadataConfigs`` and ``sanitize_patterns`` of ``datasets``: ``data_files`` that are a
    list of ``split`` and ``path`` give these splits; a path alone would give ``train``.
    """
    front = _front_matter((folder / "README.md").read_text())
    (config,) = [item for item in front["configs"] if item["config_name"] == name]
    assert isinstance(config["data_files"], list)
    return {item["split"]: pq.read_table(folder / item["path"]) for item in config["data_files"]}


def test_tests_are_never_training_rows(dataset: Path, tmp_path: Path) -> None:
    card = write_card(dataset, tmp_path)
    found = load_dataset(tmp_path, "index")
    assert {split: table["trial"].to_pylist() for split, table in found.items()} == {
        "train": ["train0", "train1", "train2", "train3"],
        "test": ["test0", "test1"],
    }
    files = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.parquet")}
    front = _front_matter(card.readme.read_text())
    assert files == {item["path"] for config in front["configs"] for item in config["data_files"]}
    assert set(card.tables) == set(tmp_path.rglob("*.parquet"))


def test_videos_hold_the_observed_movie_and_no_answer(dataset: Path, tmp_path: Path) -> None:
    write_card(dataset, tmp_path)
    found = load_dataset(tmp_path, "videos")
    assert {split: table.num_rows for split, table in found.items()} == {"train": 4, "test": 2}
    for table in found.values():
        assert set(table["video"].to_pylist()[0]) == {"bytes", "path"}
        assert all(video["bytes"] == b"observed" for video in table["video"].to_pylist())
        hub = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
        assert list(hub) == table.column_names and hub["video"] == {"_type": "Video"}
        seen = {"trial", "dataset", "scenario", "split", "look", "width", "height"}
        assert set(hub) == seen | {"observed_frames", "video"}


def test_croissant_gives_the_movies_themselves(dataset: Path, metadata: dict[str, Any]) -> None:
    records = next(r for r in metadata["recordSet"] if r["@id"] == "videos")
    fields = {field["name"]: field for field in records["field"]}
    assert fields["video"]["dataType"] == "sc:VideoObject"
    (files,) = [item for item in metadata["distribution"] if item["@id"] == "video-tables"]
    paths = sorted(dataset.glob(files["includes"]))
    assert [path.name for path in paths] == ["videos-test.parquet", "videos-train.parquet"]
    for name, field in fields.items():
        assert field["source"]["extract"] == {"column": name}
        for path in paths:
            assert name in pq.read_table(path).column_names
    assert fields["video"]["source"]["transform"] == {"jsonPath": "bytes"}


def test_counts_and_rates_match_the_index(dataset: Path, tmp_path: Path) -> None:
    text = write_card(dataset, tmp_path).readme.read_text()
    lines = text.splitlines()
    assert "| training | drop | 4 | 0.250 | 0 | 60 | - | free |" in lines
    assert "| testing | drop | 2 | 1.000 | 0 | 60 | 0.875 | redyellow |" in lines
    assert "6 simulated physical scenes, 6 of them with movies" in text
    assert "- Agent and patient touch in 0.250 of the 4 training trials." in lines
    assert (
        "sampled at random by 0: 5." in text and "imported from records made elsewhere: 1." in text
    )
    assert "In 1 of 6 trials something still moved" in text
    assert "0.875 of cases, measured on 2 of 6 trials" in text
    assert "min_visible = 0.0005, robust = 0.5, observed_contact = False" in text


def test_the_card_follows_the_index(dataset: Path, tmp_path: Path) -> None:
    """Other data, other numbers: nothing of it is written down beforehand."""
    _make(tmp_path, "training", "only", contact=False)
    table, _ = build_index(tmp_path)
    write_index(tmp_path, table)
    text = write_card(tmp_path).readme.read_text()
    assert "| training | drop | 1 | 0.000 | 0 | 60 | - | free |" in text
    assert "records made elsewhere: 0." in text and "were chosen with" not in text
    assert "was not measured" in text


def test_only_states_have_no_movies_to_describe(tmp_path: Path) -> None:
    _make(tmp_path, "training", "only", movies=False)
    paths = find_trials(tmp_path)[0]
    for path in (paths.movie, paths.observed_movie, paths.map):
        path.unlink()
    table, problems = build_index(tmp_path)
    assert not problems
    write_index(tmp_path, table)
    card = write_card(tmp_path)
    metadata = json.loads(card.metadata.read_text())
    assert [item["@id"] for item in metadata["distribution"]] == ["index.parquet", "trial-files"]
    assert "none of them with movies" in metadata["description"]
    assert "video/mp4" not in card.metadata.read_text()


def test_required_properties_are_there(metadata: dict[str, Any]) -> None:
    """Those that specification 1.0 requires of every dataset."""
    assert metadata["@type"] == "sc:Dataset"
    assert metadata["conformsTo"] == [
        "http://mlcommons.org/croissant/1.0",
        "http://mlcommons.org/croissant/RAI/1.0",
    ]
    for name in ("description", "license", "name", "url", "creator", "datePublished"):
        assert metadata[name], name
    assert metadata["license"] == "https://spdx.org/licenses/MIT.html"
    assert metadata["datePublished"] == "2026-11-21"


def test_the_context_stands_in_the_file_and_knows_every_word(metadata: dict[str, Any]) -> None:
    context = metadata["@context"]
    assert isinstance(context, dict), "an address would have to be fetched"
    assert context["@vocab"] == "https://schema.org/"
    assert context["cr"] == "http://mlcommons.org/croissant/"
    assert context["rai"] == "http://mlcommons.org/croissant/RAI/"

    def check(node: Any) -> None:
        for item in node if isinstance(node, list) else []:
            check(item)
        if not isinstance(node, dict):
            return
        for key, value in node.items():
            if key.startswith("@"):
                continue
            if key.startswith("rai:"):
                assert key.removeprefix("rai:") in RAI_WORDS, key
            else:
                assert key in context or key in SCHEMA_ORG_WORDS, key
            if key != "data":
                check(value)

    check({key: value for key, value in metadata.items() if key != "@context"})


def _nodes(node: Any) -> list[dict[str, Any]]:
    """All objects within ``node``."""
    if isinstance(node, list):
        return [found for item in node for found in _nodes(item)]
    if not isinstance(node, dict):
        return []
    return [node] + [
        found for key, item in node.items() if key != "@context" for found in _nodes(item)
    ]


def test_identifiers_are_unique_and_references_lead_somewhere(metadata: dict[str, Any]) -> None:
    nodes = _nodes(metadata)
    defined = [node["@id"] for node in nodes if "@id" in node and len(node) > 1]
    pointed = [node["@id"] for node in nodes if set(node) == {"@id"}]
    assert len(defined) == len(set(defined)) and len(pointed) > len(COLUMNS)
    assert set(pointed) <= set(defined)
    for records in metadata["recordSet"]:
        for field in records["field"]:
            assert field["@id"] == f"{records['@id']}/{field['name']}"
            assert field["dataType"] in TYPES and field["@type"] == "cr:Field"


def test_file_sets_hold_the_files_that_they_say(dataset: Path, metadata: dict[str, Any]) -> None:
    index, *others = metadata["distribution"]
    data = (dataset / index["contentUrl"]).read_bytes()
    assert index["@type"] == "cr:FileObject" and index["encodingFormat"] == "application/x-parquet"
    assert index["sha256"] == hashlib.sha256(data).hexdigest()
    assert index["contentSize"] == f"{len(data)} B"
    sets = {item["@id"]: item["includes"] for item in others}
    del sets["video-tables"]
    assert set(sets) == {"trial-files", "movies", "observed-movies", "maps"}
    files = [p.relative_to(dataset).as_posix() for p in dataset.rglob("*.*") if p.is_file()]
    for name, pattern in sets.items():
        attribute = name.replace("-", "_").removesuffix("s")
        expected = {
            getattr(paths, attribute).relative_to(dataset).as_posix()
            for paths in find_trials(dataset)
        }
        assert {file for file in files if fnmatch.fnmatchcase(file, pattern)} == expected, name


def test_fields_are_the_columns_of_the_index(dataset: Path, metadata: dict[str, Any]) -> None:
    trials = next(r for r in metadata["recordSet"] if r["@id"] == "trials")
    table = read_index(dataset)
    columns = {field["source"]["extract"]["column"]: field for field in trials["field"]}
    assert list(columns) == list(table.columns) == list(INDEX_COLUMNS) == list(COLUMNS)
    assert all(column.meaning for column in INDEX_COLUMNS.values())
    of_kind = {
        "sc:Text": pd.api.types.is_string_dtype,
        "sc:Integer": pd.api.types.is_integer_dtype,
        "sc:Float": pd.api.types.is_float_dtype,
        "sc:Boolean": pd.api.types.is_bool_dtype,
    }
    for name, field in columns.items():
        assert of_kind[field["dataType"]](table[name].dropna().dtype), name


def _validate(path: Path) -> str:
    """What MLCommons' own program says of a file; skips where it is not installed.

    It lives best in an environment of its own, as it brings type stubs that mypy would read.
    """
    program = find_program("mlcroissant", variable="MLCROISSANT")
    nowhere = dict.fromkeys(("http_proxy", "https_proxy"), "http://127.0.0.1:9")
    done = subprocess.run(
        [program, "validate", "--jsonld", str(path)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **nowhere},
    )
    return done.stdout + done.stderr


@pytest.mark.nightly
@pytest.mark.slow
def test_the_reference_validator_agrees(
    dataset: Path, metadata: dict[str, Any], tmp_path: Path
) -> None:
    said = _validate(dataset / "croissant.json")
    assert "Done." in said and "WARN" not in said.upper() and "error" not in said
    broken = json.loads(json.dumps(metadata))
    del broken["distribution"][0]["sha256"]
    (tmp_path / "croissant.json").write_text(json.dumps(broken))
    assert "1 error(s)" in _validate(tmp_path / "croissant.json")


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("license", "do what you want"),
        ("version", "1.0"),
        ("url", "my page"),
        ("published", "yesterday"),
    ],
)
def test_bad_terms_are_named(dataset: Path, tmp_path: Path, argument: str, value: str) -> None:
    with pytest.raises(BadInputError, match=value):
        write_card(dataset, tmp_path / "out", **{argument: value})
    assert not (tmp_path / "out").exists()


def test_folders_without_trials_are_refused(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"no index\.parquet"):
        write_card(tmp_path)
    write_index(tmp_path, read_index(dataset).iloc[:0])
    with pytest.raises(BadInputError, match="no trial"):
        write_card(tmp_path)


@pytest.mark.parametrize("name", ["README.md", "croissant.json"])
def test_files_of_others_are_not_written_over(dataset: Path, tmp_path: Path, name: str) -> None:
    text = "# My own words\n" if name == "README.md" else '{"description": "somebody else\'s"}'
    (tmp_path / name).write_text(text)
    with pytest.raises(BadInputError, match=r"is not a dataset card.*move it away"):
        write_card(dataset, tmp_path)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, text)]
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to(tmp_path / "nowhere")
    with pytest.raises(BadInputError, match="not a dataset card"):
        write_card(dataset, tmp_path)


def test_a_card_takes_the_place_of_an_older_one(dataset: Path, tmp_path: Path) -> None:
    write_card(dataset, tmp_path, version="1.0.0")
    card = write_card(dataset, tmp_path, version="1.0.1")
    assert "Version 1.0.1" in card.readme.read_text()
    assert json.loads(card.metadata.read_text())["version"] == "1.0.1"


def test_the_verb_takes_the_terms(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    terms = ["--license", "CC-BY-4.0", "--creator", "A Lab", "--version", "2.1.0"]
    terms += ["--url", "https://example.org/x", "--published", "2026-01-31"]
    words = ["export", str(dataset), str(tmp_path), "--layout", "card", *terms]
    assert cli(words) == 0
    said = json.loads((tmp_path / "croissant.json").read_text())
    assert said["license"].endswith("CC-BY-4.0.html") and said["creator"]["name"] == "A Lab"
    assert (said["version"], said["url"]) == ("2.1.0", "https://example.org/x")
    assert said["datePublished"] == "2026-01-31"
    assert cli(["export", str(dataset), str(tmp_path / "out"), "--creator", "me"]) == 2
    assert "--layout card" in capsys.readouterr().err
