"""The middleware: limits on size, headers, errors."""

from __future__ import annotations

import contextlib
import json
import logging
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.testclient import TestClient

from physion.experiment.protocol import MAX_BODY
from physion.experiment.study.study import Study
from physion.experiment.web import guards
from physion.experiment.web.guards import Guards, content_policy
from support.experiment.live_app import HOST, exchange, read_all, running

SECRET = "a word of the request that no answer may hold"


async def _echo(request: Request) -> Response:
    return PlainTextResponse(str(len(await request.body())))


async def _swallow(request: Request) -> Response:
    """Turn any error of reading the body into a response, as frameworks do."""
    try:
        return await _echo(request)
    except Exception:
        return PlainTextResponse("could not read", 400)


async def _fail(request: Request) -> Response:
    raise RuntimeError(SECRET)


async def _own_headers(request: Request) -> Response:
    return PlainTextResponse("", headers={"cache-control": "private", "x-own": "1"})


NEEDED: Any = {"name": "n", "version": "1", "title": "t", "contact": "c", "scenarios": ("collide",)}


def make_app(**settings: object) -> Starlette:
    study = Study(
        folder=Path(),
        name="n",
        version="1",
        title="t",
        contact="c",
        scenarios=("collide",),
        **settings,
    )  # type: ignore[arg-type]
    routes = [
        Route("/echo", _echo, methods=["POST", "GET"]),
        Route("/swallow", _swallow, methods=["POST"]),
        Route("/fail", _fail, methods=["POST", "GET"]),
        Route("/own", _own_headers),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Guards, study=study)])


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with running(make_app()) as found:
        yield found


def head(path: str, *lines: str, method: str = "POST") -> bytes:
    return "\r\n".join([f"{method} {path} HTTP/1.1", "Host: x", *lines, "", ""]).encode()


def read(answer: bytes) -> tuple[int, dict[str, str], bytes]:
    start, _, body = answer.partition(b"\r\n\r\n")
    first, *lines = start.decode().split("\r\n")
    pairs = (line.partition(": ") for line in lines)
    return int(first.split()[1]), {name.lower(): value for name, _, value in pairs}, body


def assert_refused(answer: bytes, status: int, error: str) -> None:
    found, headers, body = read(answer)
    assert found == status, answer[:300]
    assert headers["content-type"] == "application/json"
    assert headers["x-content-type-options"] == "nosniff"
    assert json.loads(body)["error"] == error
    assert len(body) == int(headers["content-length"])


class Trickle:
    """Client that sends a body piece by piece and counts what the server read before answering."""

    def __init__(self, port: int, start: bytes, piece: bytes) -> None:
        self.sent = 0
        with socket.create_connection((HOST, port), timeout=10) as connection:
            connection.sendall(start)
            connection.setblocking(False)
            self.answer = b""
            while self.sent < 10_000_000 and not self.answer:
                with contextlib.suppress(BlockingIOError):
                    self.answer = connection.recv(65536)
                    break
                try:
                    self.sent += connection.send(piece[self.sent % len(piece) :])
                except BlockingIOError:
                    time.sleep(0.001)
                except ConnectionError:
                    break
            connection.setblocking(True)
            self.answer += read_all(connection)


