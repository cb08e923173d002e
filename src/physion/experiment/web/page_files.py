"""Static files of the pages: read once from the package, then served from memory by exact name.

Requests are looked up among the files found at startup, so no path of a client reaches the file
system.
"""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from pathlib import Path

from starlette.requests import Request
from starlette.responses import Response

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
        etag=f'"{hashlib.sha256(content).hexdigest()[:32]}"',
    )


def read_page_files(folder: Path) -> dict[str, PageFile]:
    """Read all servable files below a folder; keys are relative paths with slashes."""
    return {
        path.relative_to(folder).as_posix(): read_page_file(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink() and path.suffix in MEDIA_TYPES
    }
