"""Static files of the participants' pages: vendored code, texts, and forbidden content."""

from __future__ import annotations

import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

import physion.experiment
from physion.experiment import protocol
from physion.experiment.protocol import REFUSALS
from physion.experiment.study import texts

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
