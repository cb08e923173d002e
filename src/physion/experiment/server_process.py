"""A temporary server process, for simulations, load tests and crash tests."""

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

from physion.core.errors import PhysionError

HOST = "127.0.0.1"
POLL_S = 0.02


class ServerProcess:
    """``physion experiment serve`` in its own process, on a free port of the loopback interface.

    As a context manager it starts the server, waits until it answers, and stops it at the end.

    Parameters
    ----------
    folder
        The study folder.
    options
        Further command line options of ``serve``.
    command
        Replacement for ``python -m physion.cli.main``, e.g. to run it under a profiler.
    """

    def __init__(
        self,
        folder: Path,
        options: Sequence[str] = (),
        command: Sequence[str] = (sys.executable, "-m", "physion.cli.main"),
    ) -> None:
        self.port = _free_port()
        self.url = f"http://{HOST}:{self.port}"
        arguments = ["experiment", "serve", str(folder), "--host", HOST, "--port", str(self.port)]
        self._command = [*command, *arguments, *options]
        self._process: subprocess.Popen[bytes] | None = None
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as this object

    @property
    def pid(self) -> int:
        """Process id of the running server."""
        assert self._process is not None, "the server was not started"
        return self._process.pid

    def start(self, patience_s: float = 60.0) -> float:
        """Start the server, wait until it answers, and return the seconds that this took.

        Raises
        ------
        PhysionError
            The server ended, or did not answer within ``patience_s``; with the end of its output.
        """
        begin = time.monotonic()
        self.launch()
        assert self._process is not None
        with httpx2.Client(base_url=self.url, trust_env=False, timeout=5.0) as client:
            while time.monotonic() - begin < patience_s:
                if self._process.poll() is not None:
                    raise PhysionError(f"the server ended at once: {self.last_output()}")
                try:
                    if client.get("/api/health").is_success:
                        return time.monotonic() - begin
                except httpx2.TransportError:
                    pass
                time.sleep(POLL_S)
        self.kill()
        raise PhysionError(
            f"the server did not answer within {patience_s:g} s: {self.last_output()}"
        )

    def launch(self) -> None:
        """Start the process without waiting for it."""
        self._process = self._new_process()

    def _new_process(self) -> subprocess.Popen[bytes]:
        """Start the server process; tests override this."""
        return subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=self._output, stderr=self._output
        )

    def stop(self, patience_s: float = 30.0) -> int:
        """Ask the server to stop, kill it after ``patience_s``, and return its exit code."""
        if self._process is None:
            return 0
        self._process.terminate()
        try:
            return self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            return self.kill()

    def kill(self) -> int:
        """Kill the server (SIGKILL) and return its exit code."""
        if self._process is None:
            return 0
        self._process.kill()
        return self._process.wait()

    def last_output(self) -> str:
        """Return the last 20 lines that the server printed."""
        self._output.seek(0)
        lines = self._output.read().decode(errors="replace").strip().splitlines()
        return "\n".join(lines[-20:]) or "it printed nothing"

    def __enter__(self) -> ServerProcess:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.stop()
        self._output.close()


def _free_port() -> int:
    """Return a free TCP port."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])
