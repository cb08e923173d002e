"""Tag that distinguishes the settings of engines in the names of their results."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import Any


def settings_tag(settings: Any) -> str:
    """Return eight hexadecimal digits that change whenever a field of a dataclass does."""
    text = json.dumps(asdict(settings), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]
