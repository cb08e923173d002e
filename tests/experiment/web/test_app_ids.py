"""Whom a study lets in: patterns of ids, an allow list, and signed links."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.cli.main import main
from physion.core.errors import BadInputError
from physion.experiment.study.recruitment import links
from physion.experiment.study.settings import Recruitment
from physion.experiment.study.study import load_study
from support.experiment.app_walk import Person, Served, served
from support.experiment.tiny_study import make_tiny_study

PROLIFIC = "5f1e6c0a9b3d4e2f7a8b9c0d"


@contextmanager
def strict(folder: Path, prolific_id: str = "", **recruitment: Any) -> Iterator[Served]:
    """Serve a study with these settings of recruitment."""
    settings = {"recruitment": Recruitment(**recruitment), "familiarization": 1, "test": 1}
    with served(folder, prolific_id=prolific_id, **settings) as site:
        yield site


def enter(site: Served, status: int, **asked: Any) -> Any:
    return Person(site.client).ask("POST", "/api/enter", asked, status)


def test_ids_must_have_the_form_of_their_recruiters_ids(tmp_path: Path) -> None:
    assert Recruitment().prolific_id == "[0-9a-fA-F]{24}"
    with strict(tmp_path / "s", Recruitment().prolific_id, sona_id="[0-9]{1,5}") as site:
        for wrong in ("invented-1", PROLIFIC[:-1], PROLIFIC + "0", PROLIFIC + "\n x", "g" * 24):
            assert enter(site, 403, source="prolific", id=wrong)["error"] == "id_refused", wrong
        assert enter(site, 403, source="sona", id="12a")["error"] == "id_refused"
        assert enter(site, 200, source="prolific", id=PROLIFIC)["state"]["stage"] == "consent"
        assert enter(site, 200, source="sona", id="123")["state"]["stage"] == "consent"
        assert enter(site, 200, id="any id in a plain link")["state"]["stage"] == "consent"


def test_with_an_allow_list_nobody_else_takes_part(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "ids.txt").write_text("ada\n\n  grace \nada\n")
    with strict(folder, allow_list="ids.txt") as site:
        assert enter(site, 403, id="eve")["error"] == "id_refused"
        assert enter(site, 200, id="grace")["state"]["stage"] == "consent"
        kept = site.store.engine.connect().exec_driver_sql("SELECT settings FROM studies").scalar()
        assert "grace" not in str(kept)  # the settings are exported
    (folder / "ids.txt").write_text("\n")
    with pytest.raises(BadInputError, match=r"ids\.txt has no id"):
        load_study(folder)


def test_people_enter_by_a_signed_link_only(tmp_path: Path) -> None:
    with strict(tmp_path / "s", signed_links="study") as site:
        assert enter(site, 403, source="sona", id="17")["error"] == "bad_link"
        assert enter(site, 403)["error"] == "bad_link"
        found = {one.name: one.address for one in links(site.study, site.secrets, "http://x")}
        word = parse_qs(urlsplit(found["sona"]).query)["pass"][0]
        person = site.person(source="sona", id="17", **{"pass": word})
        assert person.page("consent")["kind"] == "person"
        assert enter(site, 403, source="mturk", id="17", **{"pass": word})["error"] == "bad_link"
        # The study's key does not open the session in another browser.
        refused = enter(site, 403, source="sona", id="17", **{"pass": word})
        assert refused["error"] == "other_browser"


def test_links_for_people_are_printed_and_open_the_study(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with strict(tmp_path / "s", signed_links="person", sona_id="[0-9]+") as site:
        (tmp_path / "ids.txt").write_text("17\n18\n")
        words = ["experiment", "links", str(site.study.folder), "--ids", str(tmp_path / "ids.txt")]
        assert main([*words, "--source", "sona", "--base-url", "https://a.example"]) == 0
        rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
        assert [row[:2] for row in rows] == [["collide", "17"], ["collide", "18"]]
        query = {key: value[0] for key, value in parse_qs(urlsplit(rows[0][2]).query).items()}
        asked = {"source": "sona", "id": query["id"], "pass": query["pass"]}
        assert enter(site, 200, **asked)["state"]["scenario"] == query["scenario"] == "collide"
        assert enter(site, 200, **asked)["state"]["stage"] == "consent"  # in another browser
        assert enter(site, 403, **{**asked, "id": "18"})["error"] == "bad_link"
        lacking = {one.name: one.lacks for one in links(site.study, site.secrets, "http://x")}
        assert "--ids" in lacking["sona"] and lacking["preview"] == ""
        (tmp_path / "ids.txt").write_text("seventeen\n")
        assert main([*words, "--source", "sona"]) == 2
        assert "does not fit sona_id" in capsys.readouterr().err


def test_a_missing_list_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"none\.txt"):
        make_tiny_study(tmp_path / "s", recruitment=Recruitment(allow_list="none.txt"))
