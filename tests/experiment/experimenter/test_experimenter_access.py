"""Access to the experimenter's pages: password, cookies, forms of other sites, headers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.experimenter import access
from physion.experiment.experimenter.access import COOKIE, IDLE_TIMEOUT, MAX_DURATION
from physion.experiment.store.database import PAUSES, RAW_IDS
from support.experiment.experimenter_client import BASE, Lab, lab
from support.experiment.store_walk import begin, rows
from support.experiment.tiny_study import PASSWORD

PAGES = ("", "/", "/sessions", "/sessions/abc", "/payments", "/payments.csv", "/export", "?auto=1")
ACTIONS = ("/logout", "/recruitment", "/sessions/abc/void", "/sessions/abc/forget",
           "/payments/forget", "/export")  # fmt: skip


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with lab(tmp_path_factory.mktemp("study")) as found:
        begin(found.store, "5f1e")
        yield found


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_nothing_is_shown_without_login(served: Lab, page: str) -> None:
    for cookie in (None, "wrong", "x" * 5000):
        visitor = served.visitor()
        headers = {} if cookie is None else {"cookie": f"{COOKIE}={cookie}"}
        answer = visitor.get(f"{BASE}{page}", headers=headers, follow_redirects=False)
        assert answer.status_code == 303 and answer.headers["location"] == f"{BASE}/login"
        assert answer.content == b""


@pytest.mark.parametrize("action", ACTIONS)
def test_nothing_is_done_without_login_or_by_a_form_of_another_site(
    served: Lab, action: str
) -> None:
    fields = {"word": "delete", "action": "pause"}
    answer = served.visitor().submit(action, **fields)
    assert answer.status_code == 303 and answer.headers["location"] == f"{BASE}/login"
    visitor = served.experimenter()
    for origin in ("null", "https://evil.example", "http://testserver.evil", "http://testserver:1"):
        answer = visitor.submit(action, origin, **fields)
        assert answer.status_code == 403 and "no longer valid" in answer.text
    assert visitor.post(f"{BASE}{action}", data=fields).status_code == 403, "no origin"
    assert visitor.submit(action, **fields, more="x" * 9000).status_code == 403, "too large"
    origin = {"origin": "http://testserver"}
    assert visitor.post(f"{BASE}{action}", json=fields, headers=origin).status_code == 403
    assert visitor.see().status_code == 200, "still logged in"
    assert rows(served.store, PAUSES) == [] and len(rows(served.store, RAW_IDS)) == 1


def test_only_the_password_logs_in(served: Lab) -> None:
    visitor = served.visitor()
    assert visitor.submit("/login", "https://evil.example", password=PASSWORD).status_code == 403
    for password in ("wrong", "", PASSWORD + " ", PASSWORD.upper(), "\0", "x" * 2000):
        assert visitor.log_in(password).status_code == 403
        assert visitor.see().status_code == 303
    assert visitor.log_in().status_code == 303 and visitor.see().status_code == 200


def test_passwords_are_checked_one_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checks that wait are limited, so that guesses delay nobody for long."""
    go_on = Event()
    monkeypatch.setattr(access, "check_password", lambda *_: go_on.wait(30) and False)
    monkeypatch.setattr(access, "CHECKS_WAITING", 0)
    with lab(tmp_path) as own:
        refused = own.visitor().log_in()
        assert refused.status_code == 429 and "Too many attempts" in refused.text


def test_the_cookie_goes_nowhere_else(served: Lab) -> None:
    for base_url, secure in (("http://testserver", False), ("https://testserver", True)):
        visitor = served.visitor(base_url=base_url)
        tokens = []
        for _ in range(2):
            cookie = visitor.log_in().headers["set-cookie"]
            words = {word.strip().lower() for word in cookie.split(";")[1:]}
            assert {"httponly", "samesite=strict", f"path={BASE}"} <= words
            assert ("secure" in words) == secure and "domain" not in cookie.lower()
            assert PASSWORD not in cookie
            tokens.append(cookie.partition(";")[0])
        assert len(set(tokens)) == 2, "a new token with each login"


def test_logging_out_ends_the_login_on_the_server(served: Lab) -> None:
    visitor = served.experimenter()
    cookie = visitor.cookies[COOKIE]
    assert visitor.submit("/logout").status_code == 303
    assert COOKIE not in visitor.cookies
    again = visitor.get(BASE, headers={"cookie": f"{COOKIE}={cookie}"}, follow_redirects=False)
    assert again.status_code == 303


def test_a_login_ends_when_idle_and_in_any_case(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    now = [1000.0]
    make = access.Access.__init__
    monkeypatch.setattr(access.Access, "__init__", lambda s, keys: make(s, keys, lambda: now[0]))
    with lab(tmp_path) as own:
        visitor = own.experimenter()
        now[0] += IDLE_TIMEOUT
        assert visitor.see("/export").status_code == 200
        now[0] += IDLE_TIMEOUT
        assert visitor.see("?auto=1").status_code == 200
        now[0] += 1
        assert visitor.see("/export").status_code == 303, "pages that refresh do not keep it open"
        visitor.log_in()
        for _ in range(int(MAX_DURATION / IDLE_TIMEOUT)):
            assert visitor.see("/export").status_code == 200
            now[0] += IDLE_TIMEOUT
        now[0] += 1
        assert visitor.see("/export").status_code == 303


def test_every_page_has_a_strict_policy_and_is_not_kept(served: Lab) -> None:
    visitor = served.experimenter()
    for page in ("/login", "", "/sessions", "/sessions/none", "/payments", "/export"):
        answer = visitor.see(page)
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["x-frame-options"] == "DENY"
        assert not re.search(r"<style|\sstyle=|\son\w+=|<script", answer.text)


def test_only_files_of_the_package_are_static(served: Lab) -> None:
    visitor = served.visitor()
    good = visitor.see("/static/experimenter.css")
    assert good.status_code == 200 and good.headers["content-type"].startswith("text/css")
    for name in ("../pages.py", "..%2fpages.py", "pages.py", "%2e%2e/access.py", ""):
        assert visitor.see(f"/static/{name}").status_code in (303, 404)
