"""Serve movies and maps, and the static files of the pages.

Responses with media have no ETag, file date, file name or ranges, so two movies differ only in
their bytes. Static files are read once from the package and looked up by exact name, so no path of
a client reaches the file system.
"""

from __future__ import annotations

import gzip
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from physion.core.files import digest_of, read_plain

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


PACKAGE = Path(__file__).parents[1]
MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".txt": "text/plain; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".webp": "image/webp",
    ".woff2": "font/woff2",
    ".mp4": "video/mp4",
}
"""Media types by suffix; files with other suffixes are not served."""
COMPRESSED = (".html", ".js", ".css", ".json", ".svg", ".txt")


@dataclass(frozen=True)
class PageFile:
    """One static file. ``packed`` is the gzipped content, None if compression saves too little."""

    content: bytes
    packed: bytes | None
    media_type: str
    etag: str

    def response(self, request: Request) -> Response:
        """Return the file, or 304 if the browser's copy is current; it revalidates every time."""
        headers = {"etag": self.etag, "cache-control": "no-cache", "vary": "accept-encoding"}
        if request.headers.get("if-none-match") == self.etag:
            return Response(status_code=304, headers=headers)
        headers["content-type"] = self.media_type
        content = self.content
        if self.packed is not None and "gzip" in request.headers.get("accept-encoding", ""):
            content = self.packed
            headers["content-encoding"] = "gzip"
        return Response(content, headers=headers)


def read_page_file(path: Path) -> PageFile:
    """Read one file, whose suffix must be one of `MEDIA_TYPES`."""
    content = path.read_bytes()
    packed = gzip.compress(content, 9, mtime=0) if path.suffix in COMPRESSED else content
    return PageFile(
        content=content,
        packed=packed if len(packed) < 0.9 * len(content) else None,
        media_type=MEDIA_TYPES[path.suffix],
        etag=f'"{digest_of(content)[:32]}"',
    )


def read_page_files(folder: Path) -> dict[str, PageFile]:
    """Read all servable files below a folder; keys are relative paths with slashes."""
    return {
        path.relative_to(folder).as_posix(): read_page_file(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink() and path.suffix in MEDIA_TYPES
    }
