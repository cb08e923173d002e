"""Forms that change a study while it is served (recruitment, void sessions, deleted data), and the
log of who did so.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

from sqlalchemy import Connection, select
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from physion.core.errors import PhysionError
from physion.experiment.experimenter.export_pages import ExportPages
from physion.experiment.experimenter.page_context import (
    FORGET_WORD,
    PageContext,
    note,
    redirect,
)
from physion.experiment.experimenter.session_list import page_number
from physion.experiment.store.database import SESSIONS
from physion.experiment.store.lab import (
    Action,
    LogPage,
    is_paused,
    read_log,
    set_paused,
    set_voided,
)

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

LOG = logging.getLogger(__name__)


class ManagePages:
    """Request handlers of these forms."""

    def __init__(self, context: PageContext, store: Store, exports: ExportPages) -> None:
        self._context, self._store, self._exports = context, store, exports

    async def is_paused(self) -> bool:
        """Return whether recruitment is paused."""

        def read() -> bool:
            with self._store.engine.connect() as connection:
                return is_paused(connection)

        return await run_in_threadpool(read)

    async def set_recruitment(self, request: Request) -> Response:
        """Pause or resume recruitment."""
        sent = await self._context.read_submission(request, self._context.render_problem)
        if isinstance(sent, Response):
            return sent
        action, now = sent[1].get("action"), time.time()
        if action not in ("pause", "resume"):
            return self._context.render_problem(request, "This form was not understood.", 422)
        pause = action == "pause"

        def change(connection: Connection) -> None:
            if set_paused(connection, pause, now):
                done: Action = "paused recruitment" if pause else "resumed recruitment"
                note(connection, request, done)

        await self._store.write(change)
        LOG.warning("an experimenter asked to %s recruitment", action)
        return redirect("")

    async def set_voided(self, request: Request) -> Response:
        """Void a session, or count it again."""
        sent = await self._context.read_submission(request, self._context.render_problem)
        if isinstance(sent, Response):
            return sent
        action, now = sent[1].get("action"), time.time()
        reference = await self._reference(request)
        if reference is None:
            return self._context.render_problem(request, "There is no such session.", 404)
        if action not in ("void", "count"):
            return self._context.render_problem(request, "This form was not understood.", 422)
        session, void = request.path_params["session"], action == "void"

        def change(connection: Connection) -> None:
            if set_voided(connection, session, void, now):
                done: Action = "made a session void" if void else "counted a session again"
                note(connection, request, done, reference)

        await self._store.write(change)
        LOG.warning("an experimenter asked to %s session %s", action, reference)
        return redirect(f"/sessions/{session}")

    async def forget(self, request: Request) -> Response:
        """Delete all data of a session."""
        sent = await self._context.read_submission(request, self._context.render_problem)
        if isinstance(sent, Response):
            return sent
        reference = await self._reference(request)
        if reference is None:
            return self._context.render_problem(request, "There is no such session.", 404)
        if sent[1].get("word", "").strip().lower() != FORGET_WORD:
            problem = f"Nothing was deleted: type the word “{FORGET_WORD}” to confirm."
            return self._context.render_problem(request, problem, 422)
        if self._exports.running:
            problem = "An export is in progress; wait until it ends."
            return self._context.render_problem(request, problem, 409)
        from physion.experiment.store.lab import forget_session

        try:
            # A concurrent reader would keep the deleted bytes in the database's write-ahead log.
            async with self._context.statistics.stopped():
                await forget_session(self._store, reference)
                await self._store.write(lambda c: note(c, request, "deleted a session", reference))
        except PhysionError as error:
            return self._context.render_problem(request, str(error), 503)
        LOG.warning("the data of session %s were deleted by an experimenter", reference)
        return redirect(f"/sessions/{request.path_params['session']}")

    async def log(self, request: Request) -> Response:
        """Show the log."""
        number = page_number(request.query_params.get("page", ""))

        def read() -> LogPage:
            with self._store.engine.connect() as connection:
                return read_log(connection, number)

        log = await run_in_threadpool(read)
        return await self._context.render_in_thread(request, "log.html", here="log", log=log)

    async def _reference(self, request: Request) -> str | None:
        """Return the reference of the session in the path, or None if there is none."""
        named = SESSIONS.c.session == request.path_params["session"][:100]

        def read() -> str | None:
            with self._store.engine.connect() as connection:
                return connection.scalar(select(SESSIONS.c.reference).where(named))

        return await run_in_threadpool(read)
