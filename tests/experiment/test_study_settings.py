"""study.toml and its folder, the texts of the pages, and what the documentation says of both."""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from physion.cli.experiment.experiment import SUBVERBS
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.tables import markdown_table
from physion.experiment.store.database import METADATA
from physion.experiment.study.settings import (
    Attention,
    Bonus,
    Comprehension,
    EarlyEnd,
    PaymentRule,
    Plausibility,
    Practice,
    Recruitment,
    Screen,
    StudySettings,
    Timing,
    format_settings,
    keys_of,
    parse_settings,
    tables,
)
from physion.experiment.study.study import Study, load_study, write_settings
from physion.experiment.study.texts import (
    read_consent_file,
    read_texts,
    shipped_file,
    shipped_languages,
    shipped_texts,
)
from support.experiment.own_questions import COMPREHENSION, OWN_QUESTIONS
from support.experiment.tiny_study import make_tiny_study
from support.paths import ROOT

LISTS = {"questions", "comprehension_questions", "conditions"}
"""Tables of which there may be several, or none."""


class Key(NamedTuple):
    """A key of ``study.toml``: its table (empty: top level), description and default (None: the key
    is required, or the default is to have none)."""

    table: str
    name: str
    about: str
    default: Any


def all_keys() -> list[Key]:
    """Return all keys in the order in which they are written."""
    kinds = [("", StudySettings), *((name, kind) for name, _, kind in tables())]
    return [
        Key(table, name, about, getattr(kind, name, None))
        for table, kind in kinds
        for name, about in keys_of(kind).items()
    ]


def settings_table() -> str:
    """Return the Markdown table of all keys for the documentation."""
    rows = []
    for key in all_keys():
        name = f"{key.table}.{key.name}" if key.table else key.name
        value = json.dumps(key.default, ensure_ascii=False)
        rows.append((f"`{name}`", "" if key.default is None else f"`{value}`", key.about))
    table = markdown_table(["key", "default", "meaning"], rows, tight=True)
    return table.replace(" |  | ", " | | ") + "\n"


def test_what_is_written_is_read_back() -> None:
    """Every setting differs from its default."""
    address = "https://lab.example.org/credit?experiment_id=1&credit_token=a%20b&x="
    early = EarlyEnd("CODE_1", "code-2", address)
    study = Study(
        folder=Path("somewhere"), name="a.b+c_1-2", version="\"1\" \\ é ☃ 🎲", title='it is """',
        contact="# Ada = [1] {2} \\u0041", scenarios=("my-own.scenario", "b"),
        languages=("pt-BR", "zh-Hant"), consent_version="2", funders="Abc", participants=10**6,
        seed=2**63 - 1, orders=100_000, exclusions="official-code", percentile_from=1, preload=1000,
        familiarization_feedback=False, demographics=False,
        embed_from=("https://www.mturk.com", "https://*.a-b.org:8443"),
        timing=Timing(fixation_ms=(0, 60_000), fixation_in_familiarization=False, cue_ms=0,
                      flash_hz=0.1 + 0.2, break_every=100_000),
        comprehension=Comprehension(attempts=100), questions=OWN_QUESTIONS,
        comprehension_questions=COMPREHENSION,
        practice=Practice(min_correct=1000, repeats=20, failed="flag"),
        attention=Attention(instructed=100, max_failed=1000),
        screen=Screen(min_width=320, min_height=10_000, fullscreen=True),
        plausibility=Plausibility(server_checks=False, fast_ms=0, fast_answers=1, reading_s=1e-7,
                                  max_showings=50, interrupted="void", simulated_speed=1e6),
        recruitment=Recruitment(
            id_needed=True, prolific_id=r'a\d"b', sona_id="[0-9]+", mturk_id=r"\w", link_id="'",
            allow_list="ids.txt", signed_links="person", hold_minutes=1, prolific_code="C0DE-1",
            sona_address=address, mturk_code="_", link_code="T", link_address=address,
        ),
        declined=early, stopped=early, screened_out=early, device_refused=early, full=early,
        payment=PaymentRule(amount=0.1, currency="credit points", minutes=90, least_per_hour=0.01),
        bonus=Bonus(per_correct=1e-3, above=1 / 3, most=1e6),
    )  # fmt: skip
    for key in all_keys():
        if key.table not in LISTS:
            owner = getattr(study, key.table) if key.table else study
            assert getattr(owner, key.name) != key.default, key
    read = parse_settings(tomllib.loads(format_settings(study, Path())), Path("study.toml"))
    assert Study(folder=study.folder, **vars(read)) == study


