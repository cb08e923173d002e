"""No archive of others is unpacked, and no time of day decides anything."""

from __future__ import annotations

import ast
import time
from pathlib import Path

import numpy as np
import pytest

from physion.experiment.export.tables import iso_times
from support.sources import parsed

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
SCRIPTS = [
    path
    for path in (ROOT / "src" / "physion" / "experiment" / "static").rglob("*.js")
    if "vendor" not in path.parts
]


@pytest.mark.nightly
@pytest.mark.slow
def test_no_archive_is_unpacked() -> None:
    """A path with ``..`` or a link in an archive cannot lead out of a folder that nothing makes."""
    found = []
    for path in SOURCES:
        for node in ast.walk(parsed(path)):
            if not isinstance(node, ast.Call):
                continue
            name = ast.unparse(node.func)
            words = [ast.unparse(value) for value in node.args]
            words += [ast.unparse(word.value) for word in node.keywords]
            opened = name.endswith(("tarfile.open", "TarFile", "ZipFile"))
            if name.endswith(("extract", "extractall", "unpack_archive")) or (
                opened and not {"'w'", "'x'"} & set(words)
            ):
                found.append(f"{path.relative_to(ROOT)}: line {node.lineno}: {name}")
    assert not found


def test_pages_measure_with_a_clock_that_nobody_sets() -> None:
    """``performance.now`` only grows; ``Date`` follows the clock of the participant's machine."""
    texts = {path: path.read_text() for path in SCRIPTS}
    assert any("performance.now()" in text for text in texts.values())
    assert not [
        path.name for path, text in texts.items() if "Date.now" in text or "new Date" in text
    ]


@pytest.mark.skipif(not hasattr(time, "tzset"), reason="the time zone cannot be set here")
def test_exported_times_do_not_follow_the_time_zone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The hour that summer time repeats in Berlin, 25 October 2026, in steps of 15 minutes."""
    seconds = 1_792_886_400.0 + 900.0 * np.arange(12)
    texts = []
    for zone in ("UTC", "CET-1CEST,M3.5.0,M10.5.0/3", "<+1245>-12:45"):
        with monkeypatch.context() as patch:
            patch.setenv("TZ", zone)
            time.tzset()
            texts.append(iso_times(seconds).to_pylist())
    time.tzset()
    assert texts[0] == texts[1] == texts[2]
    assert texts[0] == sorted(set(texts[0])) and texts[0][0] == "2026-10-25T00:00:00.000Z"
