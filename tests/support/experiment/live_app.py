"""Run an application on a real server in a thread, and send raw bytes to it."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import uvicorn

HOST = "127.0.0.1"


@contextlib.contextmanager
def running(app: Any, **settings: Any) -> Iterator[int]:
    """Serve ``app`` with the package's server settings on a free port, and yield the port."""
    given = {"ws": "none", "lifespan": "off", "log_config": None,
             "access_log": False, "server_header": False, "proxy_headers": False}  # fmt: skip
    server = uvicorn.Server(uvicorn.Config(app, **{**given, **settings}))
    with socket.create_server((HOST, 0)) as listening:
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        while not server.started:
            time.sleep(0.005)
        try:
            yield int(listening.getsockname()[1])
        finally:
            server.should_exit = True
            thread.join(20)


def exchange(port: int, *parts: bytes, patience: float = 10.0) -> bytes:
    """Send raw bytes and return the response until the server closes or is silent."""
    with socket.create_connection((HOST, port), timeout=patience) as connection:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            for part in parts:
                connection.sendall(part)
        return read_all(connection)


def read_all(connection: socket.socket, silence: float = 2.0) -> bytes:
    """Read until the other side closes or sends nothing for ``silence`` seconds."""
    received = b""
    while True:
        connection.settimeout(silence if received else 30.0)
        try:
            more = connection.recv(65536)
        except (TimeoutError, ConnectionResetError):
            return received
        if not more:
            return received
        received += more
