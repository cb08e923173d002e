"""Access control of the experimenter's pages."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from starlette.requests import Request

from physion.experiment.experimenter.access import access_control
from physion.experiment.experimenter.access.attempts import (
    BY_ADDRESS,
    MAX_ADDRESSES,
    OVERALL,
    LoginAttempts,
)
from physion.experiment.experimenter.access.login import (
    CONFIRMED_FOR,
    COOKIE,
    IDLE_TIMEOUT,
    MAX_DURATION,
    MAX_LOGINS,
    LoginRegistry,
)
from physion.experiment.study.identity import (
    FIRST_ACCOUNT,
    Account,
    Secrets,
    check_password,
    set_password,
)
from support.experiment.experimenter_client import BASE, Lab, lab
from support.experiment.tiny_study import PASSWORD

OWNER = Account(FIRST_ACCOUNT, "owner", "hash")
PAGES = ("", "/", "/sessions", "/sessions/abc", "/payments", "/export", "?auto=1")
ACTIONS = ("/logout", "/payments", "/payments/forget", "/export")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with lab(tmp_path_factory.mktemp("study")) as found:
        yield found


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Replace the clock of the access control by a list with one constant time."""
    now = [1000.0]
    original = access_control.AccessControl.__init__
    monkeypatch.setattr(
        access_control.AccessControl,
        "__init__",
        lambda self, check: original(self, check, lambda: now[0]),
    )
    return now


# --- waits ---------------------------------------------------------------------------------------


def test_waits_double_after_the_free_tries_and_end_somewhere() -> None:
    waits = [BY_ADDRESS.after(failures) for failures in range(20)]
    assert waits[:8] == [0, 0, 0, 0, 0, 1, 2, 4] and waits[-1] == BY_ADDRESS.longest == 900


def test_an_address_that_fails_waits_and_others_do_not() -> None:
    attempts = LoginAttempts()
    for _ in range(BY_ADDRESS.free):
        assert attempts.begin("192.0.2.1", 0.0) == 0
    assert attempts.begin("192.0.2.1", 0.0) == 1.0
    assert attempts.begin("192.0.2.1", 0.5) == 0.5
    assert attempts.begin("192.0.2.2", 0.5) == 0
    assert attempts.begin("192.0.2.1", 1.0) == 0
    assert attempts.begin("192.0.2.1", 1.0) == 2.0


def test_a_whole_ipv6_network_is_one_address() -> None:
    attempts = LoginAttempts()
    waits = [attempts.begin(f"2001:db8::{number:x}", 0.0) for number in range(6)]
    assert waits == [0, 0, 0, 0, 0, 1.0]
    assert attempts.begin("2001:db8:0:1::1", 0.0) == 0


def test_failures_are_forgotten_after_success_and_after_an_hour() -> None:
    attempts = LoginAttempts()
    for _ in range(10):
        attempts.begin("192.0.2.1", 0.0)
    assert attempts.begin("192.0.2.1", 0.0) > 0
    assert attempts.begin("192.0.2.1", 3601.0) == 0
    attempts.succeeded("192.0.2.1")
    assert [attempts.begin("192.0.2.1", 3601.0) for _ in range(5)] == [0] * 5


def test_guessing_from_many_addresses_is_slowed_but_locks_nobody_out() -> None:
    attempts = LoginAttempts()
    attempts.begin("198.51.100.7", 0.0)
    attempts.succeeded("198.51.100.7")
    tried, now = 0, 0.0
    for number in range(5000):
        tried += attempts.begin(f"10.0.{number // 250}.{number % 250}", now) == 0
        now += 0.1
    assert tried < OVERALL.free + 10 + 500 / OVERALL.longest
    assert 0 < attempts.begin("192.0.2.1", now) <= OVERALL.longest
    assert attempts.begin("198.51.100.7", now) == 0, "who logged in before is not held up"


def test_addresses_are_kept_in_bounds() -> None:
    attempts = LoginAttempts()
    for number in range(MAX_ADDRESSES + 500):
        attempts._by_address.pop("x", None)
        attempts.begin(f"10.{number >> 16}.{number >> 8 & 255}.{number & 255}", 100.0 * number)
    assert len(attempts._by_address) == MAX_ADDRESSES


