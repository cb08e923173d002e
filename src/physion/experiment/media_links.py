"""Addresses of movies and maps: signed, and with nothing in them that tells a stimulus or an end.

``/media/<scenario>-<order seed>-<phase>-<trial>-<kind>-<signature>``: numbers of the scenario in
the study and of the trial in its phase, first letter of the phase, ``movie``, ``map`` or ``full``.
Without the key nobody makes an address, so that the full movie is to be had only by the address
that comes with the feedback. An address needs no database to be read.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from physion.errors import BadInputError
from physion.experiment.identity import Secrets, check_signature, sign
from physion.experiment.orders import order_of
from physion.experiment.stimuli import PHASES
from physion.experiment.study import Study

MediaKind = Literal["movie", "map", "full"]
PREFIX = "/media/"
_PATH = re.compile(
    r"/media/(([0-9]{1,4})-([0-9]{1,19})-([ft])-([0-9]{1,6})-(movie|map|full))-([0-9a-f]{32})"
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
    number = study.scenarios.index(scenario)
    words = f"{number}-{order_seed}-{phase[0]}-{trial}-{kind}"
    return f"{PREFIX}{words}-{sign(secrets, 'media', words)}"


def read_media_path(study: Study, secrets: Secrets, path: str) -> Path:
    """The file that an address stands for; `BadInputError` for any that we did not sign."""
    match = _PATH.fullmatch(path)
    if match is None or not check_signature(secrets, match[7], "media", match[1]):
        raise BadInputError("no such movie or picture")
    number, order_seed, phase, trial = (
        int(match[2]),
        int(match[3]),
        _PHASES[match[4]],
        int(match[5]),
    )
    # Signed before the stimuli of the study changed: there may be fewer now.
    if number >= len(study.scenarios):
        raise BadInputError("no such movie or picture")
    stimuli = order_of(study, study.scenarios[number], order_seed)[phase]
    if trial >= len(stimuli):
        raise BadInputError("no such movie or picture")
    name: str = getattr(stimuli[trial], match[6])
    if not name:
        raise BadInputError("no such movie or picture")
    return study.folder / name
