"""The tables of ``study.toml``, one dataclass each with the defaults of its keys."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Timing:
    """Durations within a trial.

    Attributes
    ----------
    fixation_ms
        Shortest and longest duration of the fixation cross; drawn uniformly for each trial.
    fixation_in_familiarization
        Whether familiarization trials have a fixation cross too.
    cue_ms
        Duration of the cue on the first frame.
    flash_hz
        Full cycles (on and off) of the cue per second; 1 in the official study.
    break_every
        Number of test trials after which people can rest for as long as they like; 0: no breaks.
    """

    fixation_ms: tuple[int, int] = (500, 1500)
    fixation_in_familiarization: bool = True
    cue_ms: int = 2000
    flash_hz: float = 2.0
    break_every: int = 25


@dataclass(frozen=True)
class Blocks:
    """Several scenarios in one session, one block each.

    Attributes
    ----------
    all_scenarios
        Whether a session runs through all scenarios of the study, in an order of its own.
    familiarization
        ``each``: every block begins with the familiarization trials of its scenario; ``first``: the
        first block alone does.
    trials
        Number of test trials of a block, drawn anew for each session with as many of either outcome
        as possible; 0: all test trials of the scenario.
    """

    all_scenarios: bool = False
    familiarization: str = "each"
    trials: int = 0


@dataclass(frozen=True)
class Comprehension:
    """The comprehension check after the instructions.

    ``attempts``: how often its questions can be answered before the session ends.
    """

    attempts: int = 3


@dataclass(frozen=True)
class Practice:
    """The criterion of the familiarization of a session, or of each block.

    Attributes
    ----------
    min_correct
        Number of right answers that are needed; 0: no criterion.
    repeats
        How often the practice is repeated with fewer.
    failed
        What happens then: ``end`` ends the session, ``flag`` goes on and flags it.
    """

    min_correct: int = 0
    repeats: int = 1
    failed: str = "end"


@dataclass(frozen=True)
class Attention:
    """Attention checks among the test trials, besides the stimuli of the phase ``attention``.

    Attributes
    ----------
    instructed
        Number of checks (in each block) after whose movie the page says which button to press.
    max_failed
        Number of failed checks of either kind up to which a session is not flagged.
    """

    instructed: int = 0
    max_failed: int = 0


@dataclass(frozen=True)
class Screen:
    """Smallest browser window in which participants may take part, in CSS pixels.

    ``fullscreen``: whether full screen is offered before the trials, and again after it was left.
    """

    min_width: int = 1024
    min_height: int = 600
    fullscreen: bool = False


@dataclass(frozen=True)
class Plausibility:
    """What a session must keep to, to be one of a person, and what interrupts a trial.

    Attributes
    ----------
    server_checks
        Whether answers are checked against the server's clock and the media that it sent: they are
        refused before fixation cross, cue and movie can have been shown.
    fast_ms, fast_answers
        Response time under which an answer is too fast, and the number of such answers from which a
        session is implausible (a person may press by anticipation now and then).
    reading_s
        Shortest time in seconds for all pages together; less, with all movies, is implausible.
    max_showings
        How often a trial may be shown, over all loads of the page; sessions with more are flagged.
    interrupted
        What happens when, during cue or movie, the page is hidden, the window too small, or the
        question whether to stop open: ``repeat`` shows the trial again (five times at most),
        ``void`` goes on and marks the answer, which the analysis leaves out.
    simulated_speed
        How many times faster than people simulated participants may be.
    """

    server_checks: bool = True
    fast_ms: int = 100
    fast_answers: int = 3
    reading_s: float = 10.0
    max_showings: int = 2
    interrupted: str = "repeat"
    simulated_speed: float = 1.0


@dataclass(frozen=True)
class Recruitment:
    """Settings of recruitment and completion credit.

    Attributes
    ----------
    id_needed
        Whether participants without an id are refused.
    prolific_id, sona_id, mturk_id, link_id
        Regular expression that ids from this recruiter must match completely; empty: any id.
    allow_list
        Name of a text file in the study folder with all ids that may take part; empty: any.
    signed_links
        ``no``: anyone who has the address may enter; ``study``: only by a link that
        `recruitment.links` signed for a recruiter; ``person``: only by a link signed for the id.
    hold_minutes
        Time without an answer or page after which the place of an unfinished session is given to
        somebody else.
    prolific_code
        Prolific's completion code, also part of the completion URL.
    sona_address
        SONA's completion URL with ``experiment_id`` and ``credit_token``; the survey code is
        appended.
    mturk_code
        ``session``: each session gets its own code. Any other value is the code of all sessions.
    link_code, link_address
        Completion code and URL for participants who came by a plain link.
    """

    id_needed: bool = False
    prolific_id: str = "[0-9a-fA-F]{24}"
    sona_id: str = ""
    mturk_id: str = ""
    link_id: str = ""
    allow_list: str = ""
    signed_links: str = "no"
    hold_minutes: int = 15
    prolific_code: str = ""
    sona_address: str = ""
    mturk_code: str = "session"
    link_code: str = ""
    link_address: str = ""


@dataclass(frozen=True)
class EarlyEnd:
    """How participants who end without finishing report back to the recruiter.

    Attributes
    ----------
    prolific_code
        Prolific's code for this case, also part of the completion URL.
    code, address
        Code and URL for participants from elsewhere.
    """

    prolific_code: str = ""
    code: str = ""
    address: str = ""


@dataclass(frozen=True)
class Bonus:
    """Bonus of finished sessions: ``per_correct`` for each right test answer beyond a fraction.

    Attributes
    ----------
    per_correct
        Amount in the lab's currency for each counted answer; 0: no bonus.
    above
        Fraction of the test trials whose right answers do not count, such as 0.5 for guessing.
    most
        Largest bonus; 0: no limit.
    """

    per_correct: float = 0.0
    above: float = 0.5
    most: float = 0.0


@dataclass(frozen=True)
class Limits:
    """Rate limits (token buckets).

    Attributes
    ----------
    requests_per_second, burst
        Sustained rate and burst size of the requests of one session.
    sessions_per_minute, sessions_at_once
        Sustained rate and burst size of new sessions from one IP address, which a whole class may
        share.
    """

    requests_per_second: float = 20.0
    burst: int = 100
    sessions_per_minute: float = 60.0
    sessions_at_once: int = 200


ALL_SCENARIOS = "all scenarios"
"""In place of a scenario: a session of all scenarios. No scenario can have this name."""
EARLY_ENDS = ("declined", "stopped", "screened_out", "device_refused", "full")
"""The tables of ``study.toml`` that are an `EarlyEnd`."""
