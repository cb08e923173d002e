"""The experimenter's pages under ``/experimenter``: what a lab needs while a study runs.

Progress (with the pause of recruitment), sessions with their flags, one session (void, delete),
payments, and the export. Everything is read and rendered in threads, so that participants are not
delayed. The pages need no script; they refresh themselves by a header of HTML.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
import tempfile
import threading
import time
import unicodedata
import zipfile
from collections.abc import AsyncIterator, Awaitable, Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastapi import APIRouter, FastAPI
from sqlalchemy import Engine, select
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, RedirectResponse, Response

from physion.core.errors import BadInputError, PhysionError
from physion.core.html import environment
from physion.experiment.experimenter.access import HEADERS, PATH, Access, read_form
from physion.experiment.experimenter.payments import measured_wage, payment_csv, read_payments
from physion.experiment.experimenter.progress import (
    ALARM_ENTRIES,
    KINDS,
    STATES,
    StudyProgress,
    load_analysis,
)
from physion.experiment.store.database import ANSWERS
from physion.experiment.store.entry import is_paused
from physion.experiment.store.lab import forget_raw_ids, forget_session, set_paused, set_voided
from physion.experiment.store.sessions import ACTIVE_WITHIN
from physion.experiment.study.identity import Secrets
from physion.experiment.study.orders import instructed_response
from physion.experiment.study.stimuli import is_right
from physion.experiment.study.study import Study
from physion.experiment.web.files import read_page_files

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

LOG = logging.getLogger(__name__)
Handler = Callable[[Request], Awaitable[Response]]
REFRESH_SECONDS = 30
"""Interval of the automatic refresh of the progress."""
FORGET_WORD = "delete"
"""Word that must be typed to confirm a deletion."""
WRONG_FORM = "This form was no longer valid. Please try again."
NO_SESSION = "There is no such session."
NONE = "–"


def build_router(study: Study, secrets: Secrets, store: Store) -> APIRouter:
    """Return the router of the pages of a study, to be included under ``/experimenter``."""
    pages = _Pages(study, secrets, store)

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        threading.Thread(target=load_analysis, daemon=True).start()
        yield
        pages.access.stop()

    router = APIRouter(lifespan=lifespan, include_in_schema=False)
    public: tuple[tuple[str, str, Handler], ...] = (
        ("GET", "/login", pages.login_page),
        ("POST", "/login", pages.login),
        ("GET", "/static/{name}", pages.static),
    )
    own: tuple[tuple[str, str, Handler], ...] = (
        ("GET", "", pages.progress),
        ("GET", "/", pages.progress),
        ("POST", "/logout", pages.logout),
        ("POST", "/recruitment", pages.set_recruitment),
        ("GET", "/sessions", pages.sessions),
        ("GET", "/sessions/{session}", pages.session),
        ("POST", "/sessions/{session}/void", pages.set_voided),
        ("POST", "/sessions/{session}/forget", pages.forget_session),
        ("GET", "/payments", pages.payments),
        ("GET", "/payments.csv", pages.payments_csv),
        ("POST", "/payments/forget", pages.forget_ids),
        ("GET", "/export", pages.export_form),
        ("POST", "/export", pages.export),
    )
    for method, path, page in public:
        router.add_api_route(path, page, methods=[method], response_model=None)
    for method, path, page in own:
        router.add_api_route(path, pages.guarded(page), methods=[method], response_model=None)
    return router


class _Pages:
    """Request handlers of all pages of one served study."""

    def __init__(self, study: Study, secrets: Secrets, store: Store) -> None:
        self._study, self._secrets, self._store = study, secrets, store
        self._engine: Engine = store.engine
        self.access = Access(secrets)
        self._progress = StudyProgress(study, store.engine)
        self._files = read_page_files(Path(__file__).parent / "static")
        self._exporting = False
        self._templates = environment(__package__)
        self._templates.filters.update({each.__name__: each for each in _FILTERS})
        self._shared = {
            "study": study, "kinds": KINDS, "states": STATES, "path": PATH,
            "forget_word": FORGET_WORD, "active_minutes": round(ACTIVE_WITHIN / 60),
            "refresh_seconds": REFRESH_SECONDS,
        }  # fmt: skip

    def guarded(self, page: Handler) -> Handler:
        """Return a handler that sends browsers without a login to the login page.

        The fields of a form are in ``request.state.form``.
        """

        async def handler(request: Request) -> Response:
            if not self.access.is_logged_in(request):
                return _redirect("/login")
            if request.method == "POST":
                request.state.form = await read_form(request)
                if request.state.form is None:
                    return self._problem(WRONG_FORM, 403)
            return await page(request)

        return handler

    def _render(self, template: str, status: int = 200, **values: Any) -> Response:
        """Render a page."""
        text = self._templates.get_template(template).render(
            now=time.time(), **self._shared, **values
        )
        return Response(text, status, HEADERS, "text/html; charset=utf-8")

    def _problem(self, problem: str, status: int) -> Response:
        return self._render("problem.html", status, here="", problem=problem)

    async def static(self, request: Request) -> Response:
        """Send the style sheet or the icon."""
        file = self._files.get(request.path_params["name"])
        if file is None:
            return Response("There is nothing at this address.", 404, HEADERS, "text/plain")
        return file.response(request)

    async def login_page(self, request: Request) -> Response:
        """Show the login form."""
        if self.access.is_logged_in(request):
            return _redirect("")
        return self._render("login.html", problem="")

    async def login(self, request: Request) -> Response:
        """Check the password, and log in."""
        fields = await read_form(request)
        if fields is None:
            return self._render("login.html", 403, problem=WRONG_FORM)
        right = await self.access.check(fields.get("password", ""))
        if right is None:
            problem = "Too many attempts at the same time. Please try again."
            return self._render("login.html", 429, problem=problem)
        if not right:
            LOG.warning("a login of an experimenter was refused")
            return self._render("login.html", 403, problem="This is not the password.")
        LOG.info("an experimenter logged in")
        response = _redirect("")
        self.access.open(request, response)
        return response

    async def logout(self, request: Request) -> Response:
        """Log out."""
        response = _redirect("/login")
        self.access.close(request, response)
        return response

    async def progress(self, request: Request) -> Response:
        """Show the progress of the study."""
        kind = _kind(request)

        def read() -> Response:
            lines, flags = self._progress.sessions(kind)
            by_scenario, by_condition = self._progress.rows(lines)
            with self._engine.connect() as connection:
                paused = is_paused(connection)
            entries = self._store.entries(60.0)
            return self._render(
                "progress.html", here="progress", kind=kind, rows=by_scenario,
                conditions=by_condition, flags=flags, paused=paused,
                counts=self._progress.kinds(), entries=entries,
                alarm=entries >= ALARM_ENTRIES,
            )  # fmt: skip

        return await run_in_threadpool(read)

    async def set_recruitment(self, request: Request) -> Response:
        """Pause or resume recruitment."""
        action, now = request.state.form.get("action"), time.time()
        if action not in ("pause", "resume"):
            return self._problem("This form was not understood.", 422)
        await self._store.write(lambda c: set_paused(c, action == "pause", now))
        LOG.warning("an experimenter asked to %s recruitment", action)
        return _redirect("")

    async def sessions(self, request: Request) -> Response:
        """Show all sessions, or the sessions of one scenario, state or flag."""
        query = request.query_params
        kind, scenario, state = _kind(request), query.get("scenario", ""), query.get("state", "")
        flag = query.get("flag", "")[:40]

        def read() -> Response:
            lines, flags = self._progress.sessions(kind)
            rules = sorted({rule for line in lines for rule in line.flags})
            chosen = [
                line
                for line in lines
                if scenario in ("", line.row.scenario)
                and state in ("", line.state)
                and (not flag or flag in line.flags or (flag == "any" and bool(line.flags)))
            ]
            return self._render(
                "sessions.html", here="sessions", kind=kind, lines=chosen, flags=flags,
                scenario=scenario, state=state, flag=flag, rules=rules,
                counts=self._progress.kinds(),
            )  # fmt: skip

        return await run_in_threadpool(read)

    async def session(self, request: Request) -> Response:
        """Show one session."""
        return await run_in_threadpool(self._session, request)

    def _session(self, request: Request) -> Response:
        name = request.path_params["session"][:100]
        lines, _ = self._progress.sessions("", name)
        if not lines:
            return self._problem(NO_SESSION, 404)
        line = lines[0]
        labels = self._study.labels
        columns = [column for column in ANSWERS.c if column.name != "details"]
        own = ANSWERS.c.session == name
        with self._engine.connect() as connection:
            rows = connection.execute(
                select(*columns).where(own).order_by(ANSWERS.c.phase, ANSWERS.c.trial)
            ).all()
        answers = []
        for row in rows:
            asked = instructed_response(row.stimulus)
            outcome = labels.get((line.row.scenario, row.stimulus))
            wanted = outcome if asked is None else asked == "yes"
            right = None if wanted is None else is_right(row.response, wanted)
            answers.append((row, wanted, right))
        return self._render(
            "session.html", here="sessions", line=line, row=line.row, answers=answers
        )

    async def set_voided(self, request: Request) -> Response:
        """Void a session, or count it again."""
        action, now = request.state.form.get("action"), time.time()
        if action not in ("void", "count"):
            return self._problem("This form was not understood.", 422)
        session = request.path_params["session"]
        reference = await self._store.write(lambda c: set_voided(c, session, action == "void", now))
        if reference is None:
            return self._problem(NO_SESSION, 404)
        LOG.warning("an experimenter asked to %s session %s", action, reference)
        return _redirect(f"/sessions/{session}")

    async def forget_session(self, request: Request) -> Response:
        """Delete all data of a session."""
        problem = self._refuse_deletion(request)
        if problem is not None:
            return problem
        session = request.path_params["session"][:100]
        try:
            reference = await forget_session(self._store, session)
        except BadInputError:
            return self._problem(NO_SESSION, 404)
        except PhysionError as error:
            return self._problem(str(error), 503)
        LOG.warning("the data of session %s were deleted by an experimenter", reference)
        return _redirect(f"/sessions/{session}")

    async def payments(self, request: Request) -> Response:
        """Show the payments."""
        return await run_in_threadpool(self._payments, request)

    def _payments(self, request: Request, message: str = "") -> Response:
        finished = request.query_params.get("who", "finished") != "all"
        lines, _ = self._progress.sessions("person")
        payments, stored = read_payments(self._study, self._secrets, self._engine, lines, finished)
        payable = [each for each in payments if each.line.row.implausible is None]
        return self._render(
            "payments.html", here="payments", payments=payments, stored=stored,
            finished=finished, message=message, ids=list(dict.fromkeys(p.raw_id for p in payable)),
            bonus=bool(self._study.bonus.per_correct), rule=self._study.payment,
            wage=measured_wage(self._study.payment, lines),
        )  # fmt: skip

    async def payments_csv(self, request: Request) -> Response:
        """Send the payments as CSV."""
        finished = request.query_params.get("who", "finished") != "all"

        def read() -> bytes:
            lines, _ = self._progress.sessions("person")
            return payment_csv(
                read_payments(self._study, self._secrets, self._engine, lines, finished)[0]
            )

        name = f"{_file_name(self._study)}-payments.csv"
        headers = {**HEADERS, "content-disposition": f'attachment; filename="{name}"'}
        return Response(await run_in_threadpool(read), 200, headers, "text/csv; charset=utf-8")

    async def forget_ids(self, request: Request) -> Response:
        """Delete all raw ids."""
        problem = self._refuse_deletion(request)
        if problem is not None:
            return problem
        try:
            deleted = await forget_raw_ids(self._store)
        except PhysionError as error:
            return self._problem(str(error), 503)
        LOG.warning("%d raw ids were deleted by an experimenter", deleted)
        return await run_in_threadpool(self._payments, request, f"{deleted} ids were deleted.")

    async def export_form(self, request: Request) -> Response:
        """Show the form of the export."""
        return self._render("export.html", here="export")

    async def export(self, request: Request) -> Response:
        """Send the export of ``physion experiment export`` as one zip file."""
        if self._exporting:
            return self._problem("Another export is in progress.", 409)
        folder = Path(tempfile.mkdtemp(prefix="physion-export-"))
        self._exporting = True
        try:
            simulated = request.state.form.get("simulated") == "yes"
            packed = await run_in_threadpool(_export, self._study, self._engine, folder, simulated)
        except PhysionError as error:
            shutil.rmtree(folder, ignore_errors=True)
            return self._problem(str(error), 409)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            self._exporting = False
        day = time.strftime("%Y-%m-%d", time.gmtime())
        return FileResponse(
            packed, media_type="application/zip", headers=dict(HEADERS),
            filename=f"{_file_name(self._study)}-{day}.zip",
            background=BackgroundTask(shutil.rmtree, folder, ignore_errors=True),
        )  # fmt: skip

    def _refuse_deletion(self, request: Request) -> Response | None:
        """Return the response to a form that does not confirm a deletion; None if it does."""
        if request.state.form.get("word", "").strip().lower() != FORGET_WORD:
            problem = f"Nothing was deleted: type the word “{FORGET_WORD}” to confirm."
            return self._problem(problem, 422)
        if self._exporting:  # its snapshot would keep the deleted bytes in the write-ahead log
            return self._problem("An export is in progress; wait until it ends.", 409)
        return None


def _export(study: Study, engine: Engine, folder: Path, simulated: bool) -> Path:
    """Export the study into the private folder ``folder``; return the path of a zip file of it."""
    from physion.experiment.export.export_study import export_study

    export_study(engine, study, folder / _file_name(study), simulated=simulated)
    packed = folder / "export.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for path in sorted((folder / _file_name(study)).rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder))
    return packed


def _file_name(study: Study) -> str:
    """Return name and version of the study as a file name of letters, digits, dots and dashes."""
    name = f"{study.name}-{study.version}"
    kept = "".join(c if c.isascii() and (c.isalnum() or c in "-.") else "-" for c in name)
    return kept.strip("-.")[:80] or "study"


def _kind(request: Request) -> str:
    """Return the kind of sessions that the query asks for; people by default."""
    kind = request.query_params.get("kind", "")
    return kind if kind in KINDS else "person"


def _redirect(path: str) -> Response:
    """Return a redirect to another of the experimenter's pages."""
    return RedirectResponse(f"{PATH}{path}", 303, headers=HEADERS)


