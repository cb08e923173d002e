"""A server process of one's own for a while: for simulations, load tests and crash tests."""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import httpx2

from physion.errors import PhysionError

HOST = "127.0.0.1"
POLL_S = 0.02


class OwnServer:
    """``physion experiment serve`` in a process of its own, on a free port of this machine alone.

    As a context manager it starts, waits until the server answers, and stops it in the end.
    ``database``: its URL; the study's SQLite file where none is given. ``options``: more words of
    ``serve``. ``command``: other words in place of ``python -m physion.cli.main``, for profilers.
    """

    def __init__(
        self,
        folder: Path,
        database: str | None = None,
        options: Sequence[str] = (),
        command: Sequence[str] = (sys.executable, "-m", "physion.cli.main"),
    ) -> None:
        self.port = _free_port()
        self.url = f"http://{HOST}:{self.port}"
        words = ["experiment", "serve", str(folder), "--host", HOST, "--port", str(self.port)]
        words += [] if database is None else ["--database", database]
        self._command = [*command, *words, *options]
        self._process: subprocess.Popen[bytes] | None = None
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as this object

    @property
    def pid(self) -> int:
        """Process number of the running server."""
        assert self._process is not None, "the server was not started"
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Is the process alive?"""
        return self._process is not None and self._process.poll() is None

    def start(self, patience_s: float = 60.0) -> float:
        """Start, wait until the server answers; returns the seconds that it took.

        Raises `PhysionError` with the server's last words where it ends or stays silent.
        """
        begin = time.monotonic()
        self.launch()
        assert self._process is not None
        with httpx2.Client(base_url=self.url, trust_env=False, timeout=5.0) as client:
            while time.monotonic() - begin < patience_s:
                if self._process.poll() is not None:
                    raise PhysionError(f"the server ended at once: {self.last_words()}")
                try:
                    if client.get("/api/health").is_success:
                        return time.monotonic() - begin
                except httpx2.TransportError:
                    pass
                time.sleep(POLL_S)
        self.kill()
        raise PhysionError(f"the server did not answer in {patience_s:g} s: {self.last_words()}")

    def launch(self) -> None:
        """Start the process and wait for nothing."""
        self._process = self._new_process()

    def _new_process(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=self._said, stderr=self._said
        )

    def stop(self, patience_s: float = 30.0) -> int:
        """Ask the server to finish and wait; killed where it does not. Returns its exit code."""
        if self._process is None:
            return 0
        self._process.terminate()
        try:
            return self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            return self.kill()

    def kill(self) -> int:
        """End the server at once, as by kill -9. Returns its exit code."""
        if self._process is None:
            return 0
        self._process.kill()
        return self._process.wait()

    def last_words(self) -> str:
        """The end of what the server printed."""
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        return "\n".join(lines[-20:]) or "it said nothing"

    def __enter__(self) -> OwnServer:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.stop()
        self._said.close()


def _free_port() -> int:
    with socket.socket() as found:
        found.bind((HOST, 0))
        return int(found.getsockname()[1])
