"""Texts of the participants' pages, one file per language.

``texts/LANGUAGE.toml`` has one table per page and one line per text: ``title = "..."`` in
``[consent]`` has the key ``consent.title``. The pages replace placeholders in braces. Each study
has its own copies, so that a lab can edit every text.

Some texts may be absent: ``study.title``, in place of the title of ``study.toml``;
``consent.check_1`` to ``consent.check_9``, boxes that must be ticked to agree; and
``scenario.NAME.KEY`` and ``condition.NAME.KEY``, in place of the text ``KEY`` in the sessions of
one scenario or condition (the condition comes first). The texts of
a study's own questions (`settings.Question.text_keys`) are needed in each language. A file
``consent-LANGUAGE.pdf`` next to the texts is the consent form as a file; pictures of questions are
PNG files there.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import read_plain
from physion.core.settings import flatten, parse_toml

TEXTS_FOLDER = "texts"
MAX_BYTES = 1_000_000
MAX_TEXT = 20_000
OPTIONAL = ("study.title", *(f"consent.check_{number}" for number in range(1, 10)))
MAX_FILE = 20_000_000
_PLACEHOLDER = re.compile(r"\{([a-z_]+)\}")


def read_texts(
    folder: Path,
    language: str,
    scenarios: Sequence[str] = (),
    own: Sequence[str] = (),
    conditions: Sequence[str] = (),
) -> tuple[dict[str, str], bytes]:
    """Read and check the texts of a language; return them by key, and the bytes of the file.

    Parameters
    ----------
    folder
        The folder of the text files.
    language
        Language of the file to read.
    scenarios
        Scenarios that may have texts of their own.
    own
        Keys of the texts of the study's own questions and conditions, which are needed too.
    conditions
        Conditions that may have texts of their own.

    Raises
    ------
    BadInputError
        A key is missing, unknown, empty or not a text, or has an unknown placeholder in braces.
    """
    path = folder / f"{language}.toml"
    content = read_plain(path, MAX_BYTES)
    texts = _parse(path, content)
    wanted = shipped_texts()
    special = [*(f"condition.{name}." for name in conditions),
               *(f"scenario.{name}." for name in scenarios)]  # fmt: skip
    for key in texts:
        general = _general_key(key, special)
        if general not in (*wanted, *OPTIONAL, *own):
            raise BadInputError(f"{path}: {UnknownNameError('text', general, wanted)}")
    for key, original in wanted.items():
        if key not in texts:
            raise BadInputError(
                f"{path} lacks the text {key}; in English it is: {original[:100]!r}"
            )
    for key in own:
        if key not in texts:
            raise BadInputError(f"{path} lacks the text {key}, which study.toml needs")
    for key, written in texts.items():
        general = _general_key(key, special)
        known = set(_PLACEHOLDER.findall(wanted.get(general, "")))
        for name in set(_PLACEHOLDER.findall(written)) - known:
            allowed = ", ".join(f"{{{one}}}" for one in sorted(known)) or "none"
            raise BadInputError(f"{path}: {key} has {{{name}}}; it may have {allowed}")
    return texts, content


def read_consent_file(folder: Path, language: str) -> bytes | None:
    """Return the consent form of a language as a file (PDF), or None if there is none.

    Raises
    ------
    BadInputError
        The file is a link, is larger than `MAX_FILE`, or is no PDF.
    """
    path = folder / f"consent-{language}.pdf"
    if not os.path.lexists(path):
        return None
    content = read_plain(path, MAX_FILE)
    if not content.startswith(b"%PDF-"):
        raise BadInputError(f"{path} is no PDF file; replace or remove it")
    return content


def read_picture(folder: Path, name: str) -> bytes:
    """Return the picture of a question; `BadInputError` if it is missing, a link, or no PNG."""
    content = read_plain(folder / name, MAX_FILE)
    if not content.startswith(b"\x89PNG\r\n\x1a\n"):
        raise BadInputError(f"{folder / name} is no PNG file; replace it")
    return content


def _general_key(key: str, special: Sequence[str]) -> str:
    """Return the key of the text that ``key`` replaces in a scenario or condition, or ``key``.

    ``special``: what the keys of single scenarios and conditions begin with.
    """
    for beginning in special:
        if key.startswith(beginning):
            return key.removeprefix(beginning)
    return key


def shipped_languages() -> list[str]:
    """Return the languages whose texts ship with the package, in alphabetical order."""
    files = resources.files("physion.experiment").joinpath(TEXTS_FOLDER).iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


def shipped_file(language: str) -> bytes:
    """Return the shipped text file of a language; `UnknownNameError` if there is none."""
    if language not in shipped_languages():
        raise UnknownNameError("language", language, shipped_languages())
    folder = resources.files("physion.experiment").joinpath(TEXTS_FOLDER)
    return folder.joinpath(f"{language}.toml").read_bytes()


def shipped_question(name: str, file: str) -> bytes:
    """Return a file of a question that ships with the package: its picture, or its texts."""
    folder = resources.files("physion.experiment").joinpath("questions", name)
    return folder.joinpath(file).read_bytes()


@cache
def shipped_texts() -> Mapping[str, str]:
    """Return the shipped English texts, whose keys every language must have."""
    return _parse(Path(TEXTS_FOLDER) / "en.toml", shipped_file("en"))


def parse_bytes(path: Path, content: bytes) -> dict[str, Any]:
    """Parse the content of a TOML file that was read from ``path``."""
    try:
        return parse_toml(content.decode(), str(path))
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path} is not TOML: {error}") from error


def _parse(path: Path, content: bytes) -> dict[str, str]:
    """Return the texts of a file by their full keys, such as ``consent.title``."""
    texts = flatten(parse_bytes(path, content))
    for key, value in texts.items():
        if not isinstance(value, str) or not value.strip() or len(value) > MAX_TEXT:
            raise BadInputError(
                f"{path}: {key} must be a text in quotes of 1 to {MAX_TEXT} characters, "
                f"not {repr(value)[:100]}"
            )
    return texts
