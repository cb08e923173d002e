"""A dataset made by hand in which a red square moves and a yellow one rests."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physion.trials.files import TrialPaths, encode_png, write_files
from physion.trials.index import build_index, write_index
from physion.trials.video import encode_movie
from support.hand_made import FRAMES, make_parts

SIZE, OBSERVED = 64, 45


def picture(red: int, yellow: int, grey: int = 90) -> NDArray[np.uint8]:
    """A picture with squares whose left edges are in these columns, on grey."""
    frame = np.full((SIZE, SIZE, 3), grey, np.uint8)
    frame[20:32, red : red + 12] = (200, 20, 20)
    frame[40:52, yellow : yellow + 12] = (220, 210, 30)
    return frame


def make_dataset(folder: Path, count: int = 4, look: str = "redyellow") -> Path:
    """Trials ``squares_0``, ...: the first half touches, in even ones red is on the left.

    Each has a grey of its own, so that no two movies are equal.
    """
    for place in range(count):
        name, left = f"squares_{place}", place % 2 == 0
        parts = make_parts(name, cloth=False, contact_frame=50 if place < count / 2 else None)
        metadata = dataclasses.replace(
            parts.metadata, look=look, width=SIZE, height=SIZE, index=place
        )
        starts = (4, 46) if left else (46, 4)
        steps = np.linspace(0, 14, FRAMES).astype(int) * (1 if left else -1)
        movie = np.stack([picture(starts[0] + int(step), starts[1], 90 + place) for step in steps])
        role_map = np.zeros((SIZE, SIZE, 4), np.uint8)
        role_map[20:32, starts[0] : starts[0] + 12] = (255, 0, 0, 255)
        role_map[40:52, starts[1] : starts[1] + 12] = (255, 255, 0, 255)
        files = {
            "movie": encode_movie(movie),
            "observed_movie": encode_movie(movie[:OBSERVED]),
            "map": encode_png(role_map),
            "trial_file": parts._replace(
                metadata=metadata, ids=np.zeros((SIZE, SIZE), np.int16)
            ).pack(),
        }
        write_files(TrialPaths(folder, "testing", "drop", name), files)
    table, problems = build_index(folder)
    assert not problems
    write_index(folder, table)
    return folder
