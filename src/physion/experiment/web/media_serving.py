"""Serve movies and maps without metadata that could reveal the stimulus.

Responses have no ETag, file date, file name or ranges, so two movies differ only in their bytes.
"""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from physion.core.files import read_plain

MAX_MEDIA_BYTES = 64 * 2**20
"""Size limit of one movie or map."""
CACHE_BYTES = 256 * 2**20
"""Size of the cache in memory."""
TYPES = {".mp4": "video/mp4", ".png": "image/png"}


class MediaFiles:
    """In-memory LRU cache of media files.

    File names are derived from the content, so a cached file is never out of date.
    """

    def __init__(self, most: int = CACHE_BYTES) -> None:
        self._most = most
        self._size = 0
        self._kept: OrderedDict[Path, bytes] = OrderedDict()

    async def response(self, path: Path) -> Response:
        """Return a response with the file, which the participant's browser may cache.

        Raises
        ------
        BadInputError
            The file is missing, a symbolic link, or too large.
        """
        content = self._kept.get(path)
        if content is None:
            content = await run_in_threadpool(read_plain, path, MAX_MEDIA_BYTES)
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
        """Cache a file and evict the least recently used ones."""
        if path in self._kept or len(content) > self._most:
            return
        self._kept[path] = content
        self._size += len(content)
        while self._size > self._most:
            _, evicted = self._kept.popitem(last=False)
            self._size -= len(evicted)
