"""Rate limits of the whole application: nobody can evade them or be locked out by them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.study import Limits
from physion.experiment.web.api import read_token
from physion.experiment.web.rate_limits import RateLimits
from support.experiment.app_walk import served

TINY = {"familiarization": 1, "test": 1}


@pytest.mark.parametrize("written", [
    b"Bearer  T0k-en_", b"Bearer T0k-en_ ", b"Bearer\tT0k-en_", b" Bearer T0k-en_", b"T0k-en_",
    b"Bearer T0k-en_,", b"Bearer T0k-en_\n", b"BearerT0k-en_", b"Basic T0k-en_", b"Bearer ", b"",
    "Bearer T0k-en_\xa0".encode("latin-1"), "Bearer T0k-en_é".encode(), b"Bearer " + b"x" * 201,
])  # fmt: skip
def test_malformed_headers_are_not_tokens(written: bytes) -> None:
    assert read_token([(b"authorization", written)]) == ""


def test_a_single_valid_header_is_a_token() -> None:
    for scheme in (b"Bearer", b"bearer"):
        assert read_token([(b"host", b"x"), (b"authorization", scheme + b" T0k-en_")]) == "T0k-en_"
    assert read_token([]) == ""
    assert read_token([(b"authorization", b"Bearer a"), (b"authorization", b"Bearer a")]) == ""


def test_a_differently_written_token_evades_no_limit(tmp_path: Path) -> None:
    limits = Limits(requests_per_second=0.1, burst=3)
    with served(tmp_path / "s", limits=limits, **TINY) as site:
        token = site.person(id="hasty").token

        def ask(*values: str) -> int:
            headers = [("authorization", value) for value in values]
            return site.client.get("/api/session", headers=headers).status_code

        assert 429 in [ask(f"Bearer {token}") for _ in range(5)]
        for spaces in range(5):
            around = " " * spaces
            assert ask(f"bearer {around}{token}") in (401, 429)
            assert ask(f"Bearer {token}{around}") in (401, 429)
            assert ask(f"Bearer {token}", f"Bearer {around}{spaces}") in (401, 429)


@pytest.mark.parametrize(("request_", "refusal"), [
    ({"method": "GET", "url": "/api/session"}, 401),
    # An invalid body is refused before its token is looked up.
    ({"method": "POST", "url": "/api/page", "content": b"{}"}, 422),
])  # fmt: skip
def test_unknown_tokens_do_not_slow_down_known_ones(
    tmp_path: Path, request_: dict[str, Any], refusal: int
) -> None:
    with served(tmp_path / "s", **TINY) as site:
        statuses = []
        while not statuses or (statuses[-1] == refusal and len(statuses) < 300):
            headers = {"authorization": f"Bearer invented-{len(statuses)}"}
            statuses.append(site.client.request(headers=headers, **request_).status_code)
        assert len(statuses) > 60 and statuses[-1] == 429
        assert site.person(id="from the same room").state()["stage"] == "consent"


def test_a_class_behind_one_address_enters_at_once() -> None:
    limits = RateLimits(Limits())

    def enter(now: float) -> float:
        return limits.wait_time("POST", "/api/enter", "", "192.0.2.1", now)

    assert [enter(0.0) for _ in range(200)] == [0.0] * 200
    assert enter(0.0) == 1.0
    # A script that continues gets one request per second.
    assert [enter(1.0), enter(1.0), enter(2.0), enter(2.5)] == [0.0, 1.0, 0.0, 0.5]
