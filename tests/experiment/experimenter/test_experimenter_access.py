"""Access to the experimenter's pages: password, waits, cookies, form tokens, headers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.experimenter import access
from physion.experiment.experimenter.access import COOKIE, IDLE_TIMEOUT, MAX_DURATION
from physion.experiment.study.identity import Secrets, check_password, set_password
from support.experiment.experimenter_client import BASE, Lab, lab
from support.experiment.tiny_study import PASSWORD

PAGES = ("", "/", "/sessions", "/sessions/abc", "/payments", "/payments.csv", "/export", "?auto=1")
ACTIONS = ("/logout", "/recruitment", "/sessions/abc/void", "/sessions/abc/forget",
           "/payments/forget", "/export")  # fmt: skip


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with lab(tmp_path_factory.mktemp("study")) as found:
        yield found


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Replace the clock of the access by a list with one constant time."""
    now = [1000.0]
    original = access.Access.__init__
    monkeypatch.setattr(
        access.Access, "__init__", lambda self, read: original(self, read, lambda: now[0])
    )
    return now


@pytest.mark.parametrize("page", PAGES)
def test_nothing_is_shown_without_login(served: Lab, page: str) -> None:
    for cookie in (None, "wrong", "x" * 5000):
        visitor = served.visitor()
        headers = {} if cookie is None else {"cookie": f"{COOKIE}={cookie}"}
        answer = visitor.get(f"{BASE}{page}", headers=headers, follow_redirects=False)
        assert answer.status_code == 303 and answer.headers["location"] == f"{BASE}/login"
        assert answer.content == b""


@pytest.mark.parametrize("action", ACTIONS)
def test_nothing_is_done_without_login_and_without_the_token_of_the_browser(
    served: Lab, action: str
) -> None:
    fields = {"password": PASSWORD, "word": "delete", "action": "pause"}
    visitor = served.visitor()
    answer = visitor.submit(action, visitor.token(), **fields)
    assert answer.status_code == 303 and answer.headers["location"] == f"{BASE}/login"
    visitor = served.experimenter()
    for token in (None, "", "0" * 64, "é", served.experimenter().token("/export")):
        answer = visitor.submit(action, token, **fields)
        assert answer.status_code == 403 and "no longer valid" in answer.text
    assert visitor.see().status_code == 200, "still logged in"


def test_the_login_form_needs_its_token_too(served: Lab) -> None:
    visitor, other = served.visitor(), served.visitor()
    visitor.token()
    for token in (None, "0" * 64, other.token()):
        answer = visitor.submit("/login", token, password=PASSWORD)
        assert answer.status_code == 403 and visitor.see().status_code == 303


def test_forms_of_another_type_or_size_are_refused(served: Lab) -> None:
    visitor = served.experimenter()
    token = visitor.token("/export")
    assert visitor.submit("/recruitment", token, action="pause", more="x" * 9000).status_code == 403
    json = visitor.post(f"{BASE}/recruitment", json={"form_token": token, "action": "pause"})
    assert json.status_code == 403
    assert "Recruitment is paused" not in visitor.see().text


def test_wrong_passwords_bring_waits_that_growing_tries_cannot_pass(
    clock: list[float], tmp_path: Path
) -> None:
    with lab(tmp_path) as own:
        visitor = own.visitor()
        for password in ("wrong", "", PASSWORD + " ", PASSWORD.upper(), "\0"):
            assert visitor.submit("/login", visitor.token(), password=password).status_code == 403
            assert visitor.see().status_code == 303
        refused = visitor.log_in()
        assert refused.status_code == 429 and "Too many attempts" in refused.text
        assert visitor.see().status_code == 303, "not even the right one is looked at"
        waits = []
        for _ in range(12):
            waits.append(int(visitor.log_in("wrong").headers["retry-after"]))
            clock[0] += waits[-1]
            assert visitor.log_in("wrong").status_code == 403
        assert waits == [2, 2, 4, 8, 16, 32, 64, 128, 256, 512, 900, 900]
        assert own.visitor(address="192.0.2.9").log_in().status_code == 303
        clock[0] += 900
        assert visitor.log_in().status_code == 303 and visitor.see().status_code == 200


def test_the_cookie_tells_nothing_and_goes_nowhere_else(served: Lab) -> None:
    for base_url, secure in (("http://testserver", False), ("https://testserver", True)):
        visitor = served.visitor(base_url=base_url)
        before = visitor.see("/login").headers["set-cookie"]
        after = visitor.log_in().headers["set-cookie"]
        for cookie in (before, after):
            words = {word.strip().lower() for word in cookie.split(";")[1:]}
            assert {"httponly", "samesite=strict", f"path={BASE}"} <= words
            assert ("secure" in words) == secure and "domain" not in cookie.lower()
        values = {re.match(rf"{COOKIE}=([^;]+)", cookie)[1] for cookie in (before, after)}  # type: ignore[index]
        assert len(values) == 2, "a new word with the login"
        assert PASSWORD not in after


def test_logging_out_ends_the_login_on_the_server(served: Lab) -> None:
    visitor = served.experimenter()
    cookie = visitor.cookies[COOKIE]
    assert visitor.submit("/logout", visitor.token("/export")).status_code == 303
    assert COOKIE not in visitor.cookies
    again = visitor.get(BASE, headers={"cookie": f"{COOKIE}={cookie}"}, follow_redirects=False)
    assert again.status_code == 303


def test_a_login_ends_when_idle_and_in_any_case(clock: list[float], tmp_path: Path) -> None:
    with lab(tmp_path) as own:
        visitor = own.experimenter()
        clock[0] += IDLE_TIMEOUT
        assert visitor.see("/export").status_code == 200
        clock[0] += IDLE_TIMEOUT
        assert visitor.see("?auto=1").status_code == 200
        clock[0] += 1
        assert visitor.see("/export").status_code == 303, "pages that refresh do not keep it open"
        visitor.log_in()
        for _ in range(int(MAX_DURATION / IDLE_TIMEOUT)):
            assert visitor.see("/export").status_code == 200
            clock[0] += IDLE_TIMEOUT
        clock[0] += 1
        assert visitor.see("/export").status_code == 303


def test_a_new_password_counts_at_once_and_ends_all_logins(tmp_path: Path) -> None:
    with lab(tmp_path) as own:
        visitors = [own.experimenter(), own.experimenter()]
        set_password(tmp_path, "another password")
        for place in ("", "/sessions", "/payments"):
            assert [v.see(place).headers.get("location") for v in visitors] == [BASE + "/login"] * 2
        assert visitors[0].log_in().status_code == 403
        assert visitors[1].log_in("another password").status_code == 303
        assert [v.see("/sessions").status_code for v in visitors] == [303, 200]


def test_a_password_that_changes_while_it_is_looked_at_opens_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is right, then changed."""

    def change(secrets: Secrets, password: str) -> bool:
        right = check_password(secrets, password)
        set_password(tmp_path, "another password")
        return right

    with lab(tmp_path) as own:
        visitor = own.visitor()
        monkeypatch.setattr(access, "check_password", change)
        assert visitor.log_in().status_code == 403 and visitor.see().status_code == 303


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
