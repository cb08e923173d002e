"""Addresses of movies and maps: signed, and with nothing in them that tells a stimulus or an end.

``/media/<phase>-<trial>-<kind>-<hidden seed>-<signature>``: first letter of the phase, number of
the trial in its phase, ``movie``, ``map`` or ``full``; then the seed of the session's order, which
with a public list of stimuli would tell every stimulus, encrypted under a word that the signature
itself gives (synthetic IV: P. Rogaway and T. Shrimpton, EUROCRYPT 2006). Signed are also the name
of the scenario and the digest of the stimuli, so that no address ever comes to mean another movie.
Without the key nobody makes or reads an address: the full movie is to be had only by the address
that comes with the feedback. An address needs no database to be read.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from physion.errors import BadInputError
from physion.experiment.study.identity import Secrets, check_signature, sign
from physion.experiment.study.orders import order_of
from physion.experiment.study.stimuli import PHASES
from physion.experiment.study.study import Study

MediaKind = Literal["movie", "map", "full"]
PREFIX = "/media/"
_PATH = re.compile(
    r"/media/(([ft])-(0|[1-9][0-9]{0,5})-(movie|map|full))-([0-9a-f]{16})-([0-9a-f]{32})"
)
_PHASES = {phase[0]: phase for phase in PHASES}


def sign_media(
    study: Study,
    secrets: Secrets,
    scenario: str,
    order_seed: int,
    phase: str,
    trial: int,
    kind: MediaKind,
) -> str:
    """The address of one file of one trial; only familiarization has a ``full`` movie."""
    if kind == "full" and phase != PHASES[0]:
        raise ValueError("there is no address for the full movie of a test trial")
    place = f"{phase[0]}-{trial}-{kind}"
    signature = sign(secrets, *_signed(study, scenario, order_seed, place))
    return f"{PREFIX}{place}-{order_seed ^ _pad(secrets, signature):016x}-{signature}"


def read_media_path(study: Study, secrets: Secrets, path: str) -> Path:
    """The file that an address stands for; `BadInputError` for any that we did not sign."""
    match = _PATH.fullmatch(path)
    if match is None:
        raise BadInputError("no such movie or picture")
    place, letter, trial, kind, hidden, signature = match.groups()
    order_seed = int(hidden, 16) ^ _pad(secrets, signature)
    for scenario in study.scenarios:
        if check_signature(secrets, signature, *_signed(study, scenario, order_seed, place)):
            break
    else:
        raise BadInputError("no such movie or picture")
    stimuli = order_of(study, scenario, order_seed)[_PHASES[letter]]
    name: str = getattr(stimuli[int(trial)], kind) if int(trial) < len(stimuli) else ""
    if not name:
        raise BadInputError("no such movie or picture")
    return study.folder / name


def _signed(study: Study, scenario: str, order_seed: int, place: str) -> tuple[str, ...]:
    return "media", study.stimuli_digest, scenario, str(order_seed), place


def _pad(secrets: Secrets, signature: str) -> int:
    """64 bits that hide the seed of one address: no two seeds ever share a signature."""
    return int(sign(secrets, "hidden seed", signature)[:16], 16)
