"""A small but complete study folder, with movies whose pixels encode the frame number.

Each movie shows a blue disk (agent) and a green square (patient) on grey. Six blocks of equal width
along the lower edge, an eighth of the image high, encode the frame index (from 0) in binary: white
is 1, black is 0, the highest digit is left. `read_number` decodes it from an image; a browser test
does the same with the pixels of a canvas, at ``((i + 0.5) / 6, 15 / 16)`` of width and height. Full
movies continue to frame 59 and end with the agent at the patient, or away from it.
"""

from __future__ import annotations

import io
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from argon2 import PasswordHasher
from numpy.typing import NDArray
from PIL import Image

from physion.experiment.study.identity import SECRET_FILE, Secrets
from physion.experiment.study.settings import Plausibility
from physion.experiment.study.stimuli import STIMULI_FILE, Stimulus, write_stimuli
from physion.experiment.study.study import Study, load_study, write_settings
from physion.experiment.study.texts import TEXTS_FOLDER, shipped_file
from physion.trials.video import encode_movie

UNCHECKED = Plausibility(server_checks=False, simulated_speed=1_000_000)
"""Lets tests answer without showing a movie, and simulated participants without waiting."""
OBSERVED, FULL, RATE, BLOCKS = 45, 60, 30, 6
PASSWORD = "tiny password"
CONTACT = ("--contact", "Ada Lab, ada@example.org")
"""Options of `physion experiment init`."""


def make_tiny_study(
    folder: Path,
    *,
    test: int = 6,
    familiarization: int = 10,
    obvious: int = 0,
    scenarios: tuple[str, ...] = ("collide",),
    size: int = 128,
    password: str = PASSWORD,
    plausibility: Plausibility = UNCHECKED,
    prolific_id: str = "",
    more_texts: str = "",
    **settings: Any,
) -> Study:
    """Write and load a study with alternating labels (the first trial has contact).

    Parameters
    ----------
    folder
        The study folder to create.
    test, familiarization, obvious
        Number of trials per scenario in each phase; ``obvious`` ones are attention checks.
    scenarios
        Names of the scenarios.
    size
        Width and height of the movies in pixels.
    password
        The experimenter's password.
    plausibility
        Rules of plausible sessions; by default answers may come at any time and without media.
    prolific_id
        Pattern of Prolific's ids; by default any id is allowed.
    more_texts
        Lines that are added to the texts of each language.
    settings
        Fields of `Study` (``participants=3``, ``timing=Timing(cue_ms=100)``, ...).
    """
    (folder / "media").mkdir(parents=True, exist_ok=True)
    stimuli, number = [], 0
    for scenario in scenarios:
        for phase, count in (
            ("familiarization", familiarization),
            ("test", test),
            ("attention", obvious),
        ):
            for place in range(count):
                stimuli.append(_stimulus(folder, scenario, phase, place, number, size))
                number += 1
    write_stimuli(folder / STIMULI_FILE, stimuli)
    study = Study(
        folder=folder,
        name="tiny",
        version="1",
        title="A tiny study",
        contact="Ada Lab, ada@example.org",
        scenarios=scenarios,
    )
    study = replace(study, plausibility=plausibility, **settings)
    study = replace(study, recruitment=replace(study.recruitment, prolific_id=prolific_id))
    (folder / TEXTS_FOLDER).mkdir(exist_ok=True)
    for language in study.languages:
        (folder / TEXTS_FOLDER / f"{language}.toml").write_bytes(
            shipped_file(language) + more_texts.encode()
        )
    write_settings(study)
    Secrets.create(folder)
    secret = json.loads((folder / SECRET_FILE).read_text())
    (folder / SECRET_FILE).write_text(json.dumps(secret | {"password_hash": _hash(password)}))
    return load_study(folder)


@cache
def _hash(password: str) -> str:
    """Hash a password as `Secrets.create` does, but with cheap parameters."""
    return PasswordHasher(time_cost=1, memory_cost=8, parallelism=1).hash(password)


def read_number(frame: NDArray[np.uint8]) -> int:
    """Decode the frame index from an image (H, W, 3)."""
    height, width = frame.shape[:2]
    row = frame[height * 15 // 16]
    digits = [int(row[int((i + 0.5) * width / BLOCKS)].mean() > 127) for i in range(BLOCKS)]
    return int("".join(map(str, digits)), 2)


def _stimulus(
    folder: Path, scenario: str, phase: str, place: int, number: int, size: int
) -> Stimulus:
    practice, contact = phase == "familiarization", place % 2 == 0
    observed, whole, picture = _media(number, contact, size)
    # File names that reveal neither label nor phase.
    name = f"media/{number * 7919 % 10007:05d}"
    (folder / f"{name}.mp4").write_bytes(observed)
    (folder / f"{name}.png").write_bytes(picture)
    if practice:
        (folder / f"{name}-w.mp4").write_bytes(whole)
    return Stimulus(
        stimulus=f"{scenario}_tiny_{phase[:3]}_{place:04d}",
        scenario=scenario,
        phase=phase,
        place=place,
        label=contact,
        movie=f"{name}.mp4",
        map=f"{name}.png",
        full=f"{name}-w.mp4" if practice else "",
        frames=OBSERVED,
        full_frames=FULL if practice else 0,
        rate=float(RATE),
        width=size,
        height=size,
        look="free",
    )


@cache
def _media(number: int, contact: bool, size: int) -> tuple[bytes, bytes, bytes]:
    """Return observed movie, full movie and map of one stimulus."""
    frames = draw(number, contact, size)
    return encode_movie(frames[:OBSERVED]), encode_movie(frames), draw_map(number, size)


def draw(number: int, contact: bool, size: int) -> NDArray[np.uint8]:
    """Draw the frames (60, size, size, 3) of one stimulus."""
    frames = np.full((FULL, size, size, 3), 128, np.uint8)
    disk, square = _shapes(number, size)
    for frame in range(FULL):
        late = max(0, frame - OBSERVED) / (FULL - OBSERVED)
        frames[frame, square] = (40, 150, 60)
        x, y = 0.2 + 0.2 * frame / FULL + 0.4 * late, 0.5 if contact else 0.5 - 0.4 * late
        frames[frame, disk(x, y)] = (50, 70, 200)
        for block in range(BLOCKS):
            left, right = (int(edge * size / BLOCKS) for edge in (block, block + 1))
            white = frame >> (BLOCKS - 1 - block) & 1
            frames[frame, size * 7 // 8 :, left:right] = 255 if white else 0
    return frames


def _shapes(number: int, size: int) -> tuple[Any, NDArray[np.bool_]]:
    rows, columns = np.mgrid[0:size, 0:size] / size
    # Both grow a little with the number, so that all stimuli differ.
    radius = 0.06 + 0.0007 * (number % 60)
    square = (abs(columns - 0.8) < radius + 0.04) & (abs(rows - 0.5) < 0.08)
    square &= (rows - 0.4) * size >= number // 60 % 8

    def disk(x: float, y: float) -> NDArray[np.bool_]:
        return np.asarray((columns - x) ** 2 + (rows - y) ** 2 < radius**2)

    return disk, square


def draw_map(number: int, size: int) -> bytes:
    """Return a PNG with the agent in red and the patient in yellow on a transparent background."""
    disk, square = _shapes(number, size)
    picture = np.zeros((size, size, 4), np.uint8)
    picture[square] = (255, 255, 0, 255)
    picture[disk(0.2, 0.5)] = (255, 0, 0, 255)
    buffer = io.BytesIO()
    Image.fromarray(picture, "RGBA").save(buffer, "PNG")
    return buffer.getvalue()
