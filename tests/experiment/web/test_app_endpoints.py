"""Every endpoint: accepted requests, responses and refusals."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

import sqlalchemy as sa
from sqlalchemy.exc import OperationalError

from physion.experiment import protocol as wire
from physion.experiment.protocol import PublicStudy
from physion.experiment.store.database import ANSWERS, RAW_IDS, SESSIONS
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import Recruitment
from support.experiment.app_walk import Person, Served, answer_body, served

TRIALS = {"familiarization": 2, "test": 3}
OPEN = ("study", "texts/en", "enter", "health")
WITH_TOKEN = [
    ("GET", "/api/session", None),
    ("GET", "/api/trials/test", None),
    ("POST", "/api/page", {"page": "consent", "data": {"agreed": True}}),
    ("POST", "/api/showings", {"key": "a-showing-1", "phase": "test", "trial": 0}),
    ("POST", "/api/answers", answer_body(0)),
    ("POST", "/api/events", {"events": []}),
    ("GET", "/api/result", None),
]  # fmt: skip


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(
        tmp_path_factory.mktemp("app") / "study", scenarios=("collide", "drop"), **TRIALS,
        recruitment=Recruitment(prolific_code="C0DE"), percentile_from=1, participants=1000,
    ) as found:  # fmt: skip
        yield found


def refused(answer: Any, status: int, error: str) -> dict[str, Any]:
    """Return the refusal in a response, which has exactly the fields of `Refusal`."""
    assert answer.status_code == status, answer.text[:300]
    refusal = wire.Refusal.model_validate_json(answer.content)
    assert refusal.error == error
    assert "Traceback" not in answer.text
    return refusal.model_dump()


class TestWithoutASession:
    def test_the_page_is_served(self, site: Served) -> None:
        answer = site.client.get("/")
        assert answer.headers["content-type"] == "text/html; charset=utf-8"
        assert answer.text.startswith("<!doctype html>")
        assert site.client.head("/").status_code == 200  # as monitors ask

    def test_an_unchanged_file_is_not_sent_again(self, site: Served) -> None:
        first = site.client.get("/static/main.js")
        headers = {"if-none-match": first.headers["etag"]}
        again = site.client.get("/static/main.js", headers=headers)
        assert (again.status_code, again.content) == (304, b"")
        assert again.headers["content-security-policy"]

    def test_files_are_compressed_for_browsers_that_accept_it(self, site: Served) -> None:
        path = "/static/vendor/jspsych.min.js"
        plain = site.client.get(path, headers={"accept-encoding": "identity"})
        packed = site.client.get(path, headers={"accept-encoding": "gzip"})
        assert "content-encoding" not in plain.headers
        assert packed.headers["content-encoding"] == "gzip"
        assert int(packed.headers["content-length"]) < len(plain.content) / 2
        assert packed.content == plain.content

    def test_public_settings(self, site: Served) -> None:
        study = PublicStudy.model_validate_json(site.client.get("/api/study").content)
        assert study.scenarios == ["collide", "drop"]
        assert set(study.example) == {"collide", "drop"}
        assert [one.source for one in study.recruiters] == ["prolific", "mturk", "sona", "link"]
        example = study.example["drop"]
        assert site.client.get(example.movie).headers["content-type"] == "video/mp4"
        assert site.client.get(example.map).headers["content-type"] == "image/png"

    def test_texts(self, site: Served) -> None:
        assert site.client.get("/api/texts/de").json() == dict(site.study.texts["de"])
        refused(site.client.get("/api/texts/xx"), 404, "not_found")

    def test_health(self, site: Served, monkeypatch: pytest.MonkeyPatch) -> None:
        assert site.client.get("/api/health").json() == {"ok": True}
        assert site.client.head("/api/health").status_code == 200

        def fail(*arguments: Any) -> Any:
            raise OperationalError("connect", None, Exception("secret database host"))

        monkeypatch.setattr(type(site.store.engine), "connect", fail)
        refused(site.client.get("/api/health"), 503, "unavailable")
        assert "secret" not in site.client.get("/api/health").text

    @pytest.mark.parametrize(("method", "path", "body"), WITH_TOKEN)
    @pytest.mark.parametrize("header", [
        None, "", "Bearer", "Bearer ", "Bearer nobody", "Basic eDp5", "Bearer " + "x" * 300,
        "Bearer ' OR 1=1 --",
    ])  # fmt: skip
    def test_session_endpoints_need_a_token(
        self, site: Served, method: str, path: str, body: Any, header: str | None
    ) -> None:
        headers = {} if header is None else {"authorization": header}
        answer = site.client.request(method, path, json=body, headers=headers)
        assert answer.status_code in (401, 429)
        if answer.status_code == 401:
            refused(answer, 401, "unknown_token")

    def test_other_endpoints_need_no_token(self, site: Served) -> None:
        for name in ("study", "texts/en", "health"):
            assert site.client.get(f"/api/{name}").status_code == 200
        for path in ("/docs", "/redoc", "/openapi.json"):
            refused(site.client.get(path), 404, "not_found")

    @pytest.mark.parametrize("path", [
        "/nowhere", "/api", "/api/", "/api/nowhere", "/api/session/", "/static", "/static/",
        "/static/nowhere.js", "/media", "/media/", "/favicon.ico",
    ])  # fmt: skip
    def test_unknown_addresses(self, site: Served, path: str) -> None:
        refused(site.client.get(path, follow_redirects=False), 404, "not_found")

    @pytest.mark.parametrize(("method", "path"), [
        ("DELETE", "/api/session"), ("PUT", "/api/answers"), ("GET", "/api/answers"),
        ("POST", "/api/study"), ("PATCH", "/"), ("TRACE", "/"), ("BREW", "/api/session"),
        ("POST", "/static/main.js"), ("OPTIONS", "/api/enter"),
    ])  # fmt: skip
    def test_odd_methods(self, site: Served, method: str, path: str) -> None:
        answer = site.client.request(method, path)
        refused(answer, 405, "not_allowed")
        assert "access-control-allow-origin" not in answer.headers


class TestSession:
    def test_a_whole_session(self, site: Served) -> None:
        person = site.person(source="prolific", id="p-whole", scenario="collide",
                             recruiter={"STUDY_ID": "s", "SESSION_ID": "v"})  # fmt: skip
        assert wire.Entered.model_validate(person.last).state.stage == "consent"
        person.ask("GET", "/api/session?load=true")
        person.ask("GET", "/api/trials/test", status=403)
        person.page("consent")
        listed = wire.TrialList.model_validate(person.ask("GET", "/api/trials/test"))
        assert [trial.trial for trial in listed.trials] == [0, 1, 2]
        person.page("instructions")
        for trial in range(TRIALS["familiarization"]):
            stored = wire.AnswerStored.model_validate(person.answer(trial, "familiarization"))
            assert stored.feedback is not None and not stored.duplicate
            assert stored.feedback.contact == (trial % 2 == 0)
            movie = site.client.get(stored.feedback.movie)
            assert movie.headers["content-type"] == "video/mp4"
        person.page("ready")
        for trial in range(TRIALS["test"]):
            stored = wire.AnswerStored.model_validate(person.answer(trial))
            assert stored.feedback is None
        person.ask("GET", "/api/result", status=403)
        person.page("demographics")
        person.page("feedback")
        result = wire.Result.model_validate(person.ask("GET", "/api/result"))
        assert (result.trials, result.correct, result.percentile) == (
            3,
            2,
            None,
        )  # no other participants
        site.person(id="p-other", scenario="collide").walk("done")
        result = wire.Result.model_validate(person.ask("GET", "/api/result"))
        assert result.percentile == 50
        assert result.completion.code == "C0DE"
        assert result.completion.url == "https://app.prolific.com/submissions/complete?cc=C0DE"
        refusal = person.ask(
            "POST", "/api/enter", {"source": "prolific", "id": "p-whole", "scenario": "collide"},
            status=409,
        )  # fmt: skip
        assert refusal["error"] == "already_took_part"

    def test_the_same_answer_twice_is_one(self, site: Served) -> None:
        person = site.person().walk("test")
        assert not person.answer(0)["duplicate"]
        assert person.answer(0)["duplicate"]
        assert person.answer(0, key="another-key", status=409)["error"] == "already_answered"
        refusal = person.answer(2, status=409)
        assert refusal["error"] == "out_of_order"
        assert refusal["state"]["trial"] == 1

    def test_a_second_browser_continues_by_a_signed_link_only(self, site: Served) -> None:
        who = {"source": "sona", "id": "1234", "scenario": "drop"}
        first = site.person(**who).walk("test")
        first.answer(0)
        refused = Person(site.client).ask("POST", "/api/enter", who, 403)
        assert refused["error"] == "other_browser" and refused["state"] is None
        other = make_pass(site.secrets, "person", "sona", "1235")
        Person(site.client).ask("POST", "/api/enter", {**who, "pass": other}, 403)
        own = make_pass(site.secrets, "person", "sona", "1234")
        second = site.person(**who, visit="another-browser-0001", **{"pass": own})
        assert second.last["state"]["trial"] == 1
        assert second.token != first.token
        assert second.answer(1)["state"]["trial"] == first.state()["trial"] == 2
        # The first browser, which has a token, need not have kept its key.
        assert first.ask("POST", "/api/enter", who)["state"]["trial"] == 2

    def test_a_token_opens_only_its_session(self, site: Served) -> None:
        one, two = site.person().walk("test"), site.person().walk("test")
        one.answer(0)
        assert two.state()["trial"] == 0
        assert one.state()["reference"] != two.state()["reference"]

    def test_events(self, site: Served) -> None:
        person = site.person().walk("instructions")
        events = [{"kind": "hidden", "at_ms": 12.5, "data": {"why": "tab", "n": 2, "x": None}}]
        assert person.ask("POST", "/api/events", {"events": events}) == {"stored": 1}

    def test_withdrawal_ends_everything(self, site: Served) -> None:
        person = site.person().walk("test")
        assert person.page("withdraw")["stage"] == "withdrawn"
        assert person.answer(0, status=409)["error"] == "wrong_stage"
        person.ask("GET", "/api/trials/test", status=409)
        person.ask("GET", "/api/result", status=409)

    def test_ids_are_stored_apart(self, site: Served) -> None:
        person = site.person(source="prolific", id="raw-id-1", recruiter={"STUDY_ID": "st"})
        person.page("consent")
        with site.store.engine.connect() as connection:
            sessions = connection.execute(sa.select(SESSIONS)).all()
            raw = connection.execute(sa.select(RAW_IDS).where(RAW_IDS.c.raw_id == "raw-id-1")).one()
        assert not any("raw-id-1" in str(row) for row in sessions)
        assert raw.recruiter == {"STUDY_ID": "st"}
        assert "raw-id-1" not in str([answer.text for _, answer in person.heard])

    def test_mturk_preview_begins_nothing(self, site: Served) -> None:
        with site.store.engine.connect() as connection:
            before = connection.scalar(sa.select(sa.func.count()).select_from(SESSIONS))
        preview = {"assignmentId": "ASSIGNMENT_ID_NOT_AVAILABLE", "hitId": "h"}
        for more in ({}, {"id": "w1"}):
            body = {"source": "mturk", "recruiter": preview, **more}
            refused(site.client.post("/api/enter", json=body), 403, "not_yet")
        with site.store.engine.connect() as connection:
            after = connection.scalar(sa.select(sa.func.count()).select_from(SESSIONS))
        assert before == after

    def test_answers_are_stored_as_sent(self, site: Served) -> None:
        person = site.person(source="link", id="stored").walk("test")
        person.answer(0, response="no", rt_ms=1234.5, input="touch", frames_shown=44)
        with site.store.engine.connect() as connection:
            row = connection.execute(
                sa.select(ANSWERS).join(SESSIONS).where(
                    SESSIONS.c.reference == person.state()["reference"], ANSWERS.c.phase == "test"
                )
            ).one()  # fmt: skip
        assert (row.response, row.rt_ms, row.input, row.frames_shown) == ("no", 1234.5, "touch", 44)

    def test_entering_refuses_unknown_fields(self, site: Served) -> None:
        person = Person(site.client)
        assert person.ask("POST", "/api/enter", {"kind": "preview"}, 422)["error"] == "bad_request"
        assert person.ask("POST", "/api/enter", {"pass": "preview-0"}, 403)["error"] == "bad_link"
        assert person.ask("POST", "/api/enter", {"pass_": "x"}, 403)["error"] == "bad_link"
        assert person.ask("POST", "/api/enter", {"source": "prolific"}, 403)["error"] == "id_needed"
        assert person.ask("POST", "/api/enter", {"scenario": "x"}, 403)["error"] == "bad_link"
