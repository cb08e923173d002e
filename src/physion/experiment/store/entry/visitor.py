"""Identify the visitor who enters, by link and id, or by the key of the browser."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from secrets import token_hex

from physion.experiment.protocol.messages import Enter, Kind
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.sessions import storable
from physion.experiment.study.identity import (
    Secrets,
    new_reference,
    new_session,
    new_token,
    participant_hash,
)
from physion.experiment.study.recruitment import is_id_allowed, is_unfilled, read_pass
from physion.experiment.study.study import Study


@dataclass(frozen=True)
class Visitor:
    """An identified visitor, with all random names drawn, so that entering can be repeated."""

    enter: Enter
    kind: Kind
    participant: str
    raw_id: str | None
    now: float
    known_token: str = ""
    """Token of an earlier visit, with which the session can be continued."""
    signed: bool = False
    """Whether the link is signed for this person or for sessions of this kind."""
    browser: str = ""
    """Keyed hash of the key of the browser; empty if it sent none."""
    token: str = field(default_factory=new_token)
    session: str = field(default_factory=new_session)
    reference: str = field(default_factory=new_reference)


def identify_visitor(study: Study, secrets: Secrets, enter: Enter, token: str = "") -> Visitor:
    """Identify the visitor by link and id, else by the visit key, else as a new participant.

    ``token`` is one that the browser has from an earlier visit, or empty.

    Raises
    ------
    Refused
        The link has an invalid key, an unknown scenario or condition, or an unfilled placeholder
        for the id, or lacks a required signature or id; or the study does not allow the id.
    """
    key = read_pass(secrets, enter)
    kind: Kind = "preview" if key == "preview" else "simulated" if key == "simulated" else "person"
    required = {"no": (None, "study", "person"), "study": ("study", "person")}
    people = required.get(study.recruitment.signed_links, ("person",))
    if (key is None and enter.pass_ is not None) or (kind == "person" and key not in people):
        raise Refused("bad_link", "This link is not complete; copy all of it and try again.")
    if is_unfilled(enter):
        raise Refused(
            "bad_link",
            "The recruiter did not fill in your id: this link contains only its placeholder. "
            "Open the study from the recruiter's own page.",
        )
    raw_id = storable(enter.id or "").strip() or None
    needed = study.recruitment.id_needed or enter.source != "link"
    if raw_id is None and kind == "person" and needed:
        raise Refused("id_needed", "This link lacks your id; open the link that you were given.")
    if raw_id is not None and kind == "person" and not is_id_allowed(study, enter.source, raw_id):
        raise Refused("id_refused", "This study does not know the id of this link.")
    if enter.scenario is not None and enter.scenario not in study.offered:
        raise Refused("bad_link", "This link names a scenario that no session of the study is of.")
    if enter.condition is not None and (
        key is None or enter.condition not in [each.name for each in study.conditions]
    ):
        raise Refused("bad_link", "This link is not signed for its condition; copy all of it.")
    # A simulated or preview session must not block a person with the same id.
    source = enter.source if kind == "person" else f"{kind} {enter.source}"
    if raw_id is not None:
        participant = participant_hash(secrets, source, raw_id)
    else:
        # A visit key is as secret as a token: only its browser knows it.
        participant = participant_hash(secrets, f"{source} visit", enter.visit or token_hex(16))
    return Visitor(
        enter,
        kind,
        participant,
        raw_id if kind == "person" else None,
        time.time(),
        known_token=token,
        signed=key in ("preview", "simulated", "person"),
        browser=participant_hash(secrets, f"browser of {participant}", enter.visit)
        if enter.visit
        else "",
    )
