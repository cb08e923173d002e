"""Limits of rate on the whole application: nobody avoids them, and nobody is kept out by them."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from app_walk import served

from physion.experiment.bearer import read_token
from physion.experiment.study import Limits

TINY = {"familiarization": 1, "test": 1}


@pytest.mark.parametrize("written", [
    b"Bearer  T0k-en_", b"Bearer T0k-en_ ", b"Bearer\tT0k-en_", b" Bearer T0k-en_", b"T0k-en_",
    b"Bearer T0k-en_,", b"Bearer T0k-en_\n", b"BearerT0k-en_", b"Basic T0k-en_", b"Bearer ", b"",
    "Bearer T0k-en_\xa0".encode("latin-1"), "Bearer T0k-en_é".encode(), b"Bearer " + b"x" * 201,
])  # fmt: skip
def test_what_is_malformed_is_no_token(written: bytes) -> None:
    assert read_token([(b"authorization", written)]) == ""


def test_one_header_with_a_token_is_one() -> None:
    for scheme in (b"Bearer", b"bearer"):
        assert read_token([(b"host", b"x"), (b"authorization", scheme + b" T0k-en_")]) == "T0k-en_"
    assert read_token([]) == ""
    assert read_token([(b"authorization", b"Bearer a"), (b"authorization", b"Bearer a")]) == ""


def test_a_token_written_otherwise_avoids_no_limit(tmp_path: Path) -> None:
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