def date_time(seconds: float | None) -> str:
    """Format a Unix time as ``2026-03-01 14:05`` in UTC."""
    if seconds is None:
        return NONE
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M")


def percent(fraction: float | None, places: int = 0) -> str:
    """Format a fraction (0..1) in percent."""
    return NONE if fraction is None else f"{100 * fraction:.{places}f} %"


def minutes(value: float | None) -> str:
    """Format minutes as ``12 min``, ``3 h 05`` or ``2 d 4 h``."""
    if value is None:
        return NONE
    whole = round(value)
    if whole < 60:
        return f"{whole} min"
    hours, rest = divmod(whole, 60)
    return f"{hours} h {rest:02d}" if hours < 24 else f"{hours // 24} d {hours % 24} h"


def visible(text: str) -> str:
    """Return a text with codes for invisible characters, such as those that reverse its order."""
    return "".join(
        f"\\u{ord(character):04x}" if unicodedata.category(character) in ("Cf", "Cc") else character
        for character in text
    )


def or_dash(value: object) -> object:
    """Return the value, or a dash if it is missing."""
    return NONE if value is None or value == "" else value


def yes_no(value: bool | None) -> str:
    """Format a boolean that may be missing."""
    return NONE if value is None else ("yes" if value else "no")


_FILTERS = (date_time, percent, minutes, visible, or_dash, yes_no)
