"""Text of numbers and names, as page and figures write them."""

from __future__ import annotations

import re
from collections.abc import Sequence

import pandas as pd

from physion.analysis.tables.predictions import DATASETS, PROTOCOLS

_RELATIVE = re.compile(rf"( · (?:{'|'.join(DATASETS)}) )(same|all but this)\b", re.IGNORECASE)


def plural(count: int, noun: str) -> str:
    """Return count and noun, such as ``1 model``, ``2 models``, ``2 stimuli``."""
    many = noun.removesuffix("us") + "i" if noun.endswith("us") else noun + "s"
    return f"{count} {noun if count == 1 else many}"


def listed(names: Sequence[str]) -> str:
    """Return names with commas and, before the last one, ``and``."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def number(value: float, digits: int = 2) -> str:
    """Return a number with this many decimals, or ``NaN``.

    Negative numbers have a minus sign (not a hyphen); a rounded zero has none.
    """
    if pd.isna(value):
        return "NaN"
    # Adding zero turns -0.0 into 0.0.
    return f"{round(float(value), digits) + 0.0:.{digits}f}".replace("-", "−")


def protocol_names(text: str) -> str:
    """Return ``text`` with training protocols called *all-but* and *only*.

    Tables of the analysis hold the column and value of the predictions, such as *dynamics training
    dataset same*. The column is removed only for the dynamics; for other parts it stays.
    """
    short = _RELATIVE.sub(lambda match: match[1] + PROTOCOLS[match[2]], text)
    return short.replace(" · dynamics training dataset ", " · ")
