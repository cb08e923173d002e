"""Hostile requests: they are refused uniformly, store nothing and reveal nothing."""

from __future__ import annotations

import contextlib
import json
import socket
import time
from collections.abc import Iterator
from typing import Any
from urllib.parse import quote

import pytest
import sqlalchemy as sa

from physion.experiment import protocol as wire
from physion.experiment.store.database import ANSWERS, EVENTS, RAW_IDS, SESSIONS
from support.experiment.app_walk import Person, Served, answer_body, served
from support.experiment.live_app import HOST, exchange, read_all, running

NASTY = (
    "<script>alert(1)</script>",
    "'; DROP TABLE answers; --",
    '" OR ""="',
    "=cmd|' /C calc'!A0",
    "../../secret.json",
    "{7*7} {%7*7%} $(7*7) %s %(x)s",
    "a\r\nSet-Cookie: x=1",
    "\u202eright to left\u0085\ufeff",
    "\U0001f41b" * 20,
)
DEEP = "[" * 30_000 + "]" * 30_000


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("hostile") / "study"
    with served(folder, familiarization=1, test=3, participants=10_000) as found:
        yield found


@pytest.fixture(scope="module")
def tester(site: Served) -> Person:
    """A person at the first test trial, who stays there in these tests."""
    return site.person(id="tester").walk("test")


def counts(site: Served) -> dict[str, int]:
    """Count the rows of each table."""
    with site.store.engine.connect() as connection:
        return {
            table.name: connection.scalar(sa.select(sa.func.count()).select_from(table)) or 0
            for table in (SESSIONS, ANSWERS, EVENTS, RAW_IDS)
        }


def assert_refused(answer: Any, status: int = 422, error: str = "bad_request") -> str:
    """Check that a response is a short refusal and return its message."""
    assert answer.status_code == status, answer.text[:300]
    refusal = wire.Refusal.model_validate_json(answer.content)
    assert refusal.error == error
    assert len(answer.content) < 1500
    assert "Traceback" not in answer.text and "<" not in refusal.message
    return refusal.message


def post(person: Person, path: str, content: bytes, kind: str | None = "application/json") -> Any:
    headers = {"authorization": f"Bearer {person.token}"}
    if kind is not None:
        headers["content-type"] = kind
    return person.client.post(path, content=content, headers=headers)


def changed(**values: Any) -> bytes:
    return json.dumps({**answer_body(0), **values}).encode()


BODIES = {
    "no JSON": b"response=yes",
    "invalid UTF-8": changed().replace(b"yes", b"y\xffs"),
    "deep": DEEP.encode(),
    "NaN": changed(rt_ms=float("nan")),
    "beyond a double in details": changed(details={"x": 12321}).replace(b"12321", b"1e999"),
    "digits beyond reading": changed().replace(b"812.5", b"1" * 10_000),
    "NUL": changed(details={"x": "a\x00b"}),
    "half a character": changed(details={"x": "\ud800"}),
}
VALUES: dict[str, dict[str, Any]] = {
    "time beyond a day": {"rt_ms": 86_400_001},
    "time as text": {"rt_ms": "812.5"},
    "unknown input": {"input": "<script>"},
    "key with an end of line": {"key": "abcdefgh\n"},
    "too many details": {"details": {str(number): 0 for number in range(31)}},
    "too long details": {"details": {"x": "y" * 17_000}},
    "a long name in details": {"details": {"n" * 201: 1}},
    "correct": {"correct": True},
}


