"""Features computed elsewhere: asked for, encoded without this package, and read again."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

import physion
from physion.checking import check
from physion.cli.main import main
from physion.clips.batch import Batch, Provenance, Spec
from physion.core.errors import BadInputError
from physion.models.build import build_model
from physion.models.feature_table import FeatureTable
from physion.models.interface import Model
from physion.readout.check import check_models
from physion.readout.evaluate import evaluate
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings, choose_models
from physion.trials.dataset import Dataset
from physion.trials.share.features_request import export_features_request
from physion.trials.video import count_frames
from support.moving_dots import SIZE, make_dots

QUICK = EvaluationSettings(accelerator="cpu", logistic=LogisticSettings(grid=(1e-2, 1.0)))
FRAMES = np.arange(2, 45, 6)


class Encoder(Model):
    """Model that sees pictures and encodes each trial as the script of a request did."""

    decision = "logistic"
    spec = Spec(image_size=SIZE, future=0)

    def __init__(self, path: Path) -> None:
        with np.load(path) as file:
            self.features = dict(zip(file["names"].tolist(), file["features"], strict=True))

    def encode(self, batch: Batch) -> NDArray[np.float32]:
        """Return features, after those of the pictures were compared with them."""
        features = np.stack([self.features[trial] for trial in batch.trials])
        clips, steps = batch.rgb.shape[:2]
        cells = batch.rgb.astype(np.float64).reshape(clips, steps, 8, SIZE // 8, 8, SIZE // 8, 3)
        means = (cells / 255).mean((3, 5)).transpose(0, 1, 4, 2, 3).reshape(features.shape)
        # Chroma is upsampled in another way, which shows at edges of these small movies.
        assert abs(means - features).mean() < 2e-3 and abs(means - features).max() < 0.1
        return features

    def provenance(self) -> Provenance:
        """Return the name."""
        return Provenance("own", "none")

    def digest(self) -> str:
        """Return the digest."""
        return "0" * 64


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    counts = {"training": 2, "readout": 8, "testing": 4}
    return make_dots(tmp_path_factory.mktemp("dots"), counts, ("collide", "drop"))


def named(dots: Dataset) -> list[str]:
    return [t for split in ("readout", "testing") for t in dots.trials(split)]


def arrays(dots: Dataset, seed: int = 0) -> dict[str, Any]:
    names = named(dots)
    features = np.random.default_rng(seed).normal(size=(len(names), len(FRAMES), 5))
    # Half of the values say the outcome, so that rows that were exchanged would show.
    contact = dots.index.set_index("trial")["contact"].loc[names].to_numpy(float)
    features[:, :, 0] += 3 * contact[:, None]
    return {"names": np.array(names), "frames": FRAMES, "features": features.astype(np.float32)}


def predicted(model: Any, dots: Dataset, out: Path) -> pd.DataFrame:
    table = evaluate(model, dots, out, QUICK).predictions
    return table.set_index(["readout", "stimulus"]).sort_index()


def encode(request: Path) -> None:
    """Run the script of a request where this package cannot be imported."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    code = "import sys; sys.modules['physion'] = None; exec(open('encode.py').read())"
    subprocess.run(
        [sys.executable, "-c", code], cwd=request, env=environment, check=True, capture_output=True
    )


