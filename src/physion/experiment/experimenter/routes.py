"""The experimenter's pages as addresses below ``/experimenter``."""

from __future__ import annotations

import contextlib
import logging
import math
import shutil
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastapi import APIRouter, FastAPI
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, RedirectResponse, Response

from physion.errors import PhysionError
from physion.experiment.experimenter.archive import file_name
from physion.experiment.experimenter.desk import Desk
from physion.experiment.experimenter.gate import HEADERS, Gate, drop_cookie, set_cookie
from physion.experiment.experimenter.login import PATH
from physion.experiment.experimenter.pages import make_environment
from physion.experiment.experimenter.payments import read_payments
from physion.experiment.experimenter.session_list import KINDS, Choice, page_number
from physion.experiment.experimenter.summaries import STATES
from physion.experiment.identity import Secrets, check_password
from physion.experiment.page_files import read_page_files
from physion.experiment.sessions import ACTIVE_WITHIN
from physion.experiment.study import Study

if TYPE_CHECKING:
    from physion.experiment.store import Store

LOG = logging.getLogger(__name__)
EXPORT_PATIENCE = 900.0
"""Seconds that an export may take."""
REFRESH_SECONDS = 30
"""How often the overview refreshes by itself."""
FORGET_WORD = "delete"
"""What has to be written before the raw ids are deleted."""
WRONG_PASSWORD = "This is not the password."
WRONG_FORM = "This form was no longer valid. Please try again."


def build_router(study: Study, secrets: Secrets, store: Store) -> APIRouter:
    """The pages of a study, to be included below ``/experimenter``."""
    desk = _Pages(study, secrets, store)
    router = APIRouter(lifespan=desk.lifespan, include_in_schema=False)
    for path, page in (
        ("", desk.overview),
        ("/", desk.overview),
        ("/login", desk.login_page),
        ("/sessions", desk.sessions),
        ("/sessions/{session}", desk.session),
        ("/payments", desk.payments),
        ("/export", desk.export_page),
        ("/static/{name}", desk.static),
    ):
        router.add_api_route(path, page, methods=["GET"], response_model=None)
    for path, action in (
        ("/login", desk.login),
        ("/logout", desk.logout),
        ("/payments", desk.confirm),
        ("/payments/forget", desk.forget),
        ("/export", desk.export),
    ):
        router.add_api_route(path, action, methods=["POST"], response_model=None)
    return router


