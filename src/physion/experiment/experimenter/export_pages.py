"""The page that makes an export and sends it as one zip file."""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, Response

from physion.errors import PhysionError
from physion.experiment.experimenter.access.gate import HEADERS
from physion.experiment.experimenter.archive import file_name
from physion.experiment.experimenter.front import Front, go
from physion.experiment.experimenter.statistics.process import Desk

EXPORT_PATIENCE = 900.0
"""Seconds that an export may take."""


class ExportPages:
    """One method an address; one export at a time. ``running``: there is one."""

    def __init__(self, front: Front) -> None:
        self._front = front
        self.running = False

    async def show(self, request: Request) -> Response:
        if self._front.gate.login(request) is None:
            return go("/login")
        return self._front.show(request, "export.html", here="export", problem="")

    async def make(self, request: Request) -> Response:
        sent = await self._front.sent(request, self._refuse)
        if isinstance(sent, Response):
            return sent
        _, fields = sent
        if self.running:
            return self._refuse(request, "An export is being made already.", 409)
        folder = Path(tempfile.mkdtemp(prefix="physion-export-"))
        self.running = True
        try:
            packed = await self._pack(folder, fields.get("simulated") == "yes")
        except PhysionError as error:
            await run_in_threadpool(shutil.rmtree, folder, ignore_errors=True)
            return self._refuse(request, str(error), 409)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            self.running = False
        day = time.strftime("%Y-%m-%d", time.gmtime())
        return FileResponse(
            packed, media_type="application/zip", headers=dict(HEADERS),
            filename=f"{file_name(self._front.study)}-{day}.zip",
            background=BackgroundTask(shutil.rmtree, folder, ignore_errors=True),
        )  # fmt: skip

    async def _pack(self, folder: Path, simulated: bool) -> Path:
        """The export as a zip file, made by a process of its own."""
        clerk = Desk(self._front.study, self._front.url, EXPORT_PATIENCE)
        try:
            packed: Path = await clerk.ask("export", folder=folder, simulated=simulated)
        finally:
            await run_in_threadpool(clerk.close)
        return packed

    def _refuse(self, request: Request, problem: str, status: int) -> Response:
        return self._front.show(request, "export.html", status, here="export", problem=problem)