@pytest.mark.nightly
@pytest.mark.slow
def test_a_request_is_encoded_without_this_package_and_gives_the_row_of_the_model(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    request, out = tmp_path / "request", tmp_path / "out"
    command = ["export", str(dots.folder), str(request), "--layout", "features-request"]
    assert main(command) == 0
    with (request / "trials.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    assert sorted(row["trial"] for row in rows) == sorted(named(dots))
    for row in rows:
        movie = request / row["movie"]
        assert movie.read_bytes() == dots.paths(row["trial"]).observed_movie.read_bytes()
        assert count_frames(movie) == int(row["frames"]) == 45
    assert len((request / "encode.py").read_text().splitlines()) <= 32
    assert len((request / "README.md").read_text().splitlines()) <= 12
    encode(request)
    features = str(request / "features.npz")
    options = ["--out", str(out), "--option", "logistic.grid=[0.01,1.0]"]
    assert main(["evaluate", "--features", features, str(dots.folder), *options]) == 0
    (path,) = (out / "predictions").glob("*.csv")
    table = pd.read_csv(path).set_index("stimulus")
    assert set(table["readout"]) == {"observed"} and set(table["model"]) == {"my network"}
    assert set(table["inputs"]) == {"features up to frame 44"}
    own = Encoder(request / "features.npz")
    expected = predicted(own, dots, tmp_path / "own").loc["observed"]["p_contact"]
    np.testing.assert_allclose(table["p_contact"].loc[expected.index], expected, atol=1e-9)
    assert expected.std() > 0.01


@pytest.mark.nightly
@pytest.mark.slow
def test_a_request_of_whole_movies_is_a_row_of_full_only(dots: Dataset, tmp_path: Path) -> None:
    request = tmp_path / "request"
    export_features_request(dots.folder, request, readout="full")
    trial = dots.trials("testing")[0]
    assert count_frames(request / "movies" / f"{trial}.mp4") == 151
    encode(request)
    table = predicted(str(request / "features.npz"), dots, tmp_path / "out")
    assert set(table.index.get_level_values("readout")) == {"full"}
    right = (table["p_contact"] > 0.5) == table["outcome"]
    assert right.mean() > 0.9, "the dot ends where it touches"


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["npz", "hdf5"])
def test_rows_are_matched_by_name_in_any_order(dots: Dataset, tmp_path: Path, ending: str) -> None:
    given, order = arrays(dots), np.random.default_rng(1).permutation(len(named(dots)))
    tables = []
    for number, rows in enumerate((slice(None), order)):
        path = tmp_path / str(number) / f"net.{ending}"
        path.parent.mkdir()
        changed = given | {"names": given["names"][rows], "features": given["features"][rows]}
        write(path, changed)
        tables.append(predicted(str(path), dots, tmp_path / f"out{number}"))
    assert set(tables[0]["model"]) == {"net"}
    assert (tables[0]["p_contact"] == tables[1]["p_contact"]).all()
    assert ((tables[0]["p_contact"] > 0.5) == tables[0]["outcome"]).mean() > 0.9


def write(path: Path, given: dict[str, Any]) -> None:
    if path.suffix == ".npz":
        np.savez(path, **given)
        return
    with h5py.File(path, "w") as file:
        for name, value in given.items():
            text = isinstance(value, str) or getattr(value, "dtype", np.dtype(int)).kind in "UO"
            file.create_dataset(
                name,
                data=value.tolist() if text and not isinstance(value, str) else value,
                dtype=h5py.string_dtype() if text else None,
            )


def evaluator_files(folder: Path, dots: Dataset, given: dict[str, Any]) -> Path:
    """Write files as ``extract_features.py`` of physion_evaluator does, from its own names."""
    folder.mkdir(parents=True)
    for phase, split in (("train", "readout"), ("test", "testing")):
        chosen = [row for row, name in enumerate(given["names"]) if f"_{split}_" in name]
        names = [str(given["names"][row]).replace("collide_", "collision_") for row in chosen]
        with h5py.File(folder / f"{phase}_features.hdf5", "w") as file:
            file["features"] = given["features"][chosen]
            file["label"] = np.zeros(len(chosen))
            paths = [f"/data/physion_mp4s/{phase}/{name}.mp4" for name in names]
            file.create_dataset("filenames", data=paths, dtype=h5py.string_dtype())
            file["frame_labels"] = np.full(len(chosen), 75)
    return folder / "test_features.hdf5"


@pytest.mark.slow
def test_files_of_the_evaluator_give_the_predictions_of_the_same_features(
    dots: Dataset, tmp_path: Path
) -> None:
    given = arrays(dots)
    collide = np.char.startswith(given["names"], "collide")[:, None]
    frames = np.where(collide, np.minimum(given["frames"], 15), given["frames"])
    write(tmp_path / "net.npz", given | {"benchmark": "v1.5", "frames": frames})
    path = evaluator_files(tmp_path / "mynet" / "ocp", dots, given)
    own = predicted(str(tmp_path / "net.npz"), dots, tmp_path / "own")
    theirs = predicted(str(path), dots, tmp_path / "theirs")
    assert set(theirs["model"]) == {"mynet"}
    found = evaluate(str(path), dots, tmp_path / "theirs", QUICK, twin=True)
    assert len(found.evaluated) == 1 and len(found.warnings) == 1
    assert "test_features.hdf5: no random twin can be made" in found.warnings[0]
    assert set(theirs["inputs"]) == {"features of unstated frames"}
    assert set(theirs["benchmark"]) == {"v1.5"} and theirs["readout_c"].nunique() == 1
    for table, out, frames in ((own, "own", "up to 44"), (theirs, "theirs", "")):
        assert set(table["frames"]) == {frames}
        shown = physion.compare(list((tmp_path / out / "predictions").glob("*.csv"))).summary
        assert set(shown["frames"]) == {": ".join(filter(None, ["v1.5", frames]))}
    np.testing.assert_allclose(theirs["p_contact"], own["p_contact"], atol=1e-9)
    detection = evaluator_files(tmp_path / "mynet" / "ocd", dots, given)
    table = predicted(str(detection), dots, tmp_path / "ocd")
    assert set(table.index.get_level_values("readout")) == {"full"}, "it saw the contact"


def without_last(given: dict[str, Any]) -> dict[str, Any]:
    return given | {"names": given["names"][:-1], "features": given["features"][:-1]}


def with_stranger(given: dict[str, Any]) -> dict[str, Any]:
    names = np.append(given["names"], "drop_testing_9999")
    return given | {"names": names, "features": np.pad(given["features"], ((0, 1), (0, 0), (0, 0)))}


def with_nan(given: dict[str, Any]) -> dict[str, Any]:
    features = given["features"].copy()
    features[3, 2, 1] = np.nan
    return given | {"features": features}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without_last, r"1 of 24 trials .* missing, such as 'drop_testing_0003'"),
        (with_stranger, r"1 of 25 names are unknown to the dataset, such as 'drop_testing_9999'"),
        (with_nan, r"features of trial 'collide_readout_0003', time step 2, are not finite"),
        (lambda a: a | {"frames": a["frames"] + 1}, "frame 45 comes after the observed part"),
        (
            lambda a: a | {"frames": a["frames"][::-1]},
            "frames must be 0 or more and must not decrease",
        ),
        (lambda a: a | {"frames": a["frames"].astype(float)}, "frames must be integers"),
        (lambda a: a | {"frames": a["frames"][:-1]}, r"are \(24, 8, 5\) for 24 names and 7 frames"),
        (
            lambda a: a | {"frames": np.full(46, 44), "features": np.zeros((24, 46, 1))},
            "46 time steps are more than the 45 observed frames",
        ),
        (lambda a: a | {"names": np.full(24, "a")}, "the name 'a' occurs twice"),
        (lambda a: a | {"features": a["features"].astype(int)}, "features are int64"),
        (lambda a: {"names": a["names"], "features": a["features"]}, "no array 'frames'"),
        (
            lambda a: a | {"benchmark": "v1.5"},
            r"frame 44 comes after the observed part of 'collide_.*', whose last frame is 15",
        ),
        (
            lambda a: a | {"frames": np.tile(a["frames"], (23, 1))},
            "frames must be integers, one for each time step, or a row of them for each trial",
        ),
        (lambda a: a | {"benchmark": "2"}, "benchmark must be v1 or v1.5, not '2'"),
        (lambda a: a | {"readout": "later"}, "readout must be observed or full, not 'later'"),
        (lambda a: a | {"names": a["names"].astype(object)}, "pickled objects are refused"),
        (lambda a: a | {"names": a["names"][:, None]}, r"names have the shape \(24, 1\)"),
        (lambda a: a | {"model": "my\x1b[31m net"}, "model must be a name of printable characters"),
    ],
)
def test_a_table_that_does_not_fit_is_refused_in_one_line(
    change: Any, message: str, dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "net.npz"
    np.savez(path, **change(arrays(dots)))
    capsys.readouterr()
    assert (
        main(["evaluate", "--features", str(path), str(dots.folder), "--out", str(tmp_path)]) == 2
    )
    error = capsys.readouterr().err.strip()
    assert error.startswith("physion: ") and error.count("\n") == 0
    assert re.search(message, error), error


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"\x89HDF\r\n\x1a\n cut"])
@pytest.mark.parametrize("ending", ["npz", "h5"])
def test_a_damaged_file_is_refused_in_one_line(
    content: bytes, ending: str, dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"net.{ending}"
    path.write_bytes(content)
    assert main(["evaluate", str(path), str(dots.folder), "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert error.count("\n") == 0 and f"features {path} cannot be read" in error
    path.unlink()
    assert main(["evaluate", str(path), str(dots.folder), "--out", str(tmp_path)]) == 2
    assert "there is no file of features" in capsys.readouterr().err


def weak(dots: Dataset) -> dict[str, Any]:
    """Features with less of the outcome: no number of them tells all outcomes."""
    given = arrays(dots)
    contact = dots.index.set_index("trial")["contact"].loc[given["names"]].to_numpy(float)
    given["features"][:, :, 0] -= np.float32(2) * contact[:, None].astype(np.float32)
    return given


def test_a_number_that_tells_all_outcomes_is_found(dots: Dataset, tmp_path: Path) -> None:
    given = weak(dots)
    known = dots.index.set_index("trial")["contact"].loc[named(dots)].astype(bool).to_dict()
    np.savez(tmp_path / "net.npz", **given)
    table = FeatureTable(tmp_path / "net.npz")
    place, chance = table.telling(known)
    # 24 trials, half of them with contact, and 40 numbers.
    assert sum(known.values()) == 12 and chance == 2 * 40 / math.comb(24, 12)
    assert place == ""
    given["features"][:, 3, 2] = [-1e-3 * contact for contact in known.values()]
    np.savez(tmp_path / "leak.npz", **given)
    assert FeatureTable(tmp_path / "leak.npz").telling(known)[0] == "time step 3, feature 2"
    assert table.telling(dict.fromkeys(known, True)) == ("", float("inf"))
    twin = table.random_twin(np.random.default_rng(0))
    assert twin.digest() != table.digest() and twin.features.shape == table.features.shape
    assert list(table.of_trials(named(dots)[:2]).rows) == named(dots)[:2]


@pytest.mark.slow
def test_a_table_is_checked_as_far_as_it_can_be(
    dots: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, labels = weak(dots), dots.index.set_index("trial")["contact"]
    np.savez(tmp_path / "net.npz", **given)
    given["features"][:, 3, 2] = 1e-3 * labels.loc[given["names"]].to_numpy(float)
    np.savez(tmp_path / "leak.npz", **given)
    command = ["check", str(tmp_path / "net.npz"), str(dots.folder), "--out", str(tmp_path / "out")]
    assert main([*command, "--trials", "40", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    found = {row["change"]: row["verdict"] for row in values["changes"]}
    assert {name for name, verdict in found.items() if verdict == "passed"} == {
        "again", "labels", "outcome"
    }  # fmt: skip
    assert found["random twin"] == "shown" and found["future"] == "not possible: a table"
    assert values["verdict"].endswith("; 10 changes are not possible for a table of features")
    page = (tmp_path / "out" / "net.html").read_text()
    assert "not possible for a table of features" in page and "nan" not in page.split("<table")[1]
    both = choose_models([str(tmp_path / name) for name in ("net.npz", "leak.npz")])
    outcomes = check_models(both, dots.folder, tmp_path / "both", QUICK)
    assert list(outcomes.values()) == ["passed, as a table", "refused: outcome"]
    few = check(str(tmp_path / "leak.npz"), dots, tmp_path / "few", QUICK, trials=4)
    (row,) = few.table[few.table["change"] == "outcome"].itertuples()
    assert (row.verdict, row.note) == ("shown", "too few trials to tell that from chance")


def test_text_with_the_ending_npz_is_not_called_pickled(tmp_path: Path) -> None:
    path = tmp_path / "net.npz"
    path.write_text("names, frames, features")
    with pytest.raises(BadInputError, match=r"cannot be read: it is not an npz file"):
        build_model(str(path))


def test_a_blank_name_is_the_name_of_the_file(dots: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "net.npz"
    np.savez(path, **arrays(dots), model=" ")
    assert build_model(str(path)).provenance().model == "net"


def test_other_endings_are_refused(dots: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--features", "a.txt", str(dots.folder)]) == 2
    assert "ends with .npz, .hdf5, .h5, not a.txt" in capsys.readouterr().err


def test_a_request_names_the_dataset_of_the_working_folder(
    dots: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(dots.folder)
    export_features_request(Path(), tmp_path / "request", split="testing")
    text = (tmp_path / "request/README.md").read_text()
    assert f"--features features.npz {dots.folder.name}` fits" in text


def test_another_file_has_another_digest(dots: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "net.npz"
    np.savez(path, **arrays(dots))
    one = build_model(str(path))
    np.savez(path, **arrays(dots, seed=1))
    assert build_model(str(path)).digest() != one.digest()
    assert build_model(str(path)).provenance().init != one.provenance().init


def test_without_a_dataset_the_command_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "trials"]) == 2
    assert "no dataset" in capsys.readouterr().err
