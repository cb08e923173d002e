"""Memory of the movies and maps that the server has sent, for the trials not yet answered.

It is not stored: after a restart nothing is known about the sessions that began before.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict

from physion.experiment.study.media_links import MediaKind

MAX_SESSIONS = 20_000
"""Sessions remembered; the least recently used are dropped first."""
_Trial = tuple[str, int]


class FetchedMedia:
    """When the media of each trial were first sent, by the tag of the session in their URLs."""

    def __init__(self, most: int = MAX_SESSIONS) -> None:
        self._most = most
        self._since = time.time()
        self._complete = True
        self._sent: OrderedDict[str, dict[_Trial, dict[MediaKind, float]]] = OrderedDict()
        self._lock = threading.Lock()

    def note(self, tag: str, phase: str, trial: int, kind: MediaKind, now: float) -> None:
        """Record that a file was sent at the time ``now`` in seconds since 1970."""
        with self._lock:
            trials = self._sent.setdefault(tag, {})
            trials.setdefault((phase, trial), {}).setdefault(kind, now)
            self._sent.move_to_end(tag)
            if len(self._sent) > self._most:
                self._sent.popitem(last=False)
                self._complete = False

    def sent_at(self, tag: str, started_at: float, phase: str, trial: int) -> float | None:
        """Return the time at which movie and map of a trial had both been asked for.

        Parameters
        ----------
        tag
            `media_links.session_tag` of the session.
        started_at
            When the session began.
        phase, trial
            The trial.

        Returns
        -------
        The time in seconds since 1970; infinity if one of them was never asked for; None if it is
        not known, because the session began before this server or was dropped from memory.
        """
        with self._lock:
            trials = self._sent.get(tag)
            if started_at < self._since or (trials is None and not self._complete):
                return None
            sent = (trials or {}).get((phase, trial), {})
            return max(sent.get("movie", float("inf")), sent.get("map", float("inf")))

    def forget(self, tag: str, phase: str, trial: int) -> None:
        """Forget the media of a trial, which was answered."""
        with self._lock:
            trials = self._sent.get(tag)
            if trials is not None:
                trials.pop((phase, trial), None)
