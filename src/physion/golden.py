"""Digests that a known trial of each scenario must have, on every machine.

`physion.trials.making.reproduce` computes them; the file beside this module holds those of this
version.
They are part of the names of engine and renderer: whoever reads a trial can tell whether the
software that made it would make the same bytes as their own.
"""

from __future__ import annotations

import hashlib
import json
from functools import cache
from importlib.resources import files

FILE = "golden_digests.json"


@cache
def golden_digests() -> dict[str, dict[str, str]]:
    """Return the digests of this version by scenario and part of a trial."""
    text = (files("physion") / FILE).read_text()
    return {scenario: dict(parts) for scenario, parts in json.loads(text).items()}


@cache
def version_digest(*parts: str) -> str:
    """Return 8 hexadecimal digits that change whenever one of these parts of a golden trial does.

    ``parts`` are keys of `golden_digests`, for example ``motion``.
    """
    golden = golden_digests()
    known = [golden[scenario].get(part, "") for scenario in sorted(golden) for part in parts]
    return hashlib.sha256("\n".join(known).encode()).hexdigest()[:8]
