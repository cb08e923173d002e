"""URL paths of the experimenter's pages under ``/experimenter``, and their request handlers."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from fastapi import APIRouter, FastAPI
from starlette.requests import Request
from starlette.responses import Response

from physion.experiment.experimenter.access.access_control import drop_cookie, set_cookie
from physion.experiment.experimenter.export_pages import ExportPages
from physion.experiment.experimenter.manage_pages import ManagePages
from physion.experiment.experimenter.page_context import (
    WRONG_FORM,
    WRONG_LOGIN,
    WRONG_PASSWORD,
    PageContext,
    redirect,
)
from physion.experiment.experimenter.payment_pages import PaymentPages
from physion.experiment.experimenter.session_list import KINDS, SessionFilter
from physion.experiment.store.lab import note_action
from physion.experiment.study.identity import FIRST_ACCOUNT, Account, Permission, Secrets
from physion.experiment.study.study import Study
from physion.experiment.web.files import read_page_files

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

LOG = logging.getLogger(__name__)
Handler = Callable[[Request], Awaitable[Response]]
Allowed = Permission | Literal["any role"]
PUBLIC: Literal["public"] = "public"
"""In place of a permission: a page that needs no login."""
ANY_ROLE: Literal["any role"] = "any role"
"""In place of a permission: a page of every account."""


def build_router(study: Study, secrets: Secrets, store: Store) -> APIRouter:
    """Return the router of the pages of a study, to be included under ``/experimenter``."""
    context = PageContext(study, secrets, store.engine.url.render_as_string(hide_password=False))
    exports = ExportPages(context, store)
    manage = ManagePages(context, store, exports)
    pages = _Pages(context, manage, store)
    payments = PaymentPages(context, store, exports)

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        await context.close()

    router = APIRouter(lifespan=lifespan, include_in_schema=False)
    table: tuple[tuple[str, str, Allowed | Literal["public"], Handler], ...] = (
        ("GET", "", "progress", pages.overview),
        ("GET", "/", "progress", pages.overview),
        ("GET", "/login", PUBLIC, pages.login_page),
        ("POST", "/login", PUBLIC, pages.login),
        ("POST", "/logout", ANY_ROLE, pages.logout),
        ("GET", "/sessions", "sessions", pages.sessions),
        ("GET", "/sessions/{session}", "sessions", pages.session),
        ("POST", "/sessions/{session}/void", "manage", manage.set_voided),
        ("POST", "/sessions/{session}/forget", "manage", manage.forget),
        ("POST", "/recruitment", "recruitment", manage.set_recruitment),
        ("GET", "/payments", "payments", payments.show),
        ("POST", "/payments", "payments", payments.confirm),
        ("GET", "/payments.csv", "payments", payments.download),
        ("POST", "/payments/forget", "manage", payments.forget),
        ("GET", "/export", "export", exports.show),
        ("POST", "/export", "export", exports.make),
        ("GET", "/log", "log", manage.log),
        ("GET", "/static/{name}", PUBLIC, pages.static),
    )
    for method, path, permission, page in table:
        handler = page if permission == PUBLIC else _guarded(context, permission, page)
        router.add_api_route(path, handler, methods=[method], response_model=None)
    return router


def _guarded(context: PageContext, permission: Allowed, page: Handler) -> Handler:
    """Return a handler that calls ``page`` for accounts whose role has the permission.

    Others are sent to the login, or shown that their role does not allow the page.
    """

    async def handler(request: Request) -> Response:
        by_person = request.query_params.get("auto") != "1"
        login = context.access.login(request, by_person)
        if login is None:
            return redirect("/login")
        request.state.login = login
        if permission != ANY_ROLE and not login.account.may(permission):
            problem = f"The role of this account ({login.account.role}) does not allow this."
            return context.render_problem(request, problem, 403)
        return await page(request)

    return handler


class _Pages:
    """Request handlers of login, overview, sessions and static files."""

    def __init__(self, context: PageContext, manage: ManagePages, store: Store) -> None:
        self._context, self._manage, self._store = context, manage, store
        self._files = read_page_files(Path(__file__).parent / "static")

    async def login_page(self, request: Request) -> Response:
        """Show the login form."""
        if self._context.access.login(request) is not None:
            return redirect("")
        return self._login_form(request)

    async def login(self, request: Request) -> Response:
        """Check name and password, and log in."""
        access = self._context.access
        fields = await access.form(request)
        if fields is None:
            return self._login_form(request, WRONG_FORM, 403)
        name = fields.get("user", FIRST_ACCOUNT).strip()
        found = await access.try_password(request, name, fields.get("password", ""))
        if not isinstance(found, Account):
            LOG.warning("a login of an experimenter was refused")
            wrong = WRONG_LOGIN if access.has_names() else WRONG_PASSWORD
            return self._context.refuse_password(request, found, self._login_form, wrong)
        LOG.info("an experimenter logged in")
        await self._store.write(
            lambda c: note_action(c, "logged in", account=found.name, role=found.role)
        )
        access.logins.close(access.token(request))
        response = redirect("")
        set_cookie(request, response, access.logins.open(found, access.clock()))
        return response

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
        response = self._context.render_with_token(
            "login.html", visit, status, problem=problem, named=self._context.access.has_names()
        )
        set_cookie(request, response, visit)
        if wait:
            response.headers["retry-after"] = str(math.ceil(wait))
        return response

    async def overview(self, request: Request) -> Response:
        """Show the overview."""
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
        choice = SessionFilter.from_query(request.query_params, self._context.study)
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