# --- logins --------------------------------------------------------------------------------------


def test_a_login_ends_when_idle_and_in_any_case() -> None:
    logins = LoginRegistry()
    token = logins.open(OWNER, 0.0)
    assert logins.find(token, IDLE_TIMEOUT) is not None
    assert logins.find(token, IDLE_TIMEOUT + 100, by_person=False) is not None
    assert logins.find(token, 2 * IDLE_TIMEOUT + 1) is None, (
        "pages that refresh do not keep it open"
    )
    token, now = logins.open(OWNER, 0.0), 0.0
    while now + IDLE_TIMEOUT <= MAX_DURATION:
        now += IDLE_TIMEOUT
        assert logins.find(token, now) is not None
    assert logins.find(token, MAX_DURATION + 1) is None


def test_no_token_is_kept_and_logins_are_bounded() -> None:
    logins = LoginRegistry()
    tokens = [logins.open(OWNER, 0.0) for _ in range(MAX_LOGINS + 1)]
    assert len(set(tokens)) == MAX_LOGINS + 1 and all(len(token) >= 43 for token in tokens)
    assert not any(token in repr(vars(logins)) for token in tokens)
    assert logins.find(tokens[0], 0.0) is None and logins.find(tokens[1], 0.0) is not None


def test_form_tokens_belong_to_one_browser_and_one_server() -> None:
    logins = LoginRegistry()
    assert logins.is_form_token("a", logins.form_token("a"))
    for browser, given in (("b", logins.form_token("a")), ("", logins.form_token("")), ("a", ""),
                           ("a", "é"), ("a", LoginRegistry().form_token("a"))):  # fmt: skip
        assert not logins.is_form_token(browser, given)


# --- pages ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES)
def test_nothing_is_shown_without_login(served: Lab, page: str) -> None:
    for cookie in (None, "wrong", "x" * 5000):
        visitor = served.visitor()
        headers = {} if cookie is None else {"cookie": f"{COOKIE}={cookie}"}
        answer = visitor.get(f"{BASE}{page}", headers=headers, follow_redirects=False)
        assert answer.status_code == 303 and answer.headers["location"] == f"{BASE}/login"
        assert answer.content == b""


@pytest.mark.parametrize("action", ACTIONS)
def test_nothing_is_done_without_login(served: Lab, action: str) -> None:
    visitor = served.visitor()
    token = visitor.token()
    answer = visitor.submit(action, token, password=PASSWORD, word="delete")
    assert answer.status_code == 303 and answer.headers["location"] == f"{BASE}/login"


@pytest.mark.parametrize("action", ACTIONS)
def test_forms_need_the_token_of_their_browser(served: Lab, action: str) -> None:
    visitor = served.experimenter()
    for token in (None, "", "0" * 64, served.experimenter().token("/export")):
        answer = visitor.submit(action, token, password=PASSWORD, word="delete")
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
    big = visitor.submit("/payments", token, password=PASSWORD, more="x" * 9000)
    assert big.status_code == 403
    json = visitor.post(f"{BASE}/payments", json={"form_token": token, "password": PASSWORD})
    assert json.status_code == 403
    assert visitor.submit("/payments", token, password=PASSWORD).status_code == 303


@pytest.mark.usefixtures("clock")
def test_a_wrong_password_opens_nothing(tmp_path: Path) -> None:
    with lab(tmp_path) as own:
        visitor = own.visitor()
        for password in ("wrong", "", PASSWORD + " ", PASSWORD.upper(), "\0", "é" * 400):
            answer = visitor.submit("/login", visitor.token(), password=password)
            assert answer.status_code in (403, 429)
            assert visitor.see().status_code == 303
        assert "Too many attempts" in visitor.log_in("wrong").text


def test_wrong_passwords_bring_waits_that_growing_tries_cannot_pass(
    clock: list[float], tmp_path: Path
) -> None:
    with lab(tmp_path) as own:
        visitor = own.visitor()
        assert [visitor.log_in("wrong").status_code for _ in range(5)] == [403] * 5
        refused = visitor.log_in()
        assert refused.status_code == 429 and refused.headers["retry-after"] == "1"
        assert "Please wait 1 second and" in refused.text
        assert visitor.see().status_code == 303, "not even the right one is looked at"
        clock[0] += 1.0
        assert visitor.log_in().status_code == 303
        assert visitor.see().status_code == 200


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


