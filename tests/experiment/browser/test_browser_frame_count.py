"""The count of presented frames, from reports as browsers give them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from support.experiment.browser import Visit, chromium, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
COUNT = """async (cases) => {
  const loaded = performance.getEntriesByType("resource").map((entry) => entry.name);
  const { FrameCount } = await import(loaded.find((name) => name.endsWith("/screen.js")));
  return cases.map((reports) => {
    const frames = new FrameCount(30);
    for (const [frame, presentedFrames] of reports)
      frames.add(0, { mediaTime: frame / 30, presentedFrames });
    return frames.shown;
  });
}"""
EVERY = [(frame, frame + 1) for frame in range(45)]
CASES = {
    "no report": ([], 0),
    "every frame": (EVERY, 45),
    "the first frame twice": ([(0, 1), *((frame, count + 1) for frame, count in EVERY)], 45),
    "missed reports": ([(0, 1), (3, 4), (44, 45)], 45),
    "dropped frames": ([(0, 1), (3, 2), (44, 23)], 23),
    "missed reports and dropped frames": ([(0, 1), (10, 6)], 6),
    "more presented than there are frames between": ([(0, 1), (2, 9)], 3),
    # Once counted 52 of 45 frames.
    "a report too early": ([(0, 1), (8, 2), *((f, f + 2) for f in range(1, 45))], 45),
    "a counter that stands still": ([(0, 1), (1, 1), (2, 1)], 3),
}


def test_each_presented_frame_counts_once(chromium: Any, tmp_path: Path) -> None:
    with served(tmp_path) as (_, server), Visit(chromium, server.url) as visit:
        visit.begin("?participant=Count")
        counts = visit.page.evaluate(COUNT, [reports for reports, _ in CASES.values()])
    expected = {name: count for name, (_, count) in CASES.items()}
    assert dict(zip(CASES, counts, strict=True)) == expected
