"""The payments page, which requires the password again, and the deletion of raw ids."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from physion.errors import PhysionError
from physion.experiment.experimenter.export_pages import ExportPages
from physion.experiment.experimenter.page_context import FORGET_WORD, PageContext, redirect
from physion.experiment.experimenter.payments import read_payments
from physion.experiment.experimenter.session_list import page_number

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

LOG = logging.getLogger(__name__)


class PaymentPages:
    """Request handlers of the payments page."""

    def __init__(self, context: PageContext, store: Store, exports: ExportPages) -> None:
        self._context, self._store, self._exports = context, store, exports

    async def show(self, request: Request) -> Response:
        """Show the payments, or the password form if it was not confirmed recently."""
        login = self._context.access.login(request)
        if login is None:
            return redirect("/login")
        if not login.may_see_payments(self._context.access.clock()):
            return self._confirm_form(request)
        return await self._list(request)

    async def confirm(self, request: Request) -> Response:
        """Check the password that opens the page."""
        sent = await self._context.read_submission(request, self._confirm_form)
        if isinstance(sent, Response):
            return sent
        login, fields = sent
        wait = await self._context.access.try_password(request, fields.get("password", ""))
        if wait is not None:
            return self._context.refuse_password(request, wait, self._confirm_form)
        login.confirmed = self._context.access.clock()
        return redirect("/payments")

    async def forget(self, request: Request) -> Response:
        """Delete all raw ids."""
        sent = await self._context.read_submission(request, self._confirm_form)
        if isinstance(sent, Response):
            return sent
        login, fields = sent
        if not login.may_see_payments(self._context.access.clock()):
            return self._confirm_form(request)
        if fields.get("word", "").strip().lower() != FORGET_WORD:
            problem = f"Nothing was deleted: type the word “{FORGET_WORD}” to confirm."
            return await self._list(request, problem, 422)
        from physion.experiment.store.forget import forget_raw_ids

        if self._exports.running:
            return await self._list(request, "An export is in progress; wait until it ends.", 409)
        try:
            # A concurrent reader would keep the deleted bytes in the database's write-ahead log.
            async with self._context.statistics.stopped():
                deleted = await forget_raw_ids(self._store)
        except PhysionError as error:
            return await self._list(request, str(error), 503)
        LOG.warning("%d raw ids were deleted by an experimenter", deleted)
        return await self._list(request, f"{deleted} ids were deleted.")

    async def _list(self, request: Request, message: str = "", status: int = 200) -> Response:
        """Show the payments with a message."""
        query = request.query_params
        source = query.get("source", "")[:20]
        finished = query.get("who", "finished") != "all"
        payments = await run_in_threadpool(
            read_payments, self._context.study, self._context.secrets, self._store.engine,
            source=source, finished=finished, page=page_number(query.get("page", "")),
        )  # fmt: skip
        return await self._context.render_in_thread(
            request, "payments.html", status, here="payments", payments=payments, source=source,
            finished=finished, message=message,
        )  # fmt: skip

    def _confirm_form(
        self, request: Request, problem: str = "", status: int = 200, wait: float = 0.0
    ) -> Response:
        """Show the password form."""
        response = self._context.render(
            request, "confirm.html", status, here="payments", problem=problem
        )
        if wait:
            response.headers["retry-after"] = str(math.ceil(wait))
        return response