class TestAnswers:
    @pytest.mark.parametrize("name", BODIES)
    def test_bodies_that_are_not_messages(self, site: Served, tester: Person, name: str) -> None:
        before = counts(site)
        assert_refused(post(tester, "/api/answers", BODIES[name]))
        assert counts(site) == before and tester.state()["trial"] == 0

    @pytest.mark.parametrize("name", VALUES)
    def test_invalid_answers(self, site: Served, tester: Person, name: str) -> None:
        before = counts(site)
        message = assert_refused(post(tester, "/api/answers", changed(**VALUES[name])))
        field = next(iter(VALUES[name]))
        assert field[:4].strip("<") in message, "the refusal says where"
        assert counts(site) == before and tester.state()["trial"] == 0

    @pytest.mark.parametrize("kind", [None, "text/plain", "text/html; application/json"])
    def test_other_content_types(self, tester: Person, kind: str | None) -> None:
        """This also blocks forms of other sites, which can only send these content types."""
        assert_refused(post(tester, "/api/answers", changed(), kind))
        assert tester.state()["trial"] == 0

    def test_refusals_repeat_no_value(self, tester: Person) -> None:
        marker = "<b>marker</b>" + "m" * 10_000
        for field in ("response", "key", "rt_ms", "phase", "details"):
            answer = post(tester, "/api/answers", changed(**{field: marker}))
            assert "marker" not in answer.text and "mmm" not in answer.text


EVENT = {"kind": "hidden", "at_ms": 1}


class TestEverythingElse:
    @pytest.mark.parametrize(("path", "body"), [
        ("enter", {"id": " "}), ("enter", {"source": "facebook"}), ("enter", {"kind": "simulated"}),
        ("enter", {"recruiter": {str(i): "" for i in range(11)}}),
        ("enter", {"device": {"refresh_hz": -60}}),
        *(("enter", {"visit": key}) for key in
          ("", "a" * 15, "a" * 65, "a" * 16 + "_", "ä" * 20, "a" * 20 + "\n")),
        *(("events", {"events": [EVENT, bad]}) for bad in (
            {"kind": "<script>", "at_ms": 1}, {"kind": "ok", "at_ms": -1}, {"kind": "ok"}, None,
            {"kind": "ok", "at_ms": 1, "data": {"a": {"b": 1}}},
        )),
        ("events", {"events": [EVENT] * 51}),
        *((path, None) for path in ("enter", "page", "events")),
    ])  # fmt: skip
    def test_bodies_of_other_endpoints(
        self, site: Served, tester: Person, path: str, body: Any
    ) -> None:
        before = counts(site)
        content = BODIES["deep"] if body is None else json.dumps(body).encode()
        assert_refused(post(tester, f"/api/{path}", content))
        assert counts(site) == before

    def test_an_unknown_page_is_named_by_its_field_with_the_known_ones(self, site: Served) -> None:
        body = {"page": "nowhere", "data": {}}
        message = assert_refused(site.client.post("/api/page", json=body))
        assert message.startswith("page: ") and "'consent'" in message and "?" not in message

    @pytest.mark.parametrize("query", ["load=true&load=false", "%ff=%fe"])
    def test_queries(self, tester: Person, query: str) -> None:
        assert tester.ask("GET", f"/api/session?{query}")["stage"] == "test"


class TestTexts:
    @pytest.mark.parametrize("text", NASTY)
    def test_every_text_is_stored_as_it_is_and_does_nothing(self, site: Served, text: str) -> None:
        person = site.person(
            id=text.strip(), language="en", recruiter={text.strip()[:100]: text},
            device={"user_agent": text},
        )  # fmt: skip
        person.walk("test")
        for trial in range(3):
            person.answer(trial, details={text[:100]: text})
        person.ask("POST", "/api/events",
                   {"events": [{"kind": "error", "at_ms": 1, "data": {"text": text}}]})  # fmt: skip
        person.page("demographics", age=30, gender=text, education=text)
        person.page("feedback", difficulty=1, technical_problems=False, text=text)
        reference = person.state()["reference"]
        with site.store.engine.connect() as connection:
            session = connection.execute(
                sa.select(SESSIONS).where(SESSIONS.c.reference == reference)
            ).one()
            answers = connection.execute(
                sa.select(ANSWERS).where(ANSWERS.c.session == session.session)
            ).all()
            raw = connection.execute(
                sa.select(RAW_IDS).where(RAW_IDS.c.participant == session.participant)
            ).one()
        assert (session.gender, session.feedback) == (text.strip(), text.strip())
        assert session.device["user_agent"] == text
        assert (raw.raw_id, list(raw.recruiter.values())) == (text.strip(), [text])
        assert len(answers) == 4
        assert json.loads(answers[-1].details) == {text[:100]: text}
        for _, answer in person.heard:
            assert text not in answer.text
            assert "set-cookie" not in answer.headers

    @pytest.mark.parametrize("text", NASTY)
    def test_texts_where_names_are_expected(self, site: Served, text: str) -> None:
        refused = [({"scenario": text}, "bad_link"), ({"pass": text}, "bad_link"),
                   ({"source": text}, "bad_request")]  # fmt: skip
        for body, error in refused:
            answer = site.client.post("/api/enter", json=body)
            assert_refused(answer, wire.REFUSALS[error], error)
        for path in ("/api/texts/{}", "/api/trials/{}", "/static/{}", "/media/{}"):
            answer = site.client.get(path.format(quote(text, safe="")))
            assert_refused(answer, 404, "not_found")


