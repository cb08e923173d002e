"""What all pages of the experimenter share: the gate, the desk, and how a page is drawn."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from physion.errors import PhysionError
from physion.experiment.experimenter.access.gate import HEADERS, Gate
from physion.experiment.experimenter.access.login import PATH, Login
from physion.experiment.experimenter.pages import make_environment
from physion.experiment.experimenter.session_list import KINDS
from physion.experiment.experimenter.statistics.process import Desk
from physion.experiment.experimenter.statistics.summaries import STATES
from physion.experiment.store.sessions import ACTIVE_WITHIN
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import Study

REFRESH_SECONDS = 30
"""How often the overview refreshes by itself."""
FORGET_WORD = "delete"
"""What has to be written before the raw ids are deleted."""
WRONG_PASSWORD = "This is not the password."
WRONG_FORM = "This form was no longer valid. Please try again."


class Front:
    """One for a served study. ``url``: of its database."""

    def __init__(self, study: Study, secrets: Secrets, url: str) -> None:
        self.study, self.secrets, self.url = study, secrets, url
        self.gate = Gate(self._read_secrets)
        self.desk = Desk(study, url)
        self._templates = make_environment(
            study=study, kinds=KINDS, states=STATES, active_minutes=round(ACTIVE_WITHIN / 60),
            refresh_seconds=REFRESH_SECONDS, forget_word=FORGET_WORD,
        )  # fmt: skip

    async def close(self) -> None:
        """Ends the threads, and the process that counts."""
        self.gate.close()
        await run_in_threadpool(self.desk.close)

    def _read_secrets(self) -> Secrets:
        """The file as it is now: a new password counts at once, and ends all logins."""
        try:
            return Secrets.load(self.study.folder)
        except PhysionError:
            return self.secrets

    async def sent(
        self, request: Request, form: Callable[..., Response]
    ) -> tuple[Login, dict[str, str]] | Response:
        """Who sent a form, and its fields; the way to the login, or the form again, where it came
        from nobody or from no page of ours.
        """
        login = self.gate.login(request)
        if login is None:
            return go("/login")
        fields = await self.gate.form(request)
        return form(request, WRONG_FORM, 403) if fields is None else (login, fields)

    async def ask(self, request: Request, question: str, **arguments: Any) -> Any:
        """The clerk's answer, or a page that says why there is none."""
        try:
            return await self.desk.ask(question, **arguments)
        except PhysionError as error:
            return self.problem(request, str(error), 503)

    def problem(self, request: Request, problem: str, status: int) -> Response:
        """A page that says what is wrong, to who is logged in."""
        if self.gate.login(request) is None:
            return go("/login")
        return self.show(request, "problem.html", status, here="", problem=problem)

    def show(self, request: Request, template: str, status: int = 200, **values: Any) -> Response:
        """A page whose forms are bound to the word that the browser has already."""
        return self.page(template, self.gate.token(request), status, **values)

    async def draw(self, *given: Any, **values: Any) -> Response:
        """As `show`, of a page that takes milliseconds: in a thread."""
        return await run_in_threadpool(self.show, *given, **values)

    def page(self, template: str, token: str, status: int, **values: Any) -> Response:
        """A page whose forms are bound to this word of a browser."""
        now = time.time()
        text = self._templates.get_template(template).render(
            form_token=self.gate.logins.form_token(token), now=now, **values
        )
        return Response(text, status, HEADERS, "text/html; charset=utf-8")

    def refuse_password(
        self, request: Request, wait: float, form: Callable[..., Response]
    ) -> Response:
        """The form again after `Gate.try_password`, and why."""
        if wait == 0:
            return form(request, WRONG_PASSWORD, 403)
        seconds = math.ceil(wait)
        unit = "second" if seconds == 1 else "seconds"
        problem = f"Too many tries. Please wait {seconds} {unit} and try again."
        return form(request, problem, 429, wait)


def go(place: str) -> Response:
    """To another page of the experimenter."""
    return RedirectResponse(f"{PATH}{place}", 303, headers=HEADERS)
