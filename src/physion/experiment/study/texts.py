"""All words of the participants' pages, one file a language.

``texts/LANGUAGE.toml`` has one table a page with one line a text, ``[consent]`` and
``title = "..."``; programs know that text as ``consent.title``. ``{words}`` in braces are put in by
the pages. A study has copies of its own, so that a lab can change every word.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from physion.errors import BadInputError, UnknownNameError
from physion.experiment.study.plain_files import read_plain
from physion.experiment.study.study_file import parse_toml

TEXTS_FOLDER = "texts"
MAX_BYTES = 1_000_000
MAX_TEXT = 20_000
_PLACEHOLDER = re.compile(r"\{([a-z_]+)\}")


def read_texts(folder: Path, language: str) -> tuple[dict[str, str], bytes]:
    """The texts of a language by their keys, and the bytes of their file.

    `BadInputError` names a key that is missing, unknown, no text, or empty, and words in braces
    that the pages do not put in.
    """
    path = folder / f"{language}.toml"
    content = read_plain(path, MAX_BYTES)
    texts = _flat(path, content)
    wanted = shipped_texts()
    for key in texts:
        if key not in wanted:
            raise BadInputError(f"{path}: {UnknownNameError('text', key, wanted)}")
    for key, original in wanted.items():
        if key not in texts:
            raise BadInputError(
                f"{path} lacks the text {key}; in English it is: {original[:100]!r}"
            )
        known = set(_PLACEHOLDER.findall(original))
        for word in set(_PLACEHOLDER.findall(texts[key])) - known:
            allowed = ", ".join(f"{{{one}}}" for one in sorted(known)) or "none"
            raise BadInputError(f"{path}: {key} has {{{word}}}; it may have {allowed}")
    return texts, content


def shipped_languages() -> list[str]:
    """Languages that the package brings, in alphabetical order."""
    files = resources.files("physion.experiment").joinpath(TEXTS_FOLDER).iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


def shipped_file(language: str) -> bytes:
    """The file of a language that the package brings; `UnknownNameError` for another one."""
    if language not in shipped_languages():
        raise UnknownNameError("language", language, shipped_languages())
    folder = resources.files("physion.experiment").joinpath(TEXTS_FOLDER)
    return folder.joinpath(f"{language}.toml").read_bytes()


@cache
def shipped_texts() -> Mapping[str, str]:
    """The English texts of the package: their keys are those that every language needs."""
    return _flat(Path(TEXTS_FOLDER) / "en.toml", shipped_file("en"))


def _flat(path: Path, content: bytes) -> dict[str, str]:
    found: dict[str, str] = {}
    _walk(path, "", parse_toml(path, content), found)
    return found


def _walk(path: Path, above: str, table: Mapping[str, Any], found: dict[str, str]) -> None:
    for name, value in table.items():
        key = f"{above}{name}"
        if isinstance(value, Mapping):
            _walk(path, f"{key}.", value, found)
        elif not isinstance(value, str) or not value.strip() or len(value) > MAX_TEXT:
            raise BadInputError(
                f"{path}: {key} must be a text in quotes of 1 to {MAX_TEXT} characters, "
                f"not {repr(value)[:100]}"
            )
        else:
            found[key] = value
