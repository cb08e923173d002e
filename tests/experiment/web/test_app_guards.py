"""The middleware: limits on size and rate, headers, errors."""

from __future__ import annotations

import contextlib
import json
import logging
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.web.rate_limits import Buckets, RateLimits, network_of
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.testclient import TestClient

from physion.experiment.protocol import MAX_BODY
from physion.experiment.study.study import Limits, Study
from physion.experiment.web import connections, guards
from physion.experiment.web.guards import Guards, content_policy
from support.experiment.live_app import HOST, exchange, read_all, running

TOKENS = {"good", "other"}
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


async def _session(request: Request) -> Response:
    token = request.headers.get("authorization", "").removeprefix("Bearer ")
    return PlainTextResponse("", 200 if token in TOKENS else 401)


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
        Route("/api/session", _session),
        Route("/api/enter", _echo, methods=["POST"]),
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

    def test_a_flood_of_headers_fills_no_memory(self, port: int) -> None:
        trickle = Trickle(port, b"GET / HTTP/1.1\r\n", b"X-Flood: " + b"f" * 1000 + b"\r\n")
        assert trickle.answer.startswith(b"HTTP/1.1 431")
        assert trickle.sent < 9_000_000

    def test_one_header_without_an_end_fills_no_memory(self, port: int) -> None:
        trickle = Trickle(port, b"GET / HTTP/1.1\r\nX-Flood: ", b"f" * 10_000)
        assert trickle.answer.startswith((b"HTTP/1.1 431", b"HTTP/1.1 400"))
        assert trickle.sent < 9_000_000

    def test_silent_connections_are_closed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(connections, "HEAD_SECONDS", 1.0)
        with running(make_app()) as port:
            for start in (b"", b"GET /echo HT"):
                with socket.create_connection((HOST, port), timeout=30) as connection:
                    connection.sendall(start)
                    assert connection.recv(10) == b""
            # This does not end a running request or one that was answered.
            with socket.create_connection((HOST, port), timeout=30) as connection:
                for _ in range(2):
                    connection.sendall(head("/echo", method="GET"))
                    assert connection.recv(65536).startswith(b"HTTP/1.1 200")
                    time.sleep(1.5)

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


class TestRates:
    def test_a_bucket_refills_at_a_steady_rate(self) -> None:
        buckets = Buckets(rate=2.0, burst=3.0)
        assert [buckets.take("a", 0.0) for _ in range(4)] == [0.0, 0.0, 0.0, 0.5]
        assert buckets.take("b", 0.0) == 0.0
        assert buckets.take("a", 0.25) == pytest.approx(0.25)
        assert buckets.take("a", 0.5) == 0.0
        assert [buckets.take("a", 1000.0) for _ in range(4)][2:] == [0.0, 0.5]

    def test_memory_is_bounded(self) -> None:
        buckets = Buckets(rate=1.0, burst=1.0, most=100)
        for number in range(1000):
            buckets.take(str(number), float(number))
        assert len(buckets) == 100
        assert "999" in buckets and "899" not in buckets

    def test_a_session_that_asks_too_fast_waits(self) -> None:
        limits = Limits(requests_per_second=0.1, burst=5)
        client = TestClient(make_app(limits=limits))

        def ask(token: str) -> int:
            headers = {"authorization": f"Bearer {token}"}
            return client.get("/api/session", headers=headers).status_code

        assert [ask("good") for _ in range(7)] == [200] * 5 + [429] * 2
        assert ask("other") == 200
        answer = client.get("/api/session", headers={"authorization": "Bearer good"})
        assert 1 <= int(answer.headers["retry-after"]) <= 10
        assert answer.json()["error"] == "too_many"
        assert answer.headers["cache-control"] == "no-store"

    def test_invented_tokens_fill_no_memory_and_are_slowed_down(self) -> None:
        limits = RateLimits(Limits())
        statuses = []
        for number in range(200):
            wait = limits.wait_time("GET", "/api/session", f"wrong{number}", "1.2.3.4", 0.0)
            statuses.append(wait > 0)
            if not wait:
                limits.record_status(401, "/api/session", f"wrong{number}", "1.2.3.4", 0.0)
        assert statuses.index(True) == 60 and all(statuses[60:])
        assert len(limits._tokens) == 0
        assert limits.wait_time("GET", "/api/session", "wrong", "5.6.7.8", 0.0) == 0
        # Known tokens of the same address are not limited.
        limits.record_status(200, "/api/session", "good", "1.2.3.4", 0.0)
        assert limits.wait_time("GET", "/api/session", "good", "1.2.3.4", 0.0) == 0

    def test_new_sessions_are_counted_by_address(self) -> None:
        limits = Limits(sessions_per_minute=1, sessions_at_once=3)
        client = TestClient(make_app(limits=limits), client=("9.9.9.9", 1))
        assert [client.post("/api/enter").status_code for _ in range(4)] == [200] * 3 + [429]
        assert client.get("/echo").status_code == 200

    def test_a_refused_body_is_read_so_that_the_connection_stays_open(self) -> None:
        limits = Limits(sessions_per_minute=1, sessions_at_once=1)
        with running(make_app(limits=limits)) as port:
            one = head("/api/enter", "Content-Length: 60000") + b"x" * 60000
            answer = exchange(port, one, one, head("/echo", method="GET"))
            assert re.findall(rb"HTTP/1.1 (\d+)", answer) == [b"200", b"429", b"200"]

    @pytest.mark.parametrize(("address", "network"), [
        ("1.2.3.4", "1.2.3.4"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("::ffff:1.2.3.4", "1.2.3.4"),
        ("fe80::1%eth0", "fe80::/64"),
        ("no:address", "no:address"),
        ("", ""),
    ])  # fmt: skip
    def test_a_household_of_ipv6_is_one_address(self, address: str, network: str) -> None:
        assert network_of(address) == network
