"""URL paths of the experimenter's pages under ``/experimenter``, and their request handlers."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import APIRouter, FastAPI
from starlette.requests import Request
from starlette.responses import Response

from physion.experiment.experimenter.access.access_control import drop_cookie, set_cookie
from physion.experiment.experimenter.export_pages import ExportPages
from physion.experiment.experimenter.manage_pages import ManagePages
from physion.experiment.experimenter.page_context import WRONG_FORM, PageContext, redirect
from physion.experiment.experimenter.payment_pages import PaymentPages
from physion.experiment.experimenter.session_list import KINDS, SessionFilter
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import Study
from physion.experiment.web.page_files import read_page_files

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

LOG = logging.getLogger(__name__)


def build_router(study: Study, secrets: Secrets, store: Store) -> APIRouter:
    """Return the router of the pages of a study, to be included under ``/experimenter``."""
    context = PageContext(study, secrets, store.engine.url.render_as_string(hide_password=False))
    exports = ExportPages(context)
    manage = ManagePages(context, store, exports)
    pages, payments = _Pages(context, manage), PaymentPages(context, store, exports)

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        await context.close()

    router = APIRouter(lifespan=lifespan, include_in_schema=False)
    for method, path, page in (
        ("GET", "", pages.overview),
        ("GET", "/", pages.overview),
        ("GET", "/login", pages.login_page),
        ("POST", "/login", pages.login),
        ("POST", "/logout", pages.logout),
        ("GET", "/sessions", pages.sessions),
        ("GET", "/sessions/{session}", pages.session),
        ("POST", "/sessions/{session}/void", manage.set_voided),
        ("POST", "/sessions/{session}/forget", manage.forget),
        ("POST", "/recruitment", manage.set_recruitment),
        ("GET", "/payments", payments.show),
        ("POST", "/payments", payments.confirm),
        ("GET", "/payments.csv", payments.download),
        ("POST", "/payments/forget", payments.forget),
        ("GET", "/export", exports.show),
        ("POST", "/export", exports.make),
        ("GET", "/static/{name}", pages.static),
    ):
        router.add_api_route(path, page, methods=[method], response_model=None)
    return router


class _Pages:
    """Request handlers of login, overview, sessions and static files."""

    def __init__(self, context: PageContext, manage: ManagePages) -> None:
        self._context, self._manage = context, manage
        self._files = read_page_files(Path(__file__).parent / "static")

    async def login_page(self, request: Request) -> Response:
        """Show the login form."""
        if self._context.access.login(request) is not None:
            return redirect("")
        return self._login_form(request)

    async def login(self, request: Request) -> Response:
        """Check the password and log in."""
        fields = await self._context.access.form(request)
        if fields is None:
            return self._login_form(request, WRONG_FORM, 403)
        wait = await self._context.access.try_password(request, fields.get("password", ""))
        if wait is None:
            LOG.info("an experimenter logged in")
            self._context.access.logins.close(self._context.access.token(request))
            response = redirect("")
            set_cookie(
                request, response, self._context.access.logins.open(self._context.access.clock())
            )
            return response
        LOG.warning("a login of an experimenter was refused")
        return self._context.refuse_password(request, wait, self._login_form)

    async def logout(self, request: Request) -> Response:
        """Log out."""
        if await self._context.access.form(request) is None:
            return self._context.render_problem(request, WRONG_FORM, 403)
        self._context.access.logins.close(self._context.access.token(request))
        response = redirect("/login")
        drop_cookie(request, response)
        return response

    def _login_form(
        self, request: Request, problem: str = "", status: int = 200, wait: float = 0.0
    ) -> Response:
        """Show the login form, with a cookie to which it is bound."""
        visit = self._context.access.visit(request)
        response = self._context.render_with_token("login.html", visit, status, problem=problem)
        set_cookie(request, response, visit)
        if wait:
            response.headers["retry-after"] = str(math.ceil(wait))
        return response

    async def overview(self, request: Request) -> Response:
        """Show the overview."""
        by_person = request.query_params.get("auto") != "1"
        if self._context.access.login(request, by_person) is None:
            return redirect("/login")
        kind = request.query_params.get("kind", "")
        kind = kind if kind in KINDS else "person"
        result = await self._context.query_statistics(request, "overview", kind=kind)
        if isinstance(result, Response):
            return result
        overview, flags = result
        return await self._context.render_in_thread(
            request, "overview.html", here="overview", overview=overview, flags=flags,
            paused=await self._manage.is_paused(),
        )  # fmt: skip

    async def sessions(self, request: Request) -> Response:
        """Show the table of sessions."""
        if self._context.access.login(request) is None:
            return redirect("/login")
        choice = SessionFilter.from_query(request.query_params, self._context.study.offered)
        result = await self._context.query_statistics(request, "sessions", choice=choice)
        if isinstance(result, Response):
            return result
        listed, flags = result
        return await self._context.render_in_thread(
            request, "sessions.html", here="sessions", listed=listed, choice=listed.choice,
            flags=flags,
        )  # fmt: skip

    async def session(self, request: Request) -> Response:
        """Show one session."""
        if self._context.access.login(request) is None:
            return redirect("/login")
        result = await self._context.query_statistics(
            request, "session", session=request.path_params["session"][:100]
        )
        if isinstance(result, Response):
            return result
        if result is None:
            return self._context.render_problem(request, "There is no such session.", 404)
        return await self._context.render_in_thread(
            request, "session.html", here="sessions", page=result
        )

    async def static(self, request: Request) -> Response:
        """Send a style sheet, script or icon."""
        file = self._files.get(request.path_params["name"])
        if file is None:
            return self._context.render_problem(request, "There is nothing at this address.", 404)
        return file.response(request)
