"""The export follows Psych-DS, checked by its rules."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pandas as pd
import pytest

from physion.experiment.export.export_study import export_study
from physion.experiment.export.tables import read_tables
from physion.experiment.store.database import PARTICIPANTS, SESSIONS, create_database
from physion.experiment.study.identity import Secrets
from support.experiment.experimenter_rows import insert_sessions
from support.experiment.tiny_study import make_tiny_study

NASTY = '=1+1\t"tab"\n-2;@SUM(1) \\ \r n/a'

Exported = tuple[Path, pd.DataFrame, pd.DataFrame]


def make_export(folder: Path, scenarios: tuple[str, ...]) -> Exported:
    """An export with one participant in all scenarios, and one who is old and writes strangely."""
    study = make_tiny_study(folder, scenarios=scenarios, size=64)
    engine = create_database(folder)
    secrets = Secrets.load(folder)
    insert_sessions(engine, study, secrets, 12)
    insert_sessions(engine, study, secrets, 4, kind="simulated", seed=1, ends=("finished",))
    insert_sessions(engine, study, secrets, 1, seed=2, ends=("finished",), age=99,
                    gender="n/a", education="=other", feedback=NASTY)  # fmt: skip
    whole = insert_sessions(engine, study, secrets, len(scenarios), seed=3, ends=("finished",))
    with engine.begin() as connection:
        one = connection.execute(
            SESSIONS.select().where(SESSIONS.c.session == whole[0])
        ).mappings().one()["participant"]  # fmt: skip
        connection.execute(
            SESSIONS.update().where(SESSIONS.c.session.in_(whole)).values(participant=one)
        )
        assert connection.scalar(PARTICIPANTS.select().where(PARTICIPANTS.c.participant == one))
    export_study(engine, study, folder / "out")
    return (folder / "out", *read_tables(engine, study))


@pytest.fixture(scope="module", params=[("collide",), ("a-b", "a.b", "drop")], ids=["one", "three"])
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return make_export(tmp_path_factory.mktemp("study"), request.param)


@pytest.mark.slow
def test_psych_ds_has_the_files_and_metadata_that_it_asks_for(exported: Exported) -> None:
    folder = exported[0] / "psych-ds"
    metadata = json.loads((folder / "dataset_description.json").read_bytes())
    assert metadata["@type"] == "Dataset" and "schema.org" in metadata["@context"]
    assert all(metadata[key] for key in ("name", "description", "variableMeasured"))
    assert all(entry["@type"] == "PropertyValue" for entry in metadata["variableMeasured"])
    names = [entry["name"] for entry in metadata["variableMeasured"]]
    assert len(set(names)) == len(names)
    assert "Keyed hash" in metadata["variableMeasured"][0]["description"]
    files = list((folder / "data").iterdir())
    assert len(files) == 3
    for path in files:
        assert re.fullmatch(r"([a-z]+-[a-zA-Z0-9]+)(_[a-z]+-[a-zA-Z0-9]+)*_data\.csv", path.name)
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file, strict=True)
        assert rows and all(len(row) == len(header) for row in rows)
        assert set(header) <= set(names)
    # Only what schema.org knows of a PropertyValue, or validators complain.
    known = {"@type", "name", "description", "unitText", "minValue", "maxValue", "valueReference"}
    assert all(set(entry) <= known for entry in metadata["variableMeasured"])
    begin, _, end = metadata["temporalCoverage"].partition("/")
    assert pd.Timestamp(begin) < pd.Timestamp(end)
    assert (folder / "README.md").read_text().startswith("# A tiny study")
