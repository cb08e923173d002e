"""A whole session in WebKit on a real server."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from support.experiment.browser import rows_of, served
from support.experiment.webkit import WebKit, wait_for, webkit

__all__ = ["webkit"]
pytestmark = pytest.mark.slow

CONTINUE = "main .button:not(.quiet):enabled"


def answer(webkit: WebKit, response: str, by: str = "mouse") -> None:
    """Answer the trial as soon as the buttons are enabled."""
    button = f".answer[data-response={response}]:enabled"
    webkit.find(button)
    if by == "keyboard":
        left = webkit.run("return document.querySelector('.answer').dataset.response")
        webkit.press("f" if left == response else "j")
    else:
        webkit.click(button)
    webkit.gone(".answer:enabled")


def test_a_whole_session_in_webkit(webkit: WebKit, tmp_path: Path) -> None:
    with served(tmp_path) as (study, server):
        webkit.go(f"{server.url}/?participant=Kit&language=en")
        for title in ("Taking part", "What you will do", "What you will see", "How you answer"):
            webkit.find("h1", title)
            webkit.click(CONTINUE)
        told = []
        for _ in range(2):
            answer(webkit, "yes")
            webkit.find(CONTINUE)
            told.append(webkit.text(".verdict"))
            webkit.click(CONTINUE)
        # Labels of the tiny study alternate, the first with contact.
        assert told == ["Correct!", "Not correct."]
        webkit.find("h1", "You are ready")
        webkit.click(CONTINUE)
        for trial, (response, by) in enumerate(
            (("yes", "mouse"), ("no", "keyboard"), ("yes", "mouse"))
        ):
            webkit.find("#progress", f"Trial {trial + 1} of 3")
            answer(webkit, response, by)
        webkit.find("h1", "About you")
        webkit.type("#age", "33")
        for field, value in (("gender", "female"), ("education", "master")):
            webkit.click(f"#{field} option[value={value}]")
        webkit.click(CONTINUE)
        webkit.click("label[for=difficulty-4]")
        webkit.click("label[for=technical-no]")
        webkit.type("#text", "<img src=x onerror=alert(1)> 'ok'")
        webkit.click(CONTINUE)
        assert webkit.text("#code") == "TINY-CODE"
        webkit.go("about:blank")  # a page that is left sends its events
        wait_for(lambda: rows_of(study, "Kit")[2], "events")
    session, answers, events = rows_of(study, "Kit")
    assert session.finished_at is not None
    agent = session.device["user_agent"]
    assert "AppleWebKit/" in agent and "Chrome/" not in agent
    assert (session.age, session.gender, session.education) == (33, "female", "master")
    assert (session.difficulty, session.technical_problems) == (4, False)
    assert session.feedback == "<img src=x onerror=alert(1)> 'ok'"
    assert [row.response for row in answers] == ["yes", "yes", "yes", "no", "yes"]
    assert [row.input for row in answers] == ["mouse", "mouse", "mouse", "keyboard", "mouse"]
    for row in answers:
        assert row.cue_ms > 400 and row.rt_ms > 0 and row.showings == 1
        # WebKit tells which frames it presented; a busy machine drops some.
        assert 0 < row.frames_shown <= row.frames_expected == 45
        frames = [frame for _, frame, _ in json.loads(row.details)["frames"]]
        assert frames[0] == 0 and max(frames) < row.frames_expected
    # No error, no movie that failed, no trial that was interrupted.
    assert [event.kind for event in events] == ["hidden"]