class _Pages:
    """One method an address."""

    def __init__(self, study: Study, secrets: Secrets, store: Store) -> None:
        self._study, self._secrets, self._store = study, secrets, store
        self._gate = Gate(self._is_password)
        self._url = store.engine.url.render_as_string(hide_password=False)
        self._desk = Desk(study, self._url)
        self._exporting = False
        self._files = read_page_files(Path(__file__).parent / "static")
        self._templates = make_environment(
            study=study, kinds=KINDS, states=STATES, active_minutes=round(ACTIVE_WITHIN / 60),
            refresh_seconds=REFRESH_SECONDS, forget_word=FORGET_WORD,
        )  # fmt: skip

    @contextlib.asynccontextmanager
    async def lifespan(self, app: FastAPI) -> AsyncIterator[None]:
        """Ends the process that counts when the server ends."""
        yield
        self._gate.close()
        await run_in_threadpool(self._desk.close)

    def _is_password(self, password: str) -> bool:
        """Looks at the file each time: a new password counts at once."""
        try:
            secrets = Secrets.load(self._study.folder)
        except PhysionError:
            secrets = self._secrets
        return check_password(secrets, password)

    # --- in and out ----------------------------------------------------------------------------

    async def login_page(self, request: Request) -> Response:
        if self._gate.login(request) is not None:
            return _go("")
        return self._login_form(request)

    async def login(self, request: Request) -> Response:
        fields = await self._gate.form(request)
        if fields is None:
            return self._login_form(request, WRONG_FORM, 403)
        wait = await self._gate.try_password(request, fields.get("password", ""))
        if wait is None:
            LOG.info("an experimenter logged in")
            self._gate.logins.close(self._gate.token(request))
            response = _go("")
            set_cookie(request, response, self._gate.logins.open(self._gate.clock()))
            return response
        LOG.warning("a login of an experimenter was refused")
        return self._refuse_password(request, wait, self._login_form)

    async def logout(self, request: Request) -> Response:
        if await self._gate.form(request) is None:
            return self._problem(request, WRONG_FORM, 403)
        self._gate.logins.close(self._gate.token(request))
        response = _go("/login")
        drop_cookie(request, response)
        return response

    def _login_form(
        self, request: Request, problem: str = "", status: int = 200, wait: float = 0.0
    ) -> Response:
        visit = self._gate.visit(request)
        response = self._page("login.html", visit, status, problem=problem)
        set_cookie(request, response, visit)
        if wait:
            response.headers["retry-after"] = str(math.ceil(wait))
        return response

    def _refuse_password(self, request: Request, wait: float, form: Any) -> Response:
        if wait == 0:
            return form(request, WRONG_PASSWORD, 403)  # type: ignore[no-any-return]
        problem = f"Too many tries. Please wait {math.ceil(wait)} seconds and try again."
        return form(request, problem, 429, wait)  # type: ignore[no-any-return]

    # --- what is seen --------------------------------------------------------------------------

    async def overview(self, request: Request) -> Response:
        by_person = request.query_params.get("auto") != "1"
        if self._gate.login(request, by_person) is None:
            return _go("/login")
        kind = request.query_params.get("kind", "")
        kind = kind if kind in KINDS else "person"
        found = await self._ask(request, "overview", kind=kind)
        if isinstance(found, Response):
            return found
        overview, flags = found
        return await self._draw(
            request, "overview.html", here="overview", overview=overview, flags=flags
        )

    async def sessions(self, request: Request) -> Response:
        if self._gate.login(request) is None:
            return _go("/login")
        choice = Choice.read(request.query_params, self._study.scenarios)
        found = await self._ask(request, "sessions", choice=choice)
        if isinstance(found, Response):
            return found
        listed, flags = found
        return await self._draw(
            request, "sessions.html", here="sessions", listed=listed, choice=listed.choice,
            flags=flags,
        )  # fmt: skip

    async def session(self, request: Request) -> Response:
        if self._gate.login(request) is None:
            return _go("/login")
        found = await self._ask(request, "session", session=request.path_params["session"][:100])
        if isinstance(found, Response):
            return found
        if found is None:
            return self._problem(request, "There is no such session.", 404)
        return await self._draw(request, "session.html", here="sessions", page=found)

    async def static(self, request: Request) -> Response:
        found = self._files.get(request.path_params["name"])
        if found is None:
            return self._problem(request, "There is nothing at this address.", 404)
        return found.response(request)

    # --- payments ------------------------------------------------------------------------------

    async def payments(self, request: Request) -> Response:
        login = self._gate.login(request)
        if login is None:
            return _go("/login")
        if not login.may_see_payments(self._gate.clock()):
            return self._confirm_form(request)
        return await self._payments(request)

    async def confirm(self, request: Request) -> Response:
        login = self._gate.login(request)
        if login is None:
            return _go("/login")
        fields = await self._gate.form(request)
        if fields is None:
            return self._confirm_form(request, WRONG_FORM, 403)
        wait = await self._gate.try_password(request, fields.get("password", ""))
        if wait is not None:
            return self._refuse_password(request, wait, self._confirm_form)
        login.confirmed = self._gate.clock()
        return _go("/payments")

    async def forget(self, request: Request) -> Response:
        login = self._gate.login(request)
        if login is None:
            return _go("/login")
        fields = await self._gate.form(request)
        if fields is None:
            return self._confirm_form(request, WRONG_FORM, 403)
        if not login.may_see_payments(self._gate.clock()):
            return self._confirm_form(request)
        if fields.get("word", "").strip().lower() != FORGET_WORD:
            problem = f"Nothing was deleted: write the word “{FORGET_WORD}” first."
            return await self._payments(request, problem, 422)
        from physion.experiment.forget import forget_raw_ids

        if self._exporting:
            return await self._payments(request, "An export is being made; wait for its end.", 409)
        try:
            # Whoever reads just now would keep the deleted bytes in the log of the database.
            async with self._desk.closed():
                deleted = await forget_raw_ids(self._store)
        except PhysionError as error:
            return await self._payments(request, str(error), 503)
        LOG.warning("%d raw ids were deleted by an experimenter", deleted)
        return await self._payments(request, f"{deleted} ids were deleted.")

    async def _payments(self, request: Request, said: str = "", status: int = 200) -> Response:
        query = request.query_params
        source = query.get("source", "")[:20]
        finished = query.get("who", "finished") != "all"
        found = await run_in_threadpool(
            read_payments, self._study, self._secrets, self._store.engine, source=source,
            finished=finished, page=page_number(query.get("page", "")),
        )  # fmt: skip
        return await self._draw(
            request, "payments.html", status, here="payments", payments=found, source=source,
            finished=finished, said=said,
        )  # fmt: skip

    def _confirm_form(
        self, request: Request, problem: str = "", status: int = 200, wait: float = 0.0
    ) -> Response:
        response = self._show(request, "confirm.html", status, here="payments", problem=problem)
        if wait:
            response.headers["retry-after"] = str(math.ceil(wait))
        return response

    # --- export --------------------------------------------------------------------------------

    async def export_page(self, request: Request) -> Response:
        if self._gate.login(request) is None:
            return _go("/login")
        return self._show(request, "export.html", here="export", problem="")

    async def export(self, request: Request) -> Response:
        if self._gate.login(request) is None:
            return _go("/login")
        fields = await self._gate.form(request)
        if fields is None:
            return self._export_refused(request, WRONG_FORM, 403)
        if self._exporting:
            return self._export_refused(request, "An export is being made already.", 409)
        folder = Path(tempfile.mkdtemp(prefix="physion-export-"))
        self._exporting = True
        try:
            packed = await self._pack(folder, fields.get("simulated") == "yes")
        except PhysionError as error:
            await run_in_threadpool(shutil.rmtree, folder, ignore_errors=True)
            return self._export_refused(request, str(error), 409)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            self._exporting = False
        day = time.strftime("%Y-%m-%d", time.gmtime())
        return FileResponse(
            packed, media_type="application/zip", headers=dict(HEADERS),
            filename=f"{file_name(self._study)}-{day}.zip",
            background=BackgroundTask(shutil.rmtree, folder, ignore_errors=True),
        )  # fmt: skip

    async def _pack(self, folder: Path, simulated: bool) -> Path:
        """The export as a zip file, made by a process of its own."""
        clerk = Desk(self._study, self._url, EXPORT_PATIENCE)
        try:
            packed: Path = await clerk.ask("export", folder=folder, simulated=simulated)
        finally:
            await run_in_threadpool(clerk.close)
        return packed

    def _export_refused(self, request: Request, problem: str, status: int) -> Response:
        return self._show(request, "export.html", status, here="export", problem=problem)

    # --- pages ---------------------------------------------------------------------------------

    async def _ask(self, request: Request, question: str, **arguments: Any) -> Any:
        """The clerk's answer, or a page that says why there is none."""
        try:
            return await self._desk.ask(question, **arguments)
        except PhysionError as error:
            return self._problem(request, str(error), 503)

    def _problem(self, request: Request, problem: str, status: int) -> Response:
        if self._gate.login(request) is None:
            return _go("/login")
        return self._show(request, "problem.html", status, here="", problem=problem)

    def _show(self, request: Request, template: str, status: int = 200, **values: Any) -> Response:
        return self._page(template, self._gate.token(request), status, **values)

    async def _draw(self, *given: Any, **values: Any) -> Response:
        """As `_show`, of a page that takes milliseconds: in a thread."""
        return await run_in_threadpool(self._show, *given, **values)

    def _page(self, template: str, token: str, status: int, **values: Any) -> Response:
        now = time.time()
        text = self._templates.get_template(template).render(
            form_token=self._gate.logins.form_token(token), now=now, **values
        )
        return Response(text, status, HEADERS, "text/html; charset=utf-8")


def _go(place: str) -> Response:
    return RedirectResponse(f"{PATH}{place}", 303, headers=HEADERS)
