"""Every endpoint: accepted requests, responses and refusals; headers, errors and the log."""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.testclient import TestClient

import physion.experiment
from physion.experiment import protocol
from physion.experiment import protocol as wire
from physion.experiment.protocol import REFUSALS, PublicStudy
from physion.experiment.store.database import SESSIONS
from physion.experiment.study import texts
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import Plausibility, Recruitment
from physion.experiment.study.study import Study
from physion.experiment.web.guards import Guards, content_policy
from support.experiment.app_walk import Person, Served, answer_body, served
from support.experiment.experimenter_client import lab
from support.experiment.store_walk import rows

TRIALS = {"familiarization": 2, "test": 3}
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
    def test_session_endpoints_need_a_token(
        self, site: Served, method: str, path: str, body: Any
    ) -> None:
        for header in (None, "", "Bearer ", "Bearer nobody", "Basic eDp5", "Bearer ' OR 1=1 --"):
            headers = {} if header is None else {"authorization": header}
            answer = site.client.request(method, path, json=body, headers=headers)
            refused(answer, 401, "unknown_token")

    @pytest.mark.parametrize("path", [
        "/nowhere", "/api", "/api/", "/api/nowhere", "/api/session/", "/static", "/static/",
        "/static/nowhere.js", "/media", "/media/", "/favicon.ico", "/docs", "/openapi.json",
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
        assert (result.trials, result.correct) == (3, 2)
        assert result.percentile is None, "no other participants"
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

    def test_mturk_preview_begins_nothing(self, site: Served) -> None:
        before = rows(site.store, SESSIONS)
        preview = {"assignmentId": "ASSIGNMENT_ID_NOT_AVAILABLE", "hitId": "h"}
        for more in ({}, {"id": "w1"}):
            body = {"source": "mturk", "recruiter": preview, **more}
            refused(site.client.post("/api/enter", json=body), 403, "not_yet")
        assert rows(site.store, SESSIONS) == before

    def test_entering_refuses_unknown_fields(self, site: Served) -> None:
        person = Person(site.client)
        assert person.ask("POST", "/api/enter", {"kind": "preview"}, 422)["error"] == "bad_request"
        assert person.ask("POST", "/api/enter", {"pass": "preview-0"}, 403)["error"] == "bad_link"
        assert person.ask("POST", "/api/enter", {"pass_": "x"}, 403)["error"] == "bad_link"
        assert person.ask("POST", "/api/enter", {"source": "prolific"}, 403)["error"] == "id_needed"
        assert person.ask("POST", "/api/enter", {"scenario": "x"}, 403)["error"] == "bad_link"


SECRET = "a word of the request that no answer may hold"
STUDY = Study(folder=Path(), name="n", version="1", title="t", contact="c", scenarios=("collide",))


def client(study: Study = STUDY, **settings: str) -> TestClient:
    """Return a client of three pages behind the guards."""

    async def echo(request: Request) -> Response:
        return PlainTextResponse(str(len(await request.body())))

    async def fail(request: Request) -> Response:
        raise RuntimeError(SECRET)

    async def own_headers(request: Request) -> Response:
        return PlainTextResponse("", headers={"cache-control": "private", "x-own": "1"})

    routes = [
        Route("/echo", echo, methods=["POST", "GET"]),
        Route("/fail", fail),
        Route("/own", own_headers),
    ]
    app = Starlette(routes=routes, middleware=[Middleware(Guards, study=study)])
    return TestClient(app, **settings)


class TestHeaders:
    def test_every_response_has_them(self) -> None:
        asks = (("GET", "/echo"), ("GET", "/nowhere"), ("DELETE", "/echo"), ("GET", "/fail"))
        answers = [client().request(*ask) for ask in asks]
        assert [answer.status_code for answer in answers] == [200, 404, 405, 500]
        for answer in answers:
            assert answer.headers["content-security-policy"].startswith("default-src 'none'; ")
            assert answer.headers["referrer-policy"] == "no-referrer"
            assert answer.headers["cache-control"] == "no-store"
            assert answer.headers["x-frame-options"] == "DENY"
            assert "strict-transport-security" not in answer.headers
        headers = client(base_url="https://lab.example.org").get("/echo").headers
        assert headers["strict-transport-security"] == "max-age=31536000"

    def test_headers_of_the_application_are_kept(self) -> None:
        headers = client().get("/own").headers
        assert headers["cache-control"] == "private"
        assert headers["x-own"] == "1"
        assert headers["x-content-type-options"] == "nosniff"

    def test_only_named_sites_may_embed_the_pages_and_nothing_inline_runs(self) -> None:
        sites = ("https://www.mturk.com", "https://workersandbox.mturk.com")
        headers = client(replace(STUDY, embed_from=sites)).get("/echo").headers
        assert f"frame-ancestors {' '.join(sites)};" in headers["content-security-policy"]
        assert "x-frame-options" not in headers
        policy = content_policy(STUDY)
        assert "unsafe" not in policy and "http" not in policy
        assert "script-src 'self';" in policy


def test_an_internal_error_reveals_nothing(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR, logger="physion.experiment"):
        answer = client().get("/fail?id=5f9c-prolific", headers={"authorization": "Bearer good"})
    assert answer.status_code == 500
    assert set(answer.json()) == {"error", "message", "state", "completion"}
    assert answer.json()["error"] == "server_error"
    assert SECRET not in answer.text and "Traceback" not in answer.text
    # The log has the traceback, but neither the participant nor the token.
    assert SECRET in caplog.text
    assert "prolific" not in caplog.text and "good" not in caplog.text


ALL = "physion.experiment"


def test_a_request_is_one_line_without_its_query(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with (
        served(tmp_path / "s", familiarization=1, test=1) as site,
        caplog.at_level(logging.INFO, logger=ALL),
    ):
        site.client.get("/api/study?PROLIFIC_PID=5f0c")
        site.client.get("/static/%0Aforged line")
    assert [message for _, _, message in caplog.record_tuples if "/" in message] == [
        "GET /api/study 200", "GET /static/%0Aforged%20line 404"
    ]  # fmt: skip


def test_a_missing_movie_is_named_only_in_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with served(tmp_path / "s", familiarization=1, test=1) as site:
        shown = site.study.phase("collide", "familiarization")[0]
        (site.study.folder / shown.movie).unlink()
        person = site.person(id="watcher").walk("familiarization")
        movie = person.ask("GET", "/api/trials/familiarization")["trials"][0]["movie"]
        answer = site.client.get(movie)
    assert answer.status_code == 404 and answer.json()["error"] == "not_found"
    assert "missing on the server" in answer.json()["message"]
    assert Path(shown.movie).name not in answer.text
    assert [(record.levelname, record.exc_info) for record in caplog.records] == [("ERROR", None)]
    assert f"{shown.movie} is missing" in caplog.text


def test_logins_are_logged_without_addresses(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with (
        lab(tmp_path / "s", test=1) as found,
        caplog.at_level(logging.INFO, logger=f"{ALL}.experimenter"),
    ):
        visitor = found.visitor(address="198.51.100.23")
        assert visitor.log_in("wrong").status_code == 403
        assert visitor.log_in().status_code == 303
    own = [record for record in caplog.records if record.name.startswith(f"{ALL}.experimenter")]
    assert [record.levelname for record in own] == ["WARNING", "INFO"]
    assert "198.51" not in caplog.text


def test_an_answer_before_the_end_of_its_movie_may_come_again(tmp_path: Path) -> None:
    rules = Plausibility()
    with served(tmp_path / "s", familiarization=1, test=1, plausibility=rules) as site:
        person = site.person(id="fast").walk("familiarization")
        media = person.ask("GET", "/api/trials/familiarization")["trials"][0]
        for kind in ("movie", "map"):
            assert site.client.get(media[kind]).status_code == 200
        shown = {"key": "a-showing-1", "phase": "familiarization", "trial": 0}
        person.ask("POST", "/api/showings", shown)
        assert person.answer(0, "familiarization", status=425)["error"] == "too_early"
        assert person.heard[-1][1].headers["retry-after"] in ("3", "4", "5")


# --- static files of the participants' pages ------------------------------------------------------


PACKAGE = Path(physion.experiment.__file__).parent
STATIC = PACKAGE / "static"
VENDOR = STATIC / "vendor"
OWN = sorted(STATIC.glob("*.js"))
CODE = {path.name: path.read_text(encoding="utf-8") for path in OWN}
TEXTS = {
    language: texts.read_texts(PACKAGE / "texts", language)[0]
    for language in texts.shipped_languages()
}


def test_shipped_files_match_the_lock() -> None:
    lock = json.loads((VENDOR / "vendor.lock.json").read_text(encoding="utf-8"))
    assert lock["files"]
    for entry in lock["files"]:
        content = (VENDOR / entry["file"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry["sha256"], entry["file"]
        assert re.fullmatch(r"\d+\.\d+\.\d+", entry["version"])
        licence = (VENDOR / entry["license"]).read_text(encoding="utf-8")
        assert "Permission is hereby granted" in licence and "Copyright" in licence
    listed = {entry["file"] for entry in lock["files"]}
    assert {path.name for path in VENDOR.glob("*.js")} == listed
    assert list(VENDOR.glob("*.css")) == []


def test_the_page_uses_no_other_host_and_nothing_inline() -> None:
    """The pages contain nothing that the content security policy would block."""
    page = Tags((PACKAGE / "pages" / "index.html").read_text(encoding="utf-8"))
    addresses = [
        value for _, attributes in page.tags for name, value in attributes.items()
        if name in ("src", "href") and value
    ]  # fmt: skip
    assert addresses and all(value.startswith(("/static/", "#")) for value in addresses)
    for value in addresses:
        if value.startswith("/static/"):
            assert (STATIC / value.removeprefix("/static/")).is_file(), value
    for tag, attributes in page.tags:
        assert tag != "style" and "style" not in attributes
        assert not any(name.startswith("on") for name in attributes)
        assert tag != "script" or attributes.get("src")
    for name, code in CODE.items():
        assert not re.search(r"https?://(?!\S*\\/)[a-z]", code), name
    assert "url(" not in (STATIC / "pages.css").read_text(encoding="utf-8")


def test_types_of_messages_match_the_server() -> None:
    """The interfaces of messages.d.ts have the fields of the pydantic models."""
    declared = (STATIC / "messages.d.ts").read_text(encoding="utf-8")
    interfaces = re.findall(r"export interface (\w+) \{\n(.*?)\n\}", declared, re.DOTALL)
    assert len(interfaces) > 10
    for name, body in interfaces:
        model = getattr(protocol, name)
        fields = model.model_fields
        expected = [field.alias or key for key, field in fields.items()]
        assert re.findall(r"^  (\w+)\??:", body, re.MULTILINE) == expected, name


def test_refusal_codes_match_the_server() -> None:
    (listed,) = re.findall(r"const CODES = new Set\(\[(.*?)\]\)", CODE["api.js"], re.DOTALL)
    staying = {code for code, status in REFUSALS.items() if status < 500} - {
        "too_many",
        "too_early",
    }
    assert set(re.findall(r"\w+", listed)) == staying


def test_no_value_can_become_markup() -> None:
    forbidden = (
        r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|srcdoc"
    )
    assert {name: re.findall(forbidden, code) for name, code in CODE.items()} == {
        name: [] for name in CODE
    }


def test_imported_names_exist() -> None:
    for name, code in CODE.items():
        for names, other in re.findall(r'import (?:\{([^}]*)\}|\* as \w+) from "\./(.+?)";', code):
            for word in filter(None, re.split(r"[,\s]+", names)):
                exported = rf"export (?:async )?(?:const|class|function) {word}\b"
                assert re.search(exported, CODE[other]), f"{name}: {word} of {other}"


def test_every_text_exists_and_is_used() -> None:
    code = "\n".join(CODE.values())
    tables = {key.split(".")[0] for key in TEXTS["en"]}
    literal = {
        key for key in re.findall(r'"([a-z_]+\.[a-z_0-9]+)"', code)
        if key.split(".")[0] in tables and not key.endswith(".js")
    }  # fmt: skip
    assert literal - set(TEXTS["en"]) == set()
    # Some keys are composed: `feedback.difficulty_${value}`, or texts of a table by name.
    composed = [
        re.sub(r"\\\$\\\{.*?\\\}", r"\\w+", re.escape(template))
        for template in re.findall(r"t\(`([^`]*\.[^`]*)`", code)
    ]
    assert len(composed) >= 4
    of_trials = set(re.findall(r'"(\w+)"', CODE["trial_pieces.js"]))
    for key in set(TEXTS["en"]) - literal:
        table, name = key.split(".")
        by_name = table in ("trial", "practice") and name in of_trials
        in_page = key == "refusal.no_script"
        assert by_name or in_page or any(re.fullmatch(one, key) for one in composed), key


@pytest.mark.parametrize("language", sorted(TEXTS))
def test_texts_within_the_page(language: str) -> None:
    """The page itself has two texts in all languages, for browsers without script or modules."""
    page = " ".join((PACKAGE / "pages" / "index.html").read_text(encoding="utf-8").split())
    for key in ("refusal.no_script", "refusal.browser"):
        assert TEXTS[language][key] in page


def test_contrast_of_the_colours() -> None:
    """The contrast of text and background is at least 4.5 to 1 (WCAG 2)."""
    css = (STATIC / "pages.css").read_text(encoding="utf-8")
    colours = dict(re.findall(r"--(\w+): (#[0-9a-f]{6});", css))
    for paper in ("ground", "paper"):
        for ink in ("ink", "soft", "strong", "good", "bad", "lost"):
            assert contrast(colours[ink], colours[paper]) >= 4.5, (ink, paper)
    assert contrast("#ffffff", colours["strong"]) >= 4.5


def contrast(one: str, other: str) -> float:
    light, dark = sorted((luminance(one), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    red, green, blue = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


class Tags(HTMLParser):
    """Parser that collects the tags of a page with their attributes."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
