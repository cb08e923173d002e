"""Pages of who is to be paid: behind the password once more, and the deletion of raw ids."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from physion.errors import PhysionError
from physion.experiment.experimenter.export_pages import ExportPages
from physion.experiment.experimenter.front import FORGET_WORD, Front, go
from physion.experiment.experimenter.payments import read_payments
from physion.experiment.experimenter.session_list import page_number

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

LOG = logging.getLogger(__name__)


class PaymentPages:
    """One method an address."""

    def __init__(self, front: Front, store: Store, exports: ExportPages) -> None:
        self._front, self._store, self._exports = front, store, exports

    async def show(self, request: Request) -> Response:
        login = self._front.gate.login(request)
        if login is None:
            return go("/login")
        if not login.may_see_payments(self._front.gate.clock()):
            return self._confirm_form(request)
        return await self._list(request)

    async def confirm(self, request: Request) -> Response:
        sent = await self._front.sent(request, self._confirm_form)
        if isinstance(sent, Response):
            return sent
        login, fields = sent
        wait = await self._front.gate.try_password(request, fields.get("password", ""))
        if wait is not None:
            return self._front.refuse_password(request, wait, self._confirm_form)
        login.confirmed = self._front.gate.clock()
        return go("/payments")

    async def forget(self, request: Request) -> Response:
        sent = await self._front.sent(request, self._confirm_form)
        if isinstance(sent, Response):
            return sent
        login, fields = sent
        if not login.may_see_payments(self._front.gate.clock()):
            return self._confirm_form(request)
        if fields.get("word", "").strip().lower() != FORGET_WORD:
            problem = f"Nothing was deleted: write the word “{FORGET_WORD}” first."
            return await self._list(request, problem, 422)
        from physion.experiment.store.forget import forget_raw_ids

        if self._exports.running:
            return await self._list(request, "An export is being made; wait for its end.", 409)
        try:
            # Whoever reads just now would keep the deleted bytes in the log of the database.
            async with self._front.desk.closed():
                deleted = await forget_raw_ids(self._store)
        except PhysionError as error:
            return await self._list(request, str(error), 503)
        LOG.warning("%d raw ids were deleted by an experimenter", deleted)
        return await self._list(request, f"{deleted} ids were deleted.")

    async def _list(self, request: Request, said: str = "", status: int = 200) -> Response:
        query = request.query_params
        source = query.get("source", "")[:20]
        finished = query.get("who", "finished") != "all"
        found = await run_in_threadpool(
            read_payments, self._front.study, self._front.secrets, self._store.engine,
            source=source, finished=finished, page=page_number(query.get("page", "")),
        )  # fmt: skip
        return await self._front.draw(
            request, "payments.html", status, here="payments", payments=found, source=source,
            finished=finished, said=said,
        )  # fmt: skip

    def _confirm_form(
        self, request: Request, problem: str = "", status: int = 200, wait: float = 0.0
    ) -> Response:
        response = self._front.show(
            request, "confirm.html", status, here="payments", problem=problem
        )
        if wait:
            response.headers["retry-after"] = str(math.ceil(wait))
        return response