def test_a_login_that_is_over_shows_nothing(clock: list[float], tmp_path: Path) -> None:
    with lab(tmp_path) as own:
        visitor = own.experimenter()
        assert visitor.see("/export").status_code == 200
        clock[0] += IDLE_TIMEOUT + 1
        assert visitor.see("/export").status_code == 303
        assert visitor.log_in().status_code == 303
        assert visitor.open_payments().status_code == 200
        clock[0] += CONFIRMED_FOR + 1
        page = visitor.see("/payments")
        assert 'name="password"' in page.text and "Delete" not in page.text
        token = visitor.token("/export")
        late = visitor.submit("/payments/forget", token, word="delete")
        assert 'name="password"' in late.text, "deleting needs the password again as well"


def test_payments_need_the_password_once_more(served: Lab) -> None:
    visitor = served.experimenter(address="192.0.2.60")
    assert 'name="password"' in visitor.see("/payments").text
    wrong = visitor.submit("/payments", visitor.token("/export"), password="wrong")
    assert wrong.status_code == 403 and "not the password" in wrong.text
    assert "No ids are stored" in visitor.open_payments().text
    other = served.experimenter(address="192.0.2.60")
    assert 'name="password"' in other.see("/payments").text


def test_a_new_password_counts_at_once(tmp_path: Path) -> None:
    with lab(tmp_path) as own:
        set_password(tmp_path, "another password")
        visitor = own.visitor()
        assert visitor.log_in().status_code == 403
        assert visitor.log_in("another password").status_code == 303


def test_a_new_password_ends_all_logins(tmp_path: Path) -> None:
    with lab(tmp_path) as own:
        visitors = [own.experimenter(), own.experimenter()]
        visitors[0].open_payments()
        set_password(tmp_path, PASSWORD)  # the same words are another hash, too
        for place in ("", "/sessions", "/payments"):
            assert [v.see(place).headers.get("location") for v in visitors] == [BASE + "/login"] * 2
        form = visitors[0].token("/login")
        assert visitors[0].submit("/export", form).headers["location"] == BASE + "/login"
        assert visitors[1].log_in().status_code == 303
        assert [v.see("/sessions").status_code for v in visitors] == [303, 200]


def test_a_password_that_changes_while_it_is_looked_at_opens_nothing(tmp_path: Path) -> None:
    """In two steps: it is right, then changed."""
    set_up = Secrets.create(tmp_path, PASSWORD)
    kept = [set_up]
    gate = access_control.AccessControl(lambda: kept[0])
    token = gate.logins.open(OWNER, 0.0)

    def change(secrets: Secrets, password: str, name: str) -> bool:
        right = check_password(secrets, password, name)
        kept[0] = set_password(tmp_path, "another password")
        return right

    request = Request({"type": "http", "headers": [(b"cookie", f"{COOKIE}={token}".encode())]})
    try:
        found = asyncio.run(gate.try_password(request, FIRST_ACCOUNT, PASSWORD))
        assert found == set_up.account(FIRST_ACCOUNT)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(access_control, "check_password", change)
            assert asyncio.run(gate.try_password(request, FIRST_ACCOUNT, PASSWORD)) == 0.0
    finally:
        gate.close()


def test_every_page_has_a_strict_policy_and_is_not_kept(served: Lab) -> None:
    visitor = served.experimenter()
    for page in ("/login", "", "/sessions", "/sessions/none", "/payments", "/export"):
        answer = visitor.see(page)
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["x-frame-options"] == "DENY"
        assert not re.search(r"<style|\sstyle=|\son\w+=|<script(?![^>]*\bsrc=)", answer.text)


def test_only_files_of_the_package_are_static(served: Lab) -> None:
    visitor = served.visitor()
    good = visitor.see("/static/experimenter.css")
    assert good.status_code == 200 and good.headers["content-type"].startswith("text/css")
    for name in ("../routes.py", "..%2froutes.py", "routes.py", "%2e%2e/login.py", ""):
        assert visitor.see(f"/static/{name}").status_code in (303, 404)
