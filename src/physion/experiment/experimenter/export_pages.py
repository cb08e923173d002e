"""The page that creates an export and sends it as one zip file."""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, Response

from physion.core.errors import PhysionError
from physion.experiment.experimenter.access.access_control import HEADERS
from physion.experiment.experimenter.archive import file_name
from physion.experiment.experimenter.page_context import PageContext, note
from physion.experiment.experimenter.statistics.process import StatisticsProcess

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

EXPORT_TIMEOUT = 900.0
"""Maximum duration of an export in seconds."""


class ExportPages:
    """Request handlers of the export page; only one export (``running``) at a time."""

    def __init__(self, context: PageContext, store: Store) -> None:
        self._context, self._store = context, store
        self.running = False

    async def show(self, request: Request) -> Response:
        """Show the form."""
        return self._context.render(request, "export.html", here="export", problem="")

    async def make(self, request: Request) -> Response:
        """Create an export and send it."""
        sent = await self._context.read_submission(request, self._refuse)
        if isinstance(sent, Response):
            return sent
        _, fields = sent
        if self.running:
            return self._refuse(request, "Another export is in progress.", 409)
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
        what = "with simulated participants" if fields.get("simulated") == "yes" else "people alone"
        await self._store.write(lambda c: note(c, request, "exported", what))
        day = time.strftime("%Y-%m-%d", time.gmtime())
        return FileResponse(
            packed, media_type="application/zip", headers=dict(HEADERS),
            filename=f"{file_name(self._context.study)}-{day}.zip",
            background=BackgroundTask(shutil.rmtree, folder, ignore_errors=True),
        )  # fmt: skip

    async def _pack(self, folder: Path, simulated: bool) -> Path:
        """Create the zip file in a separate process."""
        process = StatisticsProcess(self._context.study, self._context.url, EXPORT_TIMEOUT)
        try:
            packed: Path = await process.query("export", folder=folder, simulated=simulated)
        finally:
            await run_in_threadpool(process.close)
        return packed

    def _refuse(self, request: Request, problem: str, status: int) -> Response:
        """Show the form again with a message."""
        return self._context.render(request, "export.html", status, here="export", problem=problem)
