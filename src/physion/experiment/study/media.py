"""Signed media URLs that reveal neither the stimulus nor its outcome.

A URL path is ``/media/<phase>-<trial>-<kind>-<encrypted seed>-<tag>-<signature>``: the first letter
of the phase, the index of the trial in its phase, ``movie``, ``map`` or ``full``, and the
`session_tag` by which the server knows who fetched the file. The seed of the
session's trial order is encrypted, since with a public list of stimuli it would reveal every
stimulus. The encryption pad is derived from the signature (synthetic IV: P. Rogaway and
T. Shrimpton, EUROCRYPT 2006). The signature also covers tag, scenario and digest of the stimuli,
so a URL can never refer to another movie. Without the key nobody can make or decode a URL; the full
movie is available only by the URL that is sent with the feedback. Decoding needs no database.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import av
from PIL import Image

from physion.core.errors import BadInputError
from physion.core.files import check_plain
from physion.experiment.study.identity import Secrets, check_signature, sign
from physion.experiment.study.orders import trial_order
from physion.experiment.study.stimuli import PHASES, Stimulus
from physion.experiment.study.study import Study, StudyKey, variants

MediaKind = Literal["movie", "map", "full"]
PREFIX = "/media/"
_PATH = re.compile(
    r"/media/(([ft])-(0|[1-9][0-9]{0,5})-(movie|map|full))-([0-9a-f]{16})-([0-9a-f]{16})-([0-9a-f]{32})"
)
NO_TAG = "0" * 16
"""Tag of media that belong to no session, such as the example."""
_PHASES = {phase[0]: phase for phase in PHASES}


@dataclass(frozen=True)
class SignedMedia:
    """What a valid path stands for: the file, and the trial of the session with this tag."""

    file: Path
    tag: str
    phase: str
    trial: int
    kind: MediaKind


def session_tag(secrets: Secrets, session: str) -> str:
    """Return the tag (16 hexadecimal digits) of a session in its media URLs."""
    return sign(secrets, "media of", session)[:16]


def sign_media(
    study: Study,
    secrets: Secrets,
    scenario: str,
    order_seed: int,
    phase: str,
    trial: int,
    kind: MediaKind,
    tag: str = NO_TAG,
) -> str:
    """Return the signed path of one file of one trial.

    Parameters
    ----------
    study, secrets
        The study, under the condition of the session, and its keys.
    scenario, order_seed
        Scenario and trial order of the session.
    phase, trial
        Phase, and index of the trial in it.
    kind
        The observed movie, the map, or the full movie (familiarization only).
    tag
        The `session_tag` of the session.
    """
    if kind == "full" and phase != PHASES[0]:
        raise ValueError("there is no URL for the full movie of a test trial")
    item = f"{phase[0]}-{trial}-{kind}"
    signature = sign(secrets, *_signed_parts(study, scenario, order_seed, item, tag))
    return f"{PREFIX}{item}-{order_seed ^ _pad(secrets, signature):016x}-{tag}-{signature}"


def read_media_path(study: Study, secrets: Secrets, path: str) -> Path:
    """Return the file of a signed path; raise `BadInputError` if the path is not validly signed."""
    return read_media(study, secrets, path).file


def read_media(study: Study, secrets: Secrets, path: str) -> SignedMedia:
    """Return what a signed path stands for; raise `BadInputError` if it is not validly signed."""
    match = _PATH.fullmatch(path)
    if match is None:
        raise BadInputError("no such movie or picture")
    item, letter, trial, kind, encrypted, tag, signature = match.groups()
    order_seed = int(encrypted, 16) ^ _pad(secrets, signature)
    for variant, scenario in _courses(study):
        parts = _signed_parts(variant, scenario, order_seed, item, tag)
        if check_signature(secrets, signature, *parts):
            break
    else:
        raise BadInputError("no such movie or picture")
    stimuli = trial_order(variant, scenario, order_seed)[_PHASES[letter]]
    name: str = getattr(stimuli[int(trial)], kind) if int(trial) < len(stimuli) else ""
    if not name:
        raise BadInputError("no such movie or picture")
    file = study.folder / name
    return SignedMedia(file, tag, _PHASES[letter], int(trial), cast("MediaKind", kind))


def _courses(study: Study) -> Iterator[tuple[Study, str]]:
    """Yield the conditions of a study, and the study itself, with the scenarios of sessions."""
    for variant in dict.fromkeys(map(StudyKey, (*variants(study), study))):
        for scenario in variant.study.scenarios:
            yield variant.study, scenario


def _signed_parts(
    study: Study, scenario: str, order_seed: int, item: str, tag: str
) -> tuple[str, ...]:
    """Return the texts that the signature of a URL covers."""
    own = (study.condition,) if study.condition else ()
    return "media", study.stimuli_digest, scenario, str(order_seed), item, tag, *own


def _pad(secrets: Secrets, signature: str) -> int:
    """Return the 64-bit pad that encrypts the seed; different seeds have different signatures."""
    return int(sign(secrets, "hidden seed", signature)[:16], 16)


# Comparison of a study's media files with its stimuli.csv, done before the study is served.
#
# A lab may edit stimuli.csv or replace movies. A movie with one frame too many would show
# participants what they are asked to predict.


def check_media(study: Study) -> None:
    """Check that all movies and maps of a study are as stimuli.csv describes them.

    Movies must be H.264, which every browser plays, without sound. Frames are counted from the
    packets of the file, without decoding.

    Raises
    ------
    BadInputError
        Frames, size, rate or codec of a movie, or the size of a map, differ. The message names
        the first such file.
    """
    seen: set[tuple[str, int]] = set()
    for s in study.stimuli:
        for name, frames in ((s.movie, s.frames), (s.full, s.full_frames)):
            if name and (name, frames) not in seen:
                seen.add((name, frames))
                _check_movie(study.folder / name, frames, s)
        if (s.map, 0) not in seen:
            seen.add((s.map, 0))
            _check_map(study.folder / s.map, s)


def _check_movie(path: Path, frames: int, s: Stimulus) -> None:
    """Check the streams, frames, size, rate and codec of a movie."""
    check_plain(path)
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            if len(container.streams) != 1 or not container.streams.video:
                raise BadInputError(f"movie {path} must have one video stream and no other stream")
            stream = container.streams.video[0]
            context = stream.codec_context
            size = (context.width, context.height)
            rate, codec = float(stream.average_rate or 0), context.name
            counted = sum(1 for packet in container.demux(stream) if packet.size)
    except (av.FFmpegError, ValueError, AttributeError) as error:
        raise BadInputError(f"movie {path} cannot be read: {error}") from error
    if counted != frames:
        raise BadInputError(
            f"movie {path} has {counted} frames; stimuli.csv says {frames} of {s.stimulus}"
        )
    if size != (s.width, s.height) or abs(rate - s.rate) > 0.01:
        raise BadInputError(
            f"movie {path} is {size[0]} x {size[1]} at {rate:g} frames/s; stimuli.csv says "
            f"{s.width} x {s.height} at {s.rate:g} of {s.stimulus}"
        )
    if codec != "h264":
        raise BadInputError(f"movie {path} is {codec}, not H.264, which every browser plays")


def _check_map(path: Path, s: Stimulus) -> None:
    """Check that a map is a PNG of the movie's size."""
    check_plain(path)
    try:
        with Image.open(path, formats=["PNG"]) as picture:
            size = picture.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise BadInputError(f"map {path} is not a readable PNG image: {error}") from error
    if size != (s.width, s.height):
        raise BadInputError(
            f"map {path} is {size[0]} x {size[1]} pixels; stimuli.csv says "
            f"{s.width} x {s.height} of {s.stimulus}"
        )
