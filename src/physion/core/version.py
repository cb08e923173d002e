"""Version of the package, which is stored with everything that it makes."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files

from physion.core.files import digest_of

__version__ = "0.1.0"
MADE_WITH = f"physion {__version__}"
"""Name of the package with its version, as it stands in files that the package writes."""


# Golden digests: hashes that one known trial of each scenario must have on every machine.
#
# `physion.trials.making.reproduce` computes them; `golden_digests.json` in this folder stores
# the digests of this version. A short hash of them is part of the version strings of engine and
# renderer, which every trial stores: engines or renderers of one version string made the same
# golden trials.

FILE = "golden_digests.json"


@cache
def golden_digests() -> dict[str, dict[str, str]]:
    """Return the digests of this version, by scenario and then by part of the trial."""
    text = (files("physion.core") / FILE).read_text()
    return {scenario: dict(parts) for scenario, parts in json.loads(text).items()}


@cache
def version_digest(*parts: str) -> str:
    """Return 8 hexadecimal digits that change if one of ``parts`` of any golden trial changes.

    ``parts`` are parts of a trial as in `golden_digests`, for example ``motion``.
    """
    golden = golden_digests()
    known = [golden[scenario].get(part, "") for scenario in sorted(golden) for part in parts]
    return digest_of("\n".join(known))[:8]
