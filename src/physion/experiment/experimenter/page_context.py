"""Services shared by all of the experimenter's pages: access control, statistics, rendering."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from sqlalchemy import Connection
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from physion.core.errors import PhysionError
from physion.experiment.experimenter.access.access_control import HEADERS, AccessControl
from physion.experiment.experimenter.access.login import PATH, Login
from physion.experiment.experimenter.session_list import KINDS
from physion.experiment.experimenter.statistics.process import StatisticsProcess
from physion.experiment.experimenter.statistics.summaries import STATES
from physion.experiment.experimenter.templating import make_environment
from physion.experiment.store.lab import Action, note_action
from physion.experiment.store.sessions import ACTIVE_WITHIN
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import Study

REFRESH_SECONDS = 30
"""Interval of the automatic refresh of the overview."""
FORGET_WORD = "delete"
"""Word that must be typed to confirm the deletion of raw ids."""
WRONG_PASSWORD = "This is not the password."
WRONG_LOGIN = "There is no such name with this password."
WRONG_FORM = "This form was no longer valid. Please try again."


class PageContext:
    """Shared state of the experimenter's pages of one served study.

    ``url``: SQLAlchemy URL of its database, with password.
    """

    def __init__(self, study: Study, secrets: Secrets, url: str) -> None:
        self.study, self.secrets, self.url = study, secrets, url
        self.access = AccessControl(self._read_secrets)
        self.statistics = StatisticsProcess(study, url)
        self._templates = make_environment(
            study=study, kinds=KINDS, states=STATES, active_minutes=round(ACTIVE_WITHIN / 60),
            refresh_seconds=REFRESH_SECONDS, forget_word=FORGET_WORD,
        )  # fmt: skip

    async def close(self) -> None:
        """Stop the threads and the statistics process."""
        self.access.close()
        await run_in_threadpool(self.statistics.close)

    def _read_secrets(self) -> Secrets:
        """Read the file again at each check, so that a new password takes effect at once."""
        try:
            return Secrets.load(self.study.folder)
        except PhysionError:
            return self.secrets

    async def read_submission(
        self, request: Request, form: Callable[..., Response]
    ) -> tuple[Login, dict[str, str]] | Response:
        """Return the login and the fields of a submitted form.

        If the form token is invalid, return the response of ``form``, which shows the form again.
        """
        fields = await self.access.form(request)
        return form(request, WRONG_FORM, 403) if fields is None else (login_of(request), fields)

    async def query_statistics(self, request: Request, name: str, **arguments: Any) -> Any:
        """Return a result of the statistics process, or an error page."""
        try:
            return await self.statistics.query(name, **arguments)
        except PhysionError as error:
            return self.render_problem(request, str(error), 503)

    def render_problem(self, request: Request, problem: str, status: int) -> Response:
        """Return an error page, or a redirect to the login if the browser is not logged in."""
        login = self.access.login(request)
        if login is None:
            return redirect("/login")
        request.state.login = login
        return self.render(request, "problem.html", status, here="", problem=problem)

    def render(self, request: Request, template: str, status: int = 200, **values: Any) -> Response:
        """Render a page whose forms are bound to the browser's cookie."""
        return self.render_with_token(
            template,
            self.access.token(request),
            status,
            account=login_of(request).account,
            **values,
        )

    async def render_in_thread(self, *given: Any, **values: Any) -> Response:
        """Render a page in a thread; for pages that take milliseconds."""
        return await run_in_threadpool(self.render, *given, **values)

    def render_with_token(self, template: str, token: str, status: int, **values: Any) -> Response:
        """Render a page whose forms are bound to this cookie token."""
        now = time.time()
        text = self._templates.get_template(template).render(
            form_token=self.access.logins.form_token(token), now=now, **values
        )
        return Response(text, status, HEADERS, "text/html; charset=utf-8")

    def refuse_password(
        self,
        request: Request,
        wait: float,
        form: Callable[..., Response],
        wrong: str = WRONG_PASSWORD,
    ) -> Response:
        """Show ``form`` again with the message for a result of `AccessControl.try_password`.

        ``wrong``: the message for a wrong password.
        """
        if wait == 0:
            return form(request, wrong, 403)
        seconds = math.ceil(wait)
        unit = "second" if seconds == 1 else "seconds"
        problem = f"Too many attempts. Please wait {seconds} {unit} and try again."
        return form(request, problem, 429, wait)


def login_of(request: Request) -> Login:
    """Return the login that was found for a request of a page that needs one."""
    login: Login = request.state.login
    return login


def note(connection: Connection, request: Request, action: Action, subject: str = "") -> None:
    """Add what the account of a request did to the log, in the writer's transaction."""
    account = login_of(request).account
    note_action(connection, action, subject, account.name, account.role)


def redirect(path: str) -> Response:
    """Return a redirect to another of the experimenter's pages."""
    return RedirectResponse(f"{PATH}{path}", 303, headers=HEADERS)
