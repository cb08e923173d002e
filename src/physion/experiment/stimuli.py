"""The stimuli of a study: what is shown, in which phase and place, and how it ends.

They stand in ``stimuli.csv`` of the study folder, one row a stimulus. The file is never served.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Stimulus:
    """One row of ``stimuli.csv``.

    ``place`` is the fixed place in familiarization, from 0; in the test it only makes the file
    readable. ``label``: does the agent touch the patient? ``movie`` holds the observed frames
    alone, ``full`` the whole movie (familiarization alone, else empty), ``map`` agent and patient
    (PNG); all three are paths relative to the study folder. ``look`` is ``free`` or ``redyellow``.
    """

    stimulus: str
    scenario: str
    phase: str
    place: int
    label: bool
    movie: str
    map: str
    full: str
    frames: int
    full_frames: int
    rate: float
    width: int
    height: int
    look: str