class TestBodies:
    def test_a_body_of_the_limit_is_accepted(self, port: int) -> None:
        body = b"x" * MAX_BODY
        answer = exchange(port, head("/echo", f"Content-Length: {len(body)}"), body)
        assert read(answer)[2] == str(MAX_BODY).encode()

    def test_a_declared_length_above_it_is_refused_before_any_of_it(self, port: int) -> None:
        answer = exchange(port, head("/echo", "Content-Length: 10000000"))
        assert_refused(answer, 413, "too_large")
        assert read(answer)[1]["connection"] == "close"

    @pytest.mark.parametrize("path", ["/echo", "/swallow"])
    def test_ten_megabytes_are_refused_without_being_read(self, port: int, path: str) -> None:
        start = head(path, "Content-Length: 10000000")
        trickle = Trickle(port, start, b"x" * 65536)
        assert_refused(trickle.answer, 413, "too_large")
        # Data in the system's buffers have not been read by the server.
        assert trickle.sent < 9_000_000

    @pytest.mark.parametrize("path", ["/echo", "/swallow"])
    def test_chunks_without_an_end_are_refused(self, port: int, path: str) -> None:
        start = head(path, "Transfer-Encoding: chunked")
        trickle = Trickle(port, start, b"4000\r\n" + b"x" * 0x4000 + b"\r\n")
        assert_refused(trickle.answer, 413, "too_large")
        assert trickle.sent < 9_000_000

    @pytest.mark.parametrize("length", ["-1", "1e9", "99999999999999999999", "0x10", "abc", "5, 6"])
    def test_invalid_lengths_are_refused(self, port: int, length: str) -> None:
        answer = exchange(port, head("/echo", f"Content-Length: {length}"), b"xxxxx")
        assert read(answer)[0] in (400, 413)

    def test_a_length_that_is_too_small_gives_no_second_request(self, port: int) -> None:
        answer = exchange(port, head("/echo", "Content-Length: 4"), b"xxxx" + b"y" * 100_000)
        assert answer.count(b"HTTP/1.1 200") <= 1
        assert answer.count(b"HTTP/1.1 400") == 1
        assert answer.count(b"HTTP/1.1 ") <= 2

    def test_a_body_that_does_not_arrive_is_refused(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(guards, "BODY_SECONDS", 0.2)
        monkeypatch.setattr(guards, "LINGER_SECONDS", 0.1)
        with running(make_app()) as port:
            begin = time.monotonic()
            answer = exchange(port, head("/echo", "Content-Length: 50"), b"half")
            assert_refused(answer, 408, "bad_request")
            assert time.monotonic() - begin < 15

    def test_the_connection_stays_open_after_a_good_request(self, port: int) -> None:
        one = head("/echo", "Content-Length: 3") + b"abc"
        answer = exchange(port, one, one)
        assert answer.count(b"HTTP/1.1 200") == 2


class TestHeads:
    def test_a_long_address_is_refused(self, port: int) -> None:
        answer = exchange(port, head("/echo?" + "a" * 5000, method="GET"))
        assert_refused(answer, 413, "too_large")

    @pytest.mark.parametrize("lines", [
        [f"X-{i}: 1" for i in range(100)],
        [f"X-{i}: {'1' * 2000}" for i in range(10)],
    ], ids=["many", "long"])  # fmt: skip
    def test_too_many_or_too_long_headers_are_refused(self, port: int, lines: list[str]) -> None:
        assert_refused(exchange(port, head("/echo", *lines, method="GET")), 413, "too_large")

    def test_websockets_are_refused(self, port: int) -> None:
        lines = ["Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13",
                 "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="]  # fmt: skip
        assert read(exchange(port, head("/echo", *lines, method="GET")))[0] == 200


class TestHeaders:
    def test_every_response_has_them(self) -> None:
        client = TestClient(make_app(), raise_server_exceptions=False)
        large = b"x" * (MAX_BODY + 1)
        answers = [client.get("/echo"), client.get("/nowhere"), client.delete("/echo"),
                   client.get("/fail"), client.post("/echo", content=large)]  # fmt: skip
        assert [answer.status_code for answer in answers] == [200, 404, 405, 500, 413]
        for answer in answers:
            assert answer.headers["content-security-policy"].startswith("default-src 'none'; ")
            assert answer.headers["referrer-policy"] == "no-referrer"
            assert answer.headers["cache-control"] == "no-store"
            assert answer.headers["x-frame-options"] == "DENY"
            assert "strict-transport-security" not in answer.headers

    def test_https_is_kept(self) -> None:
        client = TestClient(make_app(), base_url="https://lab.example.org")
        assert client.get("/echo").headers["strict-transport-security"] == "max-age=31536000"

    def test_headers_of_the_application_are_kept(self) -> None:
        headers = TestClient(make_app()).get("/own").headers
        assert headers["cache-control"] == "private"
        assert headers["x-own"] == "1"
        assert headers["x-content-type-options"] == "nosniff"

    def test_only_named_sites_may_embed_the_pages(self) -> None:
        sites = ("https://www.mturk.com", "https://workersandbox.mturk.com")
        app = make_app(embed_from=sites)
        headers = TestClient(app).get("/echo").headers
        assert f"frame-ancestors {' '.join(sites)};" in headers["content-security-policy"]
        assert "x-frame-options" not in headers

    def test_nothing_inline_and_nothing_from_elsewhere_runs(self) -> None:
        policy = content_policy(
            Study(
                folder=Path(), name="n", version="1", title="t", contact="c", scenarios=("collide",)
            )
        )
        assert "unsafe" not in policy
        assert "http" not in policy
        assert "script-src 'self';" in policy


class TestErrors:
    def test_an_internal_error_reveals_nothing(self, caplog: pytest.LogCaptureFixture) -> None:
        client = TestClient(make_app())
        with caplog.at_level(logging.ERROR, logger="physion.experiment"):
            answer = client.get("/fail?id=5f9c-prolific", headers={"authorization": "Bearer good"})
        assert answer.status_code == 500
        assert set(answer.json()) == {"error", "message", "state", "completion"}
        assert answer.json()["error"] == "server_error"
        assert SECRET not in answer.text and "Traceback" not in answer.text
        # The log has the traceback, but neither the participant nor the token.
        assert SECRET in caplog.text
        assert "prolific" not in caplog.text and "good" not in caplog.text
