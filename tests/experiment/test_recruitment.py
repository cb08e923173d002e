"""Whom a study lets in, entry links of recruiters, and completion credit."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from physion.cli.main import main
from physion.core.errors import BadInputError
from physion.experiment.protocol import Enter
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import (
    MTURK_HOSTS,
    RECRUITERS,
    completion,
    ending_completion,
    links,
    make_pass,
    read_pass,
    session_code,
    start_warnings,
)
from physion.experiment.study.settings import EarlyEnd, Recruitment
from physion.experiment.study.study import Study, load_study
from support.experiment.app_walk import Person, Served, served
from support.experiment.tiny_study import make_tiny_study

PROLIFIC = "5f1e6c0a9b3d4e2f7a8b9c0d"


@contextmanager
def strict(folder: Path, prolific_id: str = "", **recruitment: Any) -> Iterator[Served]:
    """Serve a study with these settings of recruitment."""
    settings = {"recruitment": Recruitment(**recruitment), "familiarization": 1, "test": 1}
    with served(folder, prolific_id=prolific_id, **settings) as site:
        yield site


def enter(site: Served, status: int, **asked: Any) -> Any:
    return Person(site.client).ask("POST", "/api/enter", asked, status)


def test_ids_must_have_the_form_of_their_recruiters_ids(tmp_path: Path) -> None:
    assert Recruitment().prolific_id == "[0-9a-fA-F]{24}"
    with strict(tmp_path / "s", Recruitment().prolific_id, sona_id="[0-9]{1,5}") as site:
        for wrong in ("invented-1", PROLIFIC[:-1], PROLIFIC + "0", PROLIFIC + "\n x", "g" * 24):
            assert enter(site, 403, source="prolific", id=wrong)["error"] == "id_refused", wrong
        assert enter(site, 403, source="sona", id="12a")["error"] == "id_refused"
        assert enter(site, 200, source="prolific", id=PROLIFIC)["state"]["stage"] == "consent"
        assert enter(site, 200, source="sona", id="123")["state"]["stage"] == "consent"
        assert enter(site, 200, id="any id in a plain link")["state"]["stage"] == "consent"


def test_with_an_allow_list_nobody_else_takes_part(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "ids.txt").write_text("ada\n\n  grace \nada\n")
    with strict(folder, allow_list="ids.txt") as site:
        assert enter(site, 403, id="eve")["error"] == "id_refused"
        assert enter(site, 200, id="grace")["state"]["stage"] == "consent"
        kept = site.store.engine.connect().exec_driver_sql("SELECT settings FROM studies").scalar()
        assert "grace" not in str(kept)  # the settings are exported
    (folder / "ids.txt").write_text("\n")
    with pytest.raises(BadInputError, match=r"ids\.txt has no id"):
        load_study(folder)


def test_people_enter_by_a_signed_link_only(tmp_path: Path) -> None:
    with strict(tmp_path / "s", signed_links="study") as site:
        assert enter(site, 403, source="sona", id="17")["error"] == "bad_link"
        assert enter(site, 403)["error"] == "bad_link"
        found = {one.name: one.address for one in links(site.study, site.secrets, "http://x")}
        word = parse_qs(urlsplit(found["sona"]).query)["pass"][0]
        person = site.person(source="sona", id="17", **{"pass": word})
        assert person.page("consent")["kind"] == "person"
        assert enter(site, 403, source="mturk", id="17", **{"pass": word})["error"] == "bad_link"
        # The study's key does not open the session in another browser.
        refused = enter(site, 403, source="sona", id="17", **{"pass": word})
        assert refused["error"] == "other_browser"


def test_links_for_people_are_printed_and_open_the_study(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with strict(tmp_path / "s", signed_links="person", sona_id="[0-9]+") as site:
        (tmp_path / "ids.txt").write_text("17\n18\n")
        words = ["experiment", "links", str(site.study.folder), "--ids", str(tmp_path / "ids.txt")]
        assert main([*words, "--source", "sona", "--base-url", "https://a.example"]) == 0
        rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
        assert [row[:2] for row in rows] == [["collide", "17"], ["collide", "18"]]
        query = {key: value[0] for key, value in parse_qs(urlsplit(rows[0][2]).query).items()}
        asked = {"source": "sona", "id": query["id"], "pass": query["pass"]}
        assert enter(site, 200, **asked)["state"]["scenario"] == query["scenario"] == "collide"
        assert enter(site, 200, **asked)["state"]["stage"] == "consent"  # in another browser
        assert enter(site, 403, **{**asked, "id": "18"})["error"] == "bad_link"
        lacking = {one.name: one.lacks for one in links(site.study, site.secrets, "http://x")}
        assert "--ids" in lacking["sona"] and lacking["preview"] == ""
        (tmp_path / "ids.txt").write_text("seventeen\n")
        assert main([*words, "--source", "sona"]) == 2
        assert "does not fit sona_id" in capsys.readouterr().err


def test_a_missing_list_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"none\.txt"):
        make_tiny_study(tmp_path / "s", recruitment=Recruitment(allow_list="none.txt"))


SONA = "https://uni.sona-systems.com/webstudy_credit.aspx?experiment_id=12&credit_token=ab9"


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    folder: Path = tmp_path_factory.mktemp("recruited") / "study"
    return make_tiny_study(
        folder, familiarization=1, test=1, size=64, scenarios=("collide", "drop"),
        recruitment=Recruitment(prolific_code="C0DE", sona_address=SONA, link_code="THANKS"),
    )  # fmt: skip


@pytest.fixture(scope="module")
def secrets(study: Study) -> Secrets:
    return Secrets.load(study.folder)


def session(source: str, name: str = "5e55") -> Any:
    return SimpleNamespace(source=source, session=name)


def raw(raw_id: str = "1234", **recruiter: str) -> Any:
    return SimpleNamespace(raw_id=raw_id, recruiter=recruiter)


class TestLinks:
    def test_each_recruiter_and_scenario_has_a_link(self, study: Study, secrets: Secrets) -> None:
        found = links(study, secrets, "https://lab.example.org/")
        assert [(one.name, one.scenario) for one in found] == [
            (name, scenario)
            for scenario in ("collide", "drop")
            for name in ("link", "prolific", "sona", "mturk", "preview", "simulated")
        ]
        for one in found:
            assert one.address.startswith(f"https://lab.example.org/?scenario={one.scenario}")

    def test_placeholders_have_the_recruiters_syntax(self, study: Study, secrets: Secrets) -> None:
        found = {one.name: one.address for one in links(study, secrets, "http://x:8000")}
        assert found["prolific"].endswith(
            "&PROLIFIC_PID={{%PROLIFIC_PID%}}&STUDY_ID={{%STUDY_ID%}}&SESSION_ID={{%SESSION_ID%}}"
        )
        assert found["sona"].endswith("&id=%SURVEY_CODE%")
        by_source = {one.source: one for one in RECRUITERS}
        for name in ("prolific", "sona"):
            given = set(parse_qs(urlsplit(found[name]).query)) - {"scenario"}
            assert given == {by_source[name].id, *by_source[name].others}

    def test_missing_settings_are_reported(self, study: Study, secrets: Secrets) -> None:
        found = {one.name: one.lacks for one in links(study, secrets, "http://x")}
        assert found["prolific"] == found["sona"] == found["link"] == ""
        assert "embed_from" in found["mturk"]
        bare = replace(study, recruitment=Recruitment(), embed_from=MTURK_HOSTS)
        found = {one.name: one.lacks for one in links(bare, secrets, "http://x")}
        assert "prolific_code" in found["prolific"] and "sona_address" in found["sona"]
        assert found["mturk"] == ""

    def test_serving_warns_where_ids_can_be_invented(self, study: Study) -> None:
        (warning,) = start_warnings(study)
        assert "ids of Prolific and SONA are not signed" in warning and "\n" not in warning
        signed = replace(study.recruitment, signed_links="study")
        assert start_warnings(replace(study, recruitment=signed)) == ()
        assert start_warnings(replace(study, recruitment=Recruitment())) == ()
        assert start_warnings(replace(study, allowed_ids=frozenset({"a"}))) == ()

    @pytest.mark.parametrize("base", [
        "", "lab.example.org", "ftp://lab.example.org", "https://", "https://x/deeper",
        "https://x/?a=b", "https://x/#a", "https://user@x", "https://x:99999", "javascript:x",
    ])  # fmt: skip
    def test_invalid_base_urls_are_refused(self, study: Study, secrets: Secrets, base: str) -> None:
        with pytest.raises(BadInputError, match="base-url"):
            links(study, secrets, base)

    def test_the_verb_prints_them(self, study: Study, capsys: pytest.CaptureFixture[str]) -> None:
        words = ["experiment", "links", str(study.folder), "--base-url", "https://a.example"]
        assert main(words) == 0
        printed = capsys.readouterr().out
        assert "https://a.example/?scenario=drop&pass=preview-" in printed
        assert "study.toml lacks embed_from" in printed
        assert main([*words, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)["links"]
        assert len(found) == 12
        assert set(found[0]) == {"name", "scenario", "address", "goes_to", "lacks", "condition"}
        assert main([*words[:4], "nothing"]) == 2
        assert capsys.readouterr().err.startswith("physion: --base-url 'nothing'")


class TestPasses:
    def test_a_key_is_valid_only_for_its_kind(self, secrets: Secrets) -> None:
        def key_of(word: str) -> str | None:
            return read_pass(secrets, Enter.model_validate({"pass": word}))

        for kind in ("preview", "simulated"):
            assert key_of(make_pass(secrets, kind)) == kind
        signature = make_pass(secrets, "preview").partition("-")[2]
        others = (f"simulated-{signature}", f"person-{signature}", signature, "é-é")
        longer = (f"preview-{signature}0", f"preview-{signature[:-1]}")
        for word in ("", "preview", "preview-", *others, *longer):
            assert key_of(word) is None, word

    def test_a_key_for_people_is_valid_for_its_recruiter_and_id(self, secrets: Secrets) -> None:
        def key_of(word: str, source: Any = "sona", raw_id: str | None = "17") -> str | None:
            asked = {"pass": word, "source": source, "id": raw_id}
            return read_pass(secrets, Enter.model_validate(asked))

        study = make_pass(secrets, "study", "sona")
        person = make_pass(secrets, "person", "sona", "17")
        assert (key_of(study), key_of(person)) == ("study", "person")
        assert key_of(study, raw_id="18") == "study"
        assert key_of(study, "prolific") is None is key_of(person, "prolific")
        assert key_of(person, raw_id="18") is None is key_of(person, raw_id=None)
        assert key_of(person.replace("person", "study")) is None


class TestCompletion:
    def test_the_code_of_the_recruiter(self, study: Study, secrets: Secrets) -> None:
        prolific = completion(study, secrets, session("prolific"), raw())
        assert prolific.code == "C0DE"
        assert prolific.url == "https://app.prolific.com/submissions/complete?cc=C0DE"
        # Ids are not needed for it.
        assert completion(study, secrets, session("prolific")) == prolific
        same = replace(study, recruitment=replace(study.recruitment, mturk_code="SAME"))
        assert completion(same, secrets, session("mturk"), raw()).code == "SAME"
        link = completion(study, secrets, session("link"))
        assert (link.code, link.url) == ("THANKS", None)
        bare = completion(replace(study, recruitment=Recruitment()), secrets, session("link"))
        assert (bare.code, bare.url) == (None, None)

    def test_who_ends_early_has_the_code_of_the_recruiter(self) -> None:
        declined = EarlyEnd("NO", "no consent", "https://lab.example/declined")
        prolific, other = (ending_completion(declined, source) for source in ("prolific", "link"))
        assert prolific.code == "NO" and prolific.url is not None and prolific.url.endswith("cc=NO")
        assert (other.code, other.url) == ("no consent", "https://lab.example/declined")
        nothing = ending_completion(EarlyEnd(code="no consent"), "prolific")
        assert (nothing.code, nothing.url) == (None, None)

    def test_sona_gets_the_survey_code_and_keeps_its_parameters(
        self, study: Study, secrets: Secrets
    ) -> None:
        found = completion(study, secrets, session("sona"), raw("77&x=1"))
        assert found.url is not None and found.url.startswith(SONA.partition("?")[0])
        assert parse_qs(urlsplit(found.url).query) == {
            "experiment_id": ["12"], "credit_token": ["ab9"], "survey_code": ["77&x=1"]
        }  # fmt: skip
        with_place = replace(study.recruitment, sona_address=f"{SONA}&survey_code=XXXX")
        again = completion(replace(study, recruitment=with_place), secrets, session("sona"),
                           raw("77&x=1"))  # fmt: skip
        assert again.url == found.url
        assert completion(study, secrets, session("sona")).url is None

    def test_mturk_forms_go_only_to_its_hosts(self, study: Study, secrets: Secrets) -> None:
        own = session_code(secrets, "5e55")
        assert len(own) == 10 and own != session_code(secrets, "5e56")
        evil = ("https://evil.example", "https://www.mturk.com.evil.example", "",
                "javascript:alert(1)", "http://www.mturk.com")  # fmt: skip
        for host in (*MTURK_HOSTS, *evil):
            sent = raw("w", assignmentId="a1", turkSubmitTo=f"{host}/" if host else "")
            found = completion(study, secrets, session("mturk"), sent)
            if host in MTURK_HOSTS:
                assert found.url == f"{host}/mturk/externalSubmit"
                assert found.post == {"assignmentId": "a1", "code": own}
            else:
                assert (found.code, found.url, found.post) == (own, None, None)
        assert completion(study, secrets, session("mturk")).code == own
