"""Texts of the pages: all languages have all keys and only known placeholders."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from physion.core.errors import BadInputError, UnknownNameError
from physion.experiment.study.texts import (
    read_consent_file,
    read_texts,
    shipped_file,
    shipped_languages,
    shipped_texts,
)


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
        assert set(_words(texts[key])) == set(_words(original)), key


def test_a_missing_text_is_named_with_the_original(tmp_path: Path) -> None:
    path = _copy(tmp_path)
    tables = tomllib.loads(path.read_text())
    path.write_text(path.read_text().replace("\nnext = ", "\nnxt = ", 1))
    with pytest.raises(BadInputError, match=r"unknown text 'common\.nxt'.*closest: common\.next"):
        read_texts(tmp_path, "de")
    path.write_text(re.sub(r"\nnxt = .*", "", path.read_text()))
    with pytest.raises(BadInputError, match=r"lacks the text common\.next") as raised:
        read_texts(tmp_path, "de")
    assert str(path) in str(raised.value) and tables["common"]["next"] not in str(raised.value)
    assert repr(shipped_texts()["common.next"]) in str(raised.value)


@pytest.mark.parametrize("value", ['""', '"  "', "3", '["a"]', "true", '"' + "x" * 20_001 + '"'])
def test_what_is_no_text_is_refused(tmp_path: Path, value: str) -> None:
    path = _copy(tmp_path)
    path.write_text(re.sub(r"\nnext = .*", f"\nnext = {value}", path.read_text(), count=1))
    with pytest.raises(BadInputError, match=r"common\.next must be a text in quotes"):
        read_texts(tmp_path, "de")


def test_words_in_braces_must_be_known(tmp_path: Path) -> None:
    path = _copy(tmp_path)
    path.write_text(path.read_text().replace("{reference}", "{refrence}", 1))
    with pytest.raises(BadInputError, match=r"\{refrence\}; it may have \{reference\}"):
        read_texts(tmp_path, "de")


def test_a_lab_may_change_every_word(tmp_path: Path) -> None:
    path = _copy(tmp_path)
    changed = re.sub(r"\nnext = .*", '\nnext = "Vorwärts <b>&amp;"', path.read_text(), count=1)
    path.write_text(changed)
    texts, _ = read_texts(tmp_path, "de")
    assert texts["common.next"] == "Vorwärts <b>&amp;"


SCENARIO_TEXTS = """
[study]
title = "Was geschieht?"
[scenario.drape.trial]
prompt = "Wird das Tuch den gelben Gegenstand berühren?"
[scenario."a.b".consent]
text = "Ein Film dauert {minutes} Minuten."
"""


def test_titles_are_translated_and_texts_differ_by_scenario(tmp_path: Path) -> None:
    path = _copy(tmp_path)
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


def test_words_in_braces_of_a_scenario_must_be_known(tmp_path: Path) -> None:
    path = _copy(tmp_path)
    path.write_text(path.read_text() + '[scenario.drape.study]\ntitle = "{contact}"\n')
    with pytest.raises(BadInputError, match=r"drape\.study\.title has \{contact\}.*have none"):
        read_texts(tmp_path, "de", ("drape",))


def test_boxes_to_tick_are_optional_and_at_most_nine(tmp_path: Path) -> None:
    path = _copy(tmp_path)
    boxes = '[consent]\ncheck_1 = "Ich bin volljährig."\ncheck_9 = "Ich habe alles gelesen."\n'
    path.write_text(path.read_text().replace("[consent]\n", boxes))
    texts, _ = read_texts(tmp_path, "de")
    assert texts["consent.check_1"] == "Ich bin volljährig."
    path.write_text(path.read_text().replace("check_9", "check_10"))
    with pytest.raises(BadInputError, match=r"unknown text 'consent\.check_10'"):
        read_texts(tmp_path, "de")


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


def _words(text: str) -> list[str]:
    return re.findall(r"\{([a-z_]+)\}", text)


def _copy(folder: Path) -> Path:
    path = folder / "de.toml"
    path.write_bytes(shipped_file("de"))
    return path
