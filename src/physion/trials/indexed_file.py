"""Files of trials, each checked against its SHA-256 in the index before it is used."""

from __future__ import annotations

import hashlib
import stat
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from physion.digests import file_sha256
from physion.errors import BadInputError
from physion.plain_files import read_plain

MAX_FILE_BYTES = 1 << 33
"""Largest file of a trial that is read: all passes of 600 frames of 512 pixels take 2 GB."""


@dataclass(frozen=True, slots=True)
class IndexedFile:
    """File of a trial with its SHA-256 according to the index.

    Without ``verify`` its content is not compared with the SHA-256.
    """

    trial: str
    path: Path
    sha256: str
    verify: bool = True

    def check(self) -> None:
        """Raise `BadInputError` unless the file has its SHA-256.

        A file of one size and time of change is read once in a process.
        """
        try:
            status = self.path.stat()
            if not stat.S_ISREG(status.st_mode):
                raise BadInputError(f"trial {self.trial!r}: {self.path} is not a regular file")
            if self.verify:
                _check_once(self, status.st_size, status.st_mtime_ns)
        except OSError as error:
            raise BadInputError(
                f"trial {self.trial!r}: {self.path} is missing or cannot be read: {error.strerror}"
            ) from error

    def read(self) -> bytes:
        """Return the content; raise `BadInputError` as `check` does."""
        try:
            content = read_plain(self.path, MAX_FILE_BYTES, follow_links=True)
        except BadInputError as error:
            raise BadInputError(f"trial {self.trial!r}: {error}") from error
        if self.verify and hashlib.sha256(content).hexdigest() != self.sha256:
            raise self._changed()
        return content

    def _changed(self) -> BadInputError:
        return BadInputError(
            f"trial {self.trial!r}: {self.path} was changed since it was made: it does not have "
            "the SHA-256 of the index; make the trial again, or check the dataset with physion "
            "verify"
        )


@cache
def _check_once(file: IndexedFile, size: int, modified: int) -> None:
    """Check a file of this size and time of change; errors are not remembered."""
    if file_sha256(file.path) != file.sha256:
        raise file._changed()