TRAVERSALS = (
    "/static/../../study.py", "/static/%2e%2e/%2e%2e/study.py", "/static/..%5c..%5cstudy.py",
    "/static/%2fetc%2fpasswd", "/static/main.js%00.css", "/static/%252e%252e/study.py",
    "/media/%2e%2e%2fsecret.json", "/media/%2fetc%2fpasswd", "//etc/passwd", "/%ff%fe",
    "/experimenter/static/..%2f..%2fgate.py",
)  # fmt: skip


@pytest.fixture(scope="module")
def port(site: Served) -> Iterator[int]:
    with running(site.client.app) as found:
        yield found


def head(*lines: str) -> bytes:
    """Return the head of a request to submit a page."""
    first = ("POST /api/page HTTP/1.1", "Host: x", "Content-Type: application/json")
    return "\r\n".join([*first, *lines, "", ""]).encode()


def send_without_end(port: int, start: bytes, piece: bytes) -> tuple[int, bytes]:
    """Send a body piece by piece until there is a response; return what was sent and said."""
    sent = 0
    with socket.create_connection((HOST, port), timeout=10) as connection:
        connection.sendall(start)
        connection.setblocking(False)
        while sent < 10_000_000:
            with contextlib.suppress(BlockingIOError):
                answer = connection.recv(65536)
                connection.setblocking(True)
                return sent, answer + read_all(connection)
            try:
                sent += connection.send(piece[sent % len(piece) :])
            except BlockingIOError:
                time.sleep(0.001)
            except ConnectionError:
                break
    return sent, b""


class TestBodies:
    def test_a_body_above_the_limit_is_refused_before_any_of_it(self, port: int) -> None:
        answer = exchange(port, head("Content-Length: 65537"))
        assert answer.startswith(b"HTTP/1.1 413") and b'"error":"too_large"' in answer
        assert b"connection: close" in answer
        body = b" " * 65_536
        assert exchange(port, head("Content-Length: 65536"), body).startswith(b"HTTP/1.1 422")

    @pytest.mark.parametrize(("line", "piece"), [
        ("Content-Length: 10000000", b"x" * 65536),
        ("Transfer-Encoding: chunked", b"4000\r\n" + b"x" * 0x4000 + b"\r\n"),
    ])  # fmt: skip
    def test_ten_megabytes_are_not_read(self, port: int, line: str, piece: bytes) -> None:
        sent, answer = send_without_end(port, head(line), piece)
        assert answer.startswith(b"HTTP/1.1 413") or not answer
        assert sent < 9_000_000  # data in the system's buffers have not been read by the server


class TestRawRequests:
    """Raw requests that no client library sends, on a real server."""

    @pytest.mark.parametrize("path", TRAVERSALS)
    def test_no_path_leaves_the_folders(self, port: int, path: str) -> None:
        rest = b" HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"
        answer = exchange(port, b"GET " + path.encode() + rest)
        assert answer.startswith((b"HTTP/1.1 404", b"HTTP/1.1 400", b"HTTP/1.1 303"))
        assert b"root:" not in answer and b"import" not in answer and b"hash_key" not in answer

    def test_a_forged_host_appears_nowhere(self, port: int) -> None:
        for path in (b"/", b"/api/session/", b"/static", b"/experimenter"):
            answer = exchange(
                port, b"GET " + path + b" HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n"
                b"X-Forwarded-Host: evil.example\r\nX-Forwarded-For: 1.1.1.1\r\n\r\n"
            )  # fmt: skip
            assert b"evil.example" not in answer
