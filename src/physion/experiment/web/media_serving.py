"""Movies and maps by signed path: the bytes, their type, and nothing that tells more than they do.

The store signs the paths; which file a path means follows from study and session alone. No ETag, no
date of a file, no range, no name of a file: two movies differ by their bytes only.
"""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from physion.experiment.study.plain_files import read_plain

MOST_BYTES = 64 * 2**20
"""No movie or map of a study is larger."""
CACHE_BYTES = 256 * 2**20
TYPES = {".mp4": "video/mp4", ".png": "image/png"}


class MediaFiles:
    """Files of a study, kept in memory up to `CACHE_BYTES`; the least recently sent goes first.

    Their names are made of their content, so what is kept can never be out of date.
    """

    def __init__(self, most: int = CACHE_BYTES) -> None:
        self._most = most
        self._size = 0
        self._kept: OrderedDict[Path, bytes] = OrderedDict()

    async def response(self, path: Path) -> Response:
        """The file as a response that the browser of one person may keep.

        Raises:
            BadInputError: it is missing, a link, or too large.
        """
        content = self._kept.get(path)
        if content is None:
            content = await run_in_threadpool(read_plain, path, MOST_BYTES)
            self._keep(path, content)
        else:
            self._kept.move_to_end(path)
        headers = {
            "content-type": TYPES[path.suffix],
            "cache-control": "private, max-age=86400, immutable",
            "accept-ranges": "none",
        }
        return Response(content, headers=headers)

    def _keep(self, path: Path, content: bytes) -> None:
        if path in self._kept or len(content) > self._most:
            return
        self._kept[path] = content
        self._size += len(content)
        while self._size > self._most:
            _, gone = self._kept.popitem(last=False)
            self._size -= len(gone)
