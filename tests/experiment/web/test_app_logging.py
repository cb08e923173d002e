"""The server's log: each event once, what an operator needs, and no personal data."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from support.experiment.app_walk import served
from support.experiment.experimenter_client import lab

ALL = "physion.experiment"


def test_a_request_is_one_line_without_its_query(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with (
        served(tmp_path / "s", familiarization=1, test=1) as site,
        caplog.at_level(logging.INFO, logger=ALL),
    ):
        site.client.get("/api/study?PROLIFIC_PID=5f0c")
        site.client.get("/static/%0Aforged line")
    assert [message for _, _, message in caplog.record_tuples if "/" in message] == [
        "GET /api/study 200", "GET /static/%0Aforged%20line 404"
    ]  # fmt: skip


def test_a_missing_movie_is_named_only_in_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with served(tmp_path / "s", familiarization=1, test=1) as site:
        shown = site.study.phase("collide", "familiarization")[0]
        (site.study.folder / shown.movie).unlink()
        person = site.person(id="watcher").walk("familiarization")
        movie = person.ask("GET", "/api/trials/familiarization")["trials"][0]["movie"]
        answer = site.client.get(movie)
    assert answer.status_code == 404 and answer.json()["error"] == "not_found"
    assert "missing on the server" in answer.json()["message"]
    assert Path(shown.movie).name not in answer.text
    assert [(record.levelname, record.exc_info) for record in caplog.records] == [("ERROR", None)]
    assert f"{shown.movie} is missing" in caplog.text


def test_logins_are_logged_without_addresses(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with (
        lab(tmp_path / "s", test=1) as found,
        caplog.at_level(logging.INFO, logger=f"{ALL}.experimenter"),
    ):
        visitor = found.visitor(address="198.51.100.23")
        assert visitor.log_in("wrong").status_code == 403
        assert visitor.log_in().status_code == 303
    own = [record for record in caplog.records if record.name.startswith(f"{ALL}.experimenter")]
    assert [record.levelname for record in own] == ["WARNING", "INFO"]
    assert "198.51" not in caplog.text
