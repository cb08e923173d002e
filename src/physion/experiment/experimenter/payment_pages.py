"""The payments page, which requires the password again, and the deletion of raw ids."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from physion.core.errors import PhysionError
from physion.experiment.experimenter.access.access_control import HEADERS
from physion.experiment.experimenter.archive import file_name
from physion.experiment.experimenter.export_pages import ExportPages
from physion.experiment.experimenter.page_context import (
    FORGET_WORD,
    PageContext,
    login_of,
    note,
    redirect,
)
from physion.experiment.experimenter.payment_table import bonus_of, payment_csv
from physion.experiment.experimenter.payments import Payments, read_payments
from physion.experiment.experimenter.session_list import page_number
from physion.experiment.study.identity import Account

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

LOG = logging.getLogger(__name__)


class PaymentPages:
    """Request handlers of the payments page."""

    def __init__(self, context: PageContext, store: Store, exports: ExportPages) -> None:
        self._context, self._store, self._exports = context, store, exports

    async def show(self, request: Request) -> Response:
        """Show the payments, or the password form if it was not confirmed recently."""
        login = login_of(request)
        if not login.may_see_payments(self._context.access.clock()):
            return self._confirm_form(request)
        return await self._list(request)

    async def confirm(self, request: Request) -> Response:
        """Check the password that opens the page."""
        sent = await self._context.read_submission(request, self._confirm_form)
        if isinstance(sent, Response):
            return sent
        login, fields = sent
        found = await self._context.access.try_password(
            request, login.account.name, fields.get("password", "")
        )
        if not isinstance(found, Account):
            return self._context.refuse_password(request, found, self._confirm_form)
        await self._store.write(lambda c: note(c, request, "opened the payments"))
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
        from physion.experiment.store.lab import forget_raw_ids

        if self._exports.running:
            return await self._list(request, "An export is in progress; wait until it ends.", 409)
        try:
            # A concurrent reader would keep the deleted bytes in the database's write-ahead log.
            async with self._context.statistics.stopped():
                deleted = await forget_raw_ids(self._store)
        except PhysionError as error:
            return await self._list(request, str(error), 503)
        await self._store.write(lambda c: note(c, request, "deleted ids", f"{deleted}"))
        LOG.warning("%d raw ids were deleted by an experimenter", deleted)
        return await self._list(request, f"{deleted} ids were deleted.")

    async def download(self, request: Request) -> Response:
        """Send the selected payments as CSV."""
        login = login_of(request)
        if not login.may_see_payments(self._context.access.clock()):
            return self._confirm_form(request)
        known = await self._context.query_statistics(request, "payments")
        if isinstance(known, Response):
            return known
        payments = await self._read(request, None)
        content = payment_csv(payments.rows, known, self._context.study.bonus)
        count = f"{len(payments.rows)} sessions"
        await self._store.write(lambda c: note(c, request, "downloaded the payments", count))
        name = f"{file_name(self._context.study)}-payments.csv"
        headers = {**HEADERS, "content-disposition": f'attachment; filename="{name}"'}
        return Response(content, 200, headers, "text/csv; charset=utf-8")

    async def _read(self, request: Request, page: int | None) -> Payments:
        """Read the payments that the query of the request selects."""
        query = request.query_params
        return await run_in_threadpool(
            read_payments, self._context.study, self._context.secrets, self._store.engine,
            source=query.get("source", "")[:20], finished=query.get("who", "finished") != "all",
            page=page,
        )  # fmt: skip

    async def _list(self, request: Request, message: str = "", status: int = 200) -> Response:
        """Show the payments with a message."""
        query = request.query_params
        payments = await self._read(request, page_number(query.get("page", "")))
        try:
            known = await self._context.statistics.query("payments")
        except PhysionError:
            known = {}  # ids and codes are needed without it too
        rule = self._context.study.bonus
        bonus = {name: bonus_of(rule, done) for name, done in known.items()}
        return await self._context.render_in_thread(
            request, "payments.html", status, here="payments", payments=payments,
            source=query.get("source", "")[:20], finished=query.get("who", "finished") != "all",
            message=message, known=known, bonus=bonus if rule.per_correct else {},
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