def test_every_setting_is_written_with_its_description(tmp_path: Path) -> None:
    make_tiny_study(tmp_path)
    text = (tmp_path / "study.toml").read_text()
    parsed = tomllib.loads(text)
    comments = " ".join(line.removeprefix("#").strip() for line in text.splitlines())
    assert len(all_keys()) > 60
    for key in all_keys():
        assert key.about and " ".join(key.about.split()) in " ".join(comments.split())
        if key.table not in LISTS:
            assert key.name in (parsed[key.table] if key.table else parsed)
    for name, about, kind in tables():
        assert about in " ".join(comments.split())
        assert set(keys_of(kind)) == {f.name for f in dataclasses.fields(kind)}
        assert name in LISTS or name in parsed


REFUSED: dict[str, tuple[str, Any, str]] = {
    "a name with a slash": ("name", "a/b", "letters, digits"),
    "an empty title": ("title", "  ", "at least 1 character"),
    "a title of two lines": ("title", "a\nb", "control characters"),
    "a number for a text": ("contact", 3, "must be a text"),
    "no scenario": ("scenarios", [], "must hold 1 values"),
    "a scenario twice": ("scenarios", ["collide", "collide"], "without duplicates"),
    "a word for a list": ("scenarios", "collide", "a list"),
    "a language that is a path": ("languages", ["../en"], "a language such as en"),
    "no participant": ("participants", 0, "greater than or equal to 1"),
    "half a participant": ("participants", 1.5, "a whole number"),
    "true for a number": ("participants", True, "a whole number"),
    "a negative seed": ("seed", -1, "greater than or equal to 0"),
    "unknown rules": ("exclusions", "none", "'preregistered-only' or 'official-code'"),
    "rules in a list": ("exclusions", ["preregistered"], "'preregistered-only' or 'official-code'"),
    "an amount without its time": ("payment.amount", 4, "needs payment.minutes"),
    "a currency of two lines": ("payment.currency", "a\nb", "one line"),
    "a site with a path": ("embed_from", ["https://a.org/x"], "without a path"),
    "a site without safety": ("embed_from", ["http://a.org"], "https://"),
    "a directive in a site": ("embed_from", ["https://a.org; script-src *"], "without a path"),
    "fixation backwards": ("timing.fixation_ms", [1500, 500], "the smaller number must be first"),
    "fixation of one end": ("timing.fixation_ms", [500], "must hold 2 values"),
    "a harmful flash": ("timing.flash_hz", 5, "less than or equal to 3"),
    "a flash that is no number": ("timing.flash_hz", float("nan"), "a finite number"),
    "a huge number": ("timing.flash_hz", 10**400, "number"),
    "a text for a flag": ("recruitment.id_needed", "yes", "true or false"),
    "a code with a quote": ("recruitment.prolific_code", 'C"1', "letters, digits"),
    "credit without a token": (
        "recruitment.sona_address", "https://s.org/?experiment_id=1", "credit_token"),
    "an address that is a script": ("recruitment.link_address", "javascript:alert(1)", "https://"),
    "an address that is no address": ("recruitment.link_address", "https://[", "https://"),
    "a pattern that is none": ("recruitment.prolific_id", "[0-9", "a regular expression"),
    "a list outside the folder": ("recruitment.allow_list", "../ids", "in the study folder"),
    "another way to sign": ("recruitment.signed_links", "yes", "'no', 'study' or 'person'"),
    "an unknown treatment": ("plausibility.interrupted", "skip", "'repeat' or 'void'"),
    "slow motion": ("plausibility.simulated_speed", 0.5, "greater than or equal to 1"),
    "no code for MTurk": ("recruitment.mturk_code", "", "session"),
    "a tiny window": ("screen.min_width", 10, "greater than or equal to 320"),
    "an unknown key": ("participant", 3, "unknown key 'participant'; did you mean 'participants'"),
    "an unknown key of a table": ("timing.cue", 3, "unknown key 'cue'; did you mean 'cue_ms'"),
    "an unknown table": ("timings", {"cue_ms": 3}, "unknown key 'timings'; did you mean 'timing'"),
    "a value for a table": ("timing", 3, "must be an object"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_a_bad_value_is_named_with_what_is_allowed(case: str) -> None:
    key, value, allowed = REFUSED[case]
    content = tomllib.loads(format_settings(minimal_study(), Path()))
    owner = content
    *above, name = key.split(".")
    for table in above:
        owner = owner[table]
    owner[name] = value
    with pytest.raises(BadInputError) as raised:
        parse_settings(content, Path("x/study.toml"))
    message = str(raised.value)
    named = message.startswith(f"x/study.toml: {key}") or "unknown key" in allowed
    assert named and allowed in message
    assert "\n" not in message


def test_a_wage_below_what_the_lab_wants_is_refused() -> None:
    content = tomllib.loads(format_settings(minimal_study(), Path()))
    content["payment"] = {"amount": 4, "currency": "EUR", "minutes": 30, "least_per_hour": 12}
    with pytest.raises(BadInputError) as raised:
        parse_settings(content, Path("study.toml"))
    assert "4 EUR for 30 minutes, 8.00 per hour: less than payment.least_per_hour, 12" in str(
        raised.value
    )
    content["payment"]["minutes"] = 20
    assert parse_settings(content, Path("study.toml")).payment.per_hour == 12
    assert PaymentRule().per_hour is None


@pytest.mark.parametrize("name", ["name", "version", "title", "contact", "scenarios"])
def test_what_a_lab_must_say_may_not_lack(name: str) -> None:
    content = tomllib.loads(format_settings(minimal_study(), Path()))
    del content[name]
    with pytest.raises(BadInputError, match=f"missing '{name}'"):
        parse_settings(content, Path("study.toml"))


@pytest.mark.parametrize("content", [b"name = ", b"\xff\xfe", b"x = " + b"9" * 5000, b"[" * 9000])
def test_what_is_no_toml_is_refused(tmp_path: Path, content: bytes) -> None:
    make_tiny_study(tmp_path)
    (tmp_path / "study.toml").write_bytes(content)
    with pytest.raises(BadInputError, match=r"study\.toml is not TOML"):
        load_study(tmp_path)


# --- the folder ----------------------------------------------------------------------------------


def test_a_study_folder_is_loaded_whole(tmp_path: Path) -> None:
    made = make_tiny_study(tmp_path, test=4, familiarization=2, scenarios=("collide", "roll"))
    study = load_study(str(tmp_path))
    assert study == made
    assert [s.place for s in study.phase("roll", "test")] == [0, 1, 2, 3]
    assert {s.scenario for s in study.stimuli} == {"collide", "roll"}
    assert study.texts["de"].keys() == study.texts["en"].keys()


def test_every_file_counts_for_the_digest(tmp_path: Path) -> None:
    first = make_tiny_study(tmp_path)
    digests = {first.digest}
    for name in ("study.toml", "texts/en.toml", "texts/de.toml"):
        with (tmp_path / name).open("a") as file:
            file.write("\n# looked at\n")
        found = load_study(tmp_path)
        digests.add(found.digest)
        assert found.stimuli_digest == first.stimuli_digest
    rows = (tmp_path / "stimuli.csv").read_text()
    (tmp_path / "stimuli.csv").write_text(rows.replace("_0001,", "_0099,"))
    last = load_study(tmp_path)
    assert last.stimuli_digest != first.stimuli_digest
    assert len(digests | {last.digest}) == 5


@pytest.mark.parametrize(
    "name", ["study.toml", "stimuli.csv", "texts/de.toml", "media/00000.mp4", "media/00000.png"]
)
def test_missing_files_and_links_are_refused(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "study"
    with pytest.raises(BadInputError, match="no study folder"):
        load_study(folder)
    make_tiny_study(folder)
    path, elsewhere = folder / name, tmp_path / "elsewhere"
    path.rename(elsewhere)
    with pytest.raises(BadInputError, match=r"is missing") as raised:
        load_study(folder)
    assert str(path) in str(raised.value)
    path.symlink_to(elsewhere)
    with pytest.raises(BadInputError, match="link"):
        load_study(folder)
    path.unlink()
    if hasattr(os, "mkfifo"):
        os.mkfifo(path)  # nobody waits for what it may hold
    else:
        path.mkdir()
    with pytest.raises(BadInputError, match="not a regular file"):
        load_study(folder)


def test_a_scenario_without_stimuli_is_refused_and_one_can_be_taken_out(tmp_path: Path) -> None:
    study = make_tiny_study(tmp_path, scenarios=("collide", "roll"))
    write_settings(dataclasses.replace(study, scenarios=("roll",)))
    assert {s.scenario for s in load_study(tmp_path).stimuli} == {"roll"}
    write_settings(dataclasses.replace(study, scenarios=("collide", "drop")))
    with pytest.raises(BadInputError, match="no stimulus of drop for familiarization"):
        load_study(tmp_path)
    before = (tmp_path / "study.toml").read_bytes()
    with pytest.raises(BadInputError, match="participants"):
        write_settings(dataclasses.replace(study, participants=0))
    assert (tmp_path / "study.toml").read_bytes() == before


def minimal_study() -> Study:
    return Study(
        folder=Path("somewhere"),
        name="tiny",
        version="1",
        title="A title",
        contact="Ada, ada@example.org",
        scenarios=("collide",),
    )


# --- texts of the pages ---------------------------------------------------------------------------


def test_two_languages_are_shipped() -> None:
    assert {"en", "de"} <= set(shipped_languages())
    with pytest.raises(UnknownNameError, match="closest"):
        shipped_file("tlh")


@pytest.mark.parametrize("language", shipped_languages())
def test_shipped_languages_are_whole(tmp_path: Path, language: str) -> None:
    (tmp_path / f"{language}.toml").write_bytes(shipped_file(language))
    texts, content = read_texts(tmp_path, language)
    assert texts.keys() == shipped_texts().keys() and content == shipped_file(language)
    for key, original in shipped_texts().items():
        # A translation that leaves a number out would leave people without it.
        assert set(words_in_braces(texts[key])) == set(words_in_braces(original)), key


def test_a_missing_text_is_named_with_the_original(tmp_path: Path) -> None:
    path = copy_german(tmp_path)
    tables = tomllib.loads(path.read_text())
    path.write_text(path.read_text().replace("\nnext = ", "\nnxt = ", 1))
    with pytest.raises(BadInputError, match=r"unknown text 'common\.nxt'.*closest: common\.next"):
        read_texts(tmp_path, "de")
    path.write_text(re.sub(r"\nnxt = .*", "", path.read_text()))
    with pytest.raises(BadInputError, match=r"lacks the text common\.next") as raised:
        read_texts(tmp_path, "de")
    assert str(path) in str(raised.value) and tables["common"]["next"] not in str(raised.value)
    assert repr(shipped_texts()["common.next"]) in str(raised.value)


BAD_TEXTS = {
    **{f"next = {value[:9]}": (r"\nnext = .*", f"\nnext = {value}", "must be a text in quotes")
       for value in ('""', '"  "', "3", '["a"]', "true", '"' + "x" * 20_001 + '"')},
    "an unknown word": (r"{reference}", "{refrence}", r"{refrence}; it may have {reference}"),
    "a word in a title": (
        r"\Z", '[study]\ntitle = "{contact}"\n', "has {contact}; it may have none"),
    "a tenth box": (
        r"\[consent\]\n", '[consent]\ncheck_10 = "A"\n', "unknown text 'consent.check_10'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_TEXTS)
def test_bad_texts_are_refused(tmp_path: Path, case: str) -> None:
    old, new, message = BAD_TEXTS[case]
    path = copy_german(tmp_path)
    path.write_text(re.sub(old, new, path.read_text(), count=1))
    with pytest.raises(BadInputError) as raised:
        read_texts(tmp_path, "de")
    assert message in str(raised.value)


def test_a_lab_may_change_every_word_and_add_boxes_to_tick(tmp_path: Path) -> None:
    path = copy_german(tmp_path)
    changed = re.sub(r"\nnext = .*", '\nnext = "Vorwärts <b>&amp;"', path.read_text(), count=1)
    boxes = '[consent]\ncheck_1 = "Ich bin volljährig."\ncheck_9 = "Ich habe alles gelesen."\n'
    path.write_text(changed.replace("[consent]\n", boxes))
    texts, _ = read_texts(tmp_path, "de")
    assert texts["common.next"] == "Vorwärts <b>&amp;"
    assert texts["consent.check_1"] == "Ich bin volljährig."


SCENARIO_TEXTS = """
[study]
title = "Was geschieht?"
[scenario.drape.trial]
prompt = "Wird das Tuch den gelben Gegenstand berühren?"
[scenario."a.b".consent]
text = "Ein Film dauert {minutes} Minuten."
"""


def test_titles_are_translated_and_texts_differ_by_scenario(tmp_path: Path) -> None:
    path = copy_german(tmp_path)
    path.write_text(path.read_text() + SCENARIO_TEXTS)
    texts, _ = read_texts(tmp_path, "de", ("collide", "drape", "a.b"))
    assert texts["study.title"] == "Was geschieht?"
    assert texts["scenario.drape.trial.prompt"].startswith("Wird das Tuch")
    assert texts["scenario.a.b.consent.text"] == "Ein Film dauert {minutes} Minuten."
    with pytest.raises(BadInputError, match=r"unknown text 'scenario\.drape\.trial\.prompt'"):
        read_texts(tmp_path, "de", ("collide", "a.b"))
    path.write_text(path.read_text().replace('\nprompt = "Wird das', '\npromt = "Wird das'))
    with pytest.raises(BadInputError, match=r"unknown text 'trial\.promt'.*closest: trial\.prompt"):
        read_texts(tmp_path, "de", ("drape", "a.b"))


def test_a_consent_form_is_a_pdf_file(tmp_path: Path) -> None:
    assert read_consent_file(tmp_path, "en") is None
    path = tmp_path / "consent-en.pdf"
    path.write_bytes(b"%PDF-1.7 ...")
    assert read_consent_file(tmp_path, "en") == b"%PDF-1.7 ..."
    path.write_bytes(b"<html>")
    with pytest.raises(BadInputError, match="no PDF file"):
        read_consent_file(tmp_path, "en")
    path.unlink()
    path.symlink_to(tmp_path / "elsewhere.pdf")
    with pytest.raises(BadInputError, match="link"):
        read_consent_file(tmp_path, "en")


def words_in_braces(text: str) -> list[str]:
    return re.findall(r"\{([a-z_]+)\}", text)


def copy_german(folder: Path) -> Path:
    path = folder / "de.toml"
    path.write_bytes(shipped_file("de"))
    return path


# --- the pages of the documentation ---------------------------------------------------------------


DOCS = ROOT / "docs"
PAGE = "".join(
    (DOCS / name).read_text()
    for name in (
        "tutorials/study.md",
        "how-to/run-a-study.md",
        "reference/study.md",
        "how-to/compare.md",
    )
)


def test_every_command_has_its_verb_and_options() -> None:
    found = re.findall(r"physion (experiment [a-z]+[^\n`#]*)", PAGE.replace("\\\n", " "))
    commands = [shlex.split(line) for line in found]
    assert {words[1] for words in commands} >= set(SUBVERBS)
    for words in commands:
        options = importlib.import_module(SUBVERBS[words[1]]).Options
        known = {field.name for field in dataclasses.fields(options)}
        for word in words[2:]:
            if word.startswith("--"):
                name = word.removeprefix("--").removeprefix("no-").replace("-", "_")
                assert name in known, " ".join(words)


def test_every_setting_that_is_given_is_one_that_the_file_may_have() -> None:
    given = re.findall(r"`([a-z_]+ = [^`]+)`", PAGE)
    tables = {key.name: key.table for key in reversed(all_keys())}
    assert len(given) >= 5
    needed = {"name": "n", "version": "1", "title": "t", "contact": "c", "scenarios": ["collide"]}
    for line in given:
        name = line.partition(" ")[0]
        content = f"[{tables[name]}]\n{line}" if tables[name] else line
        settings = parse_settings(needed | tomllib.loads(content), Path(line))
        assert isinstance(settings, StudySettings)


def test_the_table_of_settings_is_generated() -> None:
    """To make it anew, print `settings_table()` into the section Settings."""
    assert settings_table() in PAGE


def test_every_table_is_described() -> None:
    described = re.findall(
        r"^\| `([a-z_]+)` \|", PAGE.partition("## Settings")[0], flags=re.MULTILINE
    )
    assert set(described) == set(METADATA.tables)
