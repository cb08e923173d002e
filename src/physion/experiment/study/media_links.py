"""Signed media URLs that reveal neither the stimulus nor its outcome.

A URL path is ``/media/<phase>-<trial>-<kind>-<encrypted seed>-<signature>``: the first letter of
the phase, the index of the trial in its phase, and ``movie``, ``map`` or ``full``. The seed of the
session's trial order is encrypted, since with a public list of stimuli it would reveal every
stimulus. The encryption pad is derived from the signature (synthetic IV: P. Rogaway and
T. Shrimpton, EUROCRYPT 2006). The signature also covers the scenario and the digest of the stimuli,
so a URL can never refer to another movie. Without the key nobody can make or decode a URL; the full
movie is available only by the URL that is sent with the feedback. Decoding needs no database.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from physion.errors import BadInputError
from physion.experiment.study.identity import Secrets, check_signature, sign
from physion.experiment.study.orders import trial_order
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
    """Return the signed path of one file of one trial.

    Parameters
    ----------
    study, secrets
        The study and its keys.
    scenario, order_seed
        Scenario and trial order of the session.
    phase, trial
        Phase, and index of the trial in it.
    kind
        The observed movie, the map, or the full movie (familiarization only).
    """
    if kind == "full" and phase != PHASES[0]:
        raise ValueError("there is no URL for the full movie of a test trial")
    item = f"{phase[0]}-{trial}-{kind}"
    signature = sign(secrets, *_signed_parts(study, scenario, order_seed, item))
    return f"{PREFIX}{item}-{order_seed ^ _pad(secrets, signature):016x}-{signature}"


def read_media_path(study: Study, secrets: Secrets, path: str) -> Path:
    """Return the file of a signed path; raise `BadInputError` if the path is not validly signed."""
    match = _PATH.fullmatch(path)
    if match is None:
        raise BadInputError("no such movie or picture")
    item, letter, trial, kind, encrypted, signature = match.groups()
    order_seed = int(encrypted, 16) ^ _pad(secrets, signature)
    for scenario in study.scenarios:
        if check_signature(secrets, signature, *_signed_parts(study, scenario, order_seed, item)):
            break
    else:
        raise BadInputError("no such movie or picture")
    stimuli = trial_order(study, scenario, order_seed)[_PHASES[letter]]
    name: str = getattr(stimuli[int(trial)], kind) if int(trial) < len(stimuli) else ""
    if not name:
        raise BadInputError("no such movie or picture")
    return study.folder / name


def _signed_parts(study: Study, scenario: str, order_seed: int, item: str) -> tuple[str, ...]:
    """Return the texts that the signature of a URL covers."""
    return "media", study.stimuli_digest, scenario, str(order_seed), item


def _pad(secrets: Secrets, signature: str) -> int:
    """Return the 64-bit pad that encrypts the seed; different seeds have different signatures."""
    return int(sign(secrets, "hidden seed", signature)[:16], 16)
