"""Accounts of several experimenters: every route for every role, the command, and the log."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.cli.main import main
from physion.core.errors import BadInputError, UnknownNameError
from physion.experiment.experimenter.access.accounts import (
    add_account,
    change_account,
    remove_account,
)
from physion.experiment.experimenter.routes import build_router
from physion.experiment.store.database import ACTIONS, SESSIONS
from physion.experiment.store.lab import forget_sessions
from physion.experiment.store.store import Store
from physion.experiment.study.identity import (
    FIRST_ACCOUNT,
    SECRET_FILE,
    Secrets,
    check_password,
    set_password,
)
from physion.experiment.study.study import load_study
from support.experiment.experimenter_client import BASE, Lab, Visitor, lab
from support.experiment.store_walk import enter, rows, run, walk
from support.experiment.tiny_study import PASSWORD, make_tiny_study

WORDS = "correct horse battery"
ROLES = ("owner", "recruiter", "analyst", "viewer")
EVERYBODY = frozenset(ROLES)
READERS = frozenset(("owner", "analyst", "viewer"))
PAYERS = frozenset(("owner", "recruiter"))
ALLOWED = {
    ("GET", ""): EVERYBODY,
    ("GET", "/"): EVERYBODY,
    ("POST", "/logout"): EVERYBODY,
    ("GET", "/sessions"): READERS,
    ("GET", "/sessions/{session}"): READERS,
    ("POST", "/sessions/{session}/void"): {"owner"},
    ("POST", "/sessions/{session}/forget"): {"owner"},
    ("POST", "/recruitment"): PAYERS,
    ("GET", "/payments"): PAYERS,
    ("POST", "/payments"): PAYERS,
    ("GET", "/payments.csv"): PAYERS,
    ("POST", "/payments/forget"): {"owner"},
    ("GET", "/export"): {"owner", "analyst"},
    ("POST", "/export"): {"owner", "analyst"},
    ("GET", "/log"): {"owner"},
}
"""Who may use each route; written by hand, so that a new route must be thought about."""
PUBLIC = {("GET", "/login"), ("POST", "/login"), ("GET", "/static/{name}")}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("study")
    with lab(folder, test=2, familiarization=1, scenarios=("drop",)) as found:
        for role in ROLES:
            add_account(folder, f"{role}@lab", role, WORDS)
        walk(found.store, enter(found.store, "Someone"), "done")
        yield found


def login(found: Lab, role: str) -> Visitor:
    visitor = found.visitor()
    assert visitor.log_in(WORDS, f"{role}@lab").status_code == 303
    return visitor


def test_every_route_is_in_the_table(served: Lab) -> None:
    router = build_router(served.study, served.secrets, served.store)
    found = {(method, route.path) for route in router.routes for method in route.methods}  # type: ignore[attr-defined]
    assert found == set(ALLOWED) | PUBLIC


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize(("method", "path"), ALLOWED)
def test_each_route_is_for_its_roles_alone(served: Lab, method: str, path: str, role: str) -> None:
    visitor = login(served, role)
    (row,) = rows(served.store, SESSIONS)
    address = path.replace("{session}", row.session)
    before = len(rows(served.store, ACTIONS))
    if method == "GET":
        answer = visitor.see(address)
    else:
        # Of the right form, but without what would change anything.
        answer = visitor.submit(address, visitor.token(""), password=WORDS)
    if role in ALLOWED[method, path]:
        assert answer.status_code in (200, 303, 422), answer.text
        assert answer.headers.get("location") != f"{BASE}/login" or path == "/logout"
    else:
        assert answer.status_code == 403
        assert f"The role of this account ({role}) does not allow this." in answer.text
        assert row.reference not in answer.text
        assert len(rows(served.store, ACTIONS)) == before


@pytest.mark.parametrize("role", ROLES)
def test_pages_offer_what_the_role_may_do(served: Lab, role: str) -> None:
    visitor = login(served, role)
    overview = visitor.see().text
    assert f"{role}@lab ({role})" in overview
    links = {path for (method, path) in ALLOWED if method == "GET" and f'href="{BASE}{path}"'
             in overview and path not in ("", "/")}  # fmt: skip
    wanted = {path for path in ("/sessions", "/payments", "/export", "/log")
              if role in ALLOWED["GET", path]}  # fmt: skip
    assert links == wanted
    assert ("Pause recruitment" in overview) == (role in PAYERS)
    assert (f"{BASE}/sessions?" in overview) == (role in READERS)
    (row,) = rows(served.store, SESSIONS)
    if role in READERS:
        page = visitor.see(f"/sessions/{row.session}").text
        assert ("Make void" in page) == (role == "owner")
    if role in PAYERS:
        visitor.submit("/payments", visitor.token(""), password=WORDS)
        page = visitor.see("/payments").text
        assert "Someone" in page and ("Delete raw ids" in page) == (role == "owner")
        assert (f"{BASE}/sessions/{row.session}" in page) == (role == "owner")


def test_the_first_account_goes_on_and_names_are_asked_for(served: Lab) -> None:
    visitor = served.visitor()
    assert '<label for="user">Name</label>' in visitor.see("/login").text
    assert visitor.log_in(PASSWORD).status_code == 303
    assert f"{FIRST_ACCOUNT} (owner)" in visitor.see().text
    other = served.visitor(address="192.0.2.99")
    for user, password in (("viewer@lab", PASSWORD), ("nobody", WORDS), ("", WORDS)):
        answer = other.log_in(password, user)
        assert answer.status_code == 403 and "no such name with this password" in answer.text


def test_one_password_asks_for_no_name(tmp_path: Path) -> None:
    with lab(tmp_path) as own:
        visitor = own.visitor()
        assert '<label for="user">' not in visitor.see("/login").text
        # As forms of older pages were sent.
        answer = visitor.submit("/login", visitor.token(), password=PASSWORD)
        assert answer.status_code == 303 and visitor.see("/log").status_code == 200
    assert "accounts" not in json.loads((tmp_path / SECRET_FILE).read_text())


def test_changes_of_an_account_count_at_once(tmp_path: Path) -> None:
    with lab(tmp_path) as own:
        add_account(tmp_path, "ada", "viewer", WORDS)
        add_account(tmp_path, "grace", "analyst", WORDS)
        ada, grace = own.visitor(), own.visitor()
        assert ada.log_in(WORDS, "ada").status_code == grace.log_in(WORDS, "grace").status_code
        assert ada.see("/export").status_code == 403
        change_account(tmp_path, "ada", role="analyst")
        assert ada.see("/export").status_code == 200, "the new role, without a new login"
        change_account(tmp_path, "ada", password="another password")
        assert ada.see("/export").status_code == 303 and grace.see("/export").status_code == 200
        assert ada.log_in("another password", "ada").status_code == 303
        set_password(tmp_path, "a third password")
        assert ada.see("").status_code == 200, "the first account's password is not that of others"
        remove_account(tmp_path, "grace")
        assert grace.see("").status_code == 303 and grace.log_in(WORDS, "grace").status_code == 403


def test_the_log_says_who_did_what(tmp_path: Path) -> None:
    with lab(tmp_path, test=2, familiarization=1, scenarios=("drop",)) as own:
        add_account(tmp_path, "ada", "owner", WORDS)
        add_account(tmp_path, "bob", "recruiter", WORDS)
        walk(own.store, enter(own.store, "Secret-Id"), "done")
        (row,) = rows(own.store, SESSIONS)
        ada, bob = own.visitor(), own.visitor()
        ada.log_in(WORDS, "ada")
        bob.log_in(WORDS, "bob")
        for action in ("pause", "pause", "resume"):
            bob.submit("/recruitment", bob.token(""), action=action)
        bob.submit("/payments", bob.token(""), password=WORDS)
        assert bob.see("/payments.csv").status_code == 200
        page = f"/sessions/{row.session}"
        for action in ("void", "count"):
            ada.submit(f"{page}/void", ada.token(page), action=action)
        assert ada.submit("/export", ada.token("/export"), simulated="yes").status_code == 200
        ada.submit(f"{page}/forget", ada.token(page), word="delete")
        text = ada.see("/log").text
        done = [(entry.account, entry.role, entry.action) for entry in rows(own.store, ACTIONS)]
    a, b = ("ada", "owner"), ("bob", "recruiter")
    assert done == [
        (*a, "logged in"),
        (*b, "logged in"),
        (*b, "paused recruitment"),
        (*b, "resumed recruitment"),
        (*b, "opened the payments"),
        (*b, "downloaded the payments"),
        (*a, "made a session void"),
        (*a, "counted a session again"),
        (*a, "exported"),
        (*a, "deleted a session"),
    ]
    assert text.index("deleted a session") < text.index("paused recruitment")
    assert row.reference in text and "Secret-Id" not in text


def test_deletion_on_the_command_line_is_in_the_log(tmp_path: Path) -> None:
    with lab(tmp_path, test=2, familiarization=1, scenarios=("drop",)) as own:
        reference = run(own.store.state(enter(own.store, "Someone"))).reference
        url = own.store.engine.url.render_as_string(hide_password=False)
    forget_sessions(url, [reference])
    store = Store.open(load_study(tmp_path), Secrets.load(tmp_path), url)
    try:
        (entry,) = rows(store, ACTIONS)
    finally:
        store.close()
    assert (entry.account, entry.action, entry.subject) == ("", "deleted a session", reference)


# --- the accounts themselves ---------------------------------------------------------------------


def test_accounts_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_tiny_study(tmp_path, scenarios=("drop",), test=2, size=64, languages=("en",))
    word = tmp_path / "word"
    word.write_text(f"{WORDS}\n")
    command = ["experiment", "accounts", str(tmp_path)]
    assert main(command) == 0
    assert capsys.readouterr().out.split() == [FIRST_ACCOUNT, "owner"]
    add = [*command, "--add", "grace", "--role", "analyst", "--password-file", str(word), "--json"]
    assert main(add) == 0
    listed = json.loads(capsys.readouterr().out)
    assert listed == [
        {"name": FIRST_ACCOUNT, "role": "owner"},
        {"name": "grace", "role": "analyst"},
    ]
    assert check_password(Secrets.load(tmp_path), WORDS, "grace")
    word.write_text("another password\n")
    assert main([*command, "--change", "grace", "--password-file", str(word)]) == 0
    assert main([*command, "--change", "grace", "--role", "owner"]) == 0
    assert main([*command, "--remove", FIRST_ACCOUNT]) == 0
    capsys.readouterr()
    secrets = Secrets.load(tmp_path)
    assert [(one.name, one.role) for one in secrets.accounts] == [("grace", "owner")]
    assert check_password(secrets, "another password", "grace")
    assert not check_password(secrets, PASSWORD)
    assert (tmp_path / SECRET_FILE).stat().st_mode & 0o077 == 0
    for wrong, said in (
        (["--remove", "grace"], "needs an owner"),
        (["--change", "grace", "--role", "viewer"], "needs an owner"),
        (["--add", "grace", "--role", "viewer", "--password-file", str(word)], "already"),
        (["--add", "eve", "--password-file", str(word)], "--role viewer"),
        (["--change", "grace"], "needs --role"),
        (["--add", "eve", "--remove", "grace"], "one of"),
        (["--role", "viewer"], "need --add"),
        (["--remove", "greace"], "grace"),
    ):
        assert main([*command, *wrong]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1
    assert Secrets.load(tmp_path) == secrets


@pytest.mark.parametrize("name", ["", "a b", "x" * 41, "<b>", "a\n"])
def test_bad_names_and_passwords_are_refused(tmp_path: Path, name: str) -> None:
    Secrets.create(tmp_path, PASSWORD)
    with pytest.raises(BadInputError, match="no name of an account"):
        add_account(tmp_path, name, "viewer", WORDS)
    with pytest.raises(BadInputError, match="8 to 1000"):
        add_account(tmp_path, "ada", "viewer", "short")
    with pytest.raises(UnknownNameError, match="viewer"):
        add_account(tmp_path, "ada", "viewr", WORDS)
    assert not Secrets.load(tmp_path).others


@pytest.mark.parametrize(
    "account", [{"name": "a"}, {"name": "a", "role": "king", "password_hash": "x"}, 3,
                {"name": "a b", "role": "owner", "password_hash": "x"},
                {"name": "a", "role": "owner", "password_hash": ""}],
)  # fmt: skip
def test_damaged_accounts_are_refused(tmp_path: Path, account: object) -> None:
    Secrets.create(tmp_path, PASSWORD)
    path = tmp_path / SECRET_FILE
    content = json.loads(path.read_text()) | {"accounts": [account]}
    path.write_text(json.dumps(content))
    with pytest.raises(BadInputError, match="damaged"):
        Secrets.load(tmp_path)
