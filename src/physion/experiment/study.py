"""A study: a folder with everything that a lab decides about its experiment, readable and editable.

::

    STUDY/
      study.toml            what is decided: this module
      texts/en.toml, ...    words of every page, one file a language
      stimuli.csv           what is shown and how it ends; never served
      media/                movies and maps, named by their content
      secret.json           keys and the experimenter's password hash (mode 600)
      responses.sqlite      the data, where no other database is given
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from physion.experiment.stimuli import Stimulus


@dataclass(frozen=True)
class Timing:
    """What is shown for how long. ``flash_hz`` counts whole cycles, one on and one off; the
    official study flashed at 1 Hz. Fixation is drawn for each trial between its two ends.
    """

    fixation_ms: tuple[int, int] = (500, 1500)
    fixation_in_familiarization: bool = True
    cue_ms: int = 2000
    flash_hz: float = 2.0


@dataclass(frozen=True)
class Screen:
    """Smallest window that the pages are made for, in CSS pixels."""

    min_width: int = 1024
    min_height: int = 600


@dataclass(frozen=True)
class Recruitment:
    """Where participants come from, and how they get their credit.

    ``prolific_code``: completion code, also put into the address of Prolific's completion page.
    ``sona_address``: address of the SONA system with ``experiment_id`` and ``credit_token``; the
    survey code is added. ``mturk_code``: "session" gives every session its own code, any other word
    is the code of all. ``link_code``, ``link_address``: for people who came by a plain link.
    ``id_needed``: refuse who comes without an id.
    """

    id_needed: bool = False
    prolific_code: str = ""
    sona_address: str = ""
    mturk_code: str = "session"
    link_code: str = ""
    link_address: str = ""


@dataclass(frozen=True)
class Limits:
    """Requests that are let through: by session a second, by address new sessions a minute."""

    requests_per_second: float = 20.0
    burst: int = 100
    sessions_per_minute: float = 60.0


@dataclass(frozen=True)
class Study:
    """``study.toml`` with the stimuli and texts that belong to it.

    ``participants``: complete sessions wanted for each scenario; who comes later is told that the
    study is full. ``orders``: 0 gives each participant an order of their own; else so many prepared
    orders, least used first (the official study had 125). ``exclusions``: the rules by which
    sessions are flagged, a name of `physion.analysis.exclusions.RULE_SETS`. ``percentile_from``:
    finished people that it takes before anyone is told a percentile. ``embed_from``: sites that may
    show the pages in a frame (MTurk), none by default.
    """

    folder: Path
    name: str
    version: str
    title: str
    contact: str
    scenarios: tuple[str, ...]
    languages: tuple[str, ...] = ("en", "de")
    consent_version: str = "1"
    participants: int = 100
    seed: int = 0
    orders: int = 0
    exclusions: str = "preregistered"
    percentile_from: int = 10
    preload: int = 8
    embed_from: tuple[str, ...] = ()
    timing: Timing = Timing()
    screen: Screen = Screen()
    recruitment: Recruitment = Recruitment()
    limits: Limits = Limits()
    stimuli: tuple[Stimulus, ...] = ()
    texts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    digest: str = ""
    """SHA-256 of study.toml, texts and stimuli.csv."""
    stimuli_digest: str = ""

    def phase(self, scenario: str, phase: str) -> tuple[Stimulus, ...]:
        """The stimuli of one phase of a scenario, by place."""
        found = [s for s in self.stimuli if (s.scenario, s.phase) == (scenario, phase)]
        return tuple(sorted(found, key=lambda stimulus: stimulus.place))
