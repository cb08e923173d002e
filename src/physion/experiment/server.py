"""Server process of one study: open the database, listen, and shut down without data loss."""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import signal
import socket
import ssl
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import uvicorn
from fastapi import FastAPI

from physion.core.errors import BadInputError
from physion.experiment.app import build_app
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media import check_media
from physion.experiment.study.recruitment import start_warnings
from physion.experiment.study.study import load_study

STOP_SECONDS = 5
"""Time that running requests and open connections get to end when the server shuts down."""
KEEP_ALIVE_SECONDS = 75
"""Longer than a trial, so that a participant's browser can reuse its connection."""
OPEN_FILES = 65_536
"""Wanted limit on open files (each connection is one), within the system's hard limit."""


@dataclass(frozen=True)
class Address:
    """Where the server listens and under which URL participants reach it.

    Parameters
    ----------
    host, port
        Address and port to listen on. Port 0 lets the system choose a free one.
    base_url
        Public URL of the study; empty if it is the listening address itself.
    proxies
        Addresses or networks of reverse proxies whose X-Forwarded-* headers are trusted.
    certificate, key
        PEM files for HTTPS; both or neither.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    base_url: str = ""
    proxies: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None

    @property
    def scheme(self) -> str:
        """URL scheme under which this process itself is reached, without a proxy."""
        return "http" if self.certificate is None else "https"

    def is_readable_on_the_way(self) -> bool:
        """Return whether requests cross the network unencrypted: no HTTPS and no proxy."""
        return self.certificate is None and not self.proxies and not _is_loopback(self.host)


def serve(
    folder: Path,
    address: Address,
    log_requests: bool = False,
    ready: Callable[[str], None] = lambda url: None,
    warn: Callable[[str], None] = lambda line: None,
) -> None:
    """Serve the study in ``folder`` until SIGTERM or SIGINT.

    Parameters
    ----------
    folder
        The study folder.
    address
        Where to listen.
    log_requests
        Also log every request (method, path and status).
    ready
        Called with the URL once the server accepts connections.
    warn
        Called with one line for each setting that should be filled in before people take part
        (`start_warnings`).

    Raises
    ------
    PhysionError
        The study does not exist or is invalid, the port is in use, the certificate is bad, or the
        database cannot be read or is used by another server.
    """
    _check_address(address)
    _set_logging(log_requests)
    study = load_study(folder)
    check_media(study)
    for line in start_warnings(study):
        warn(line)
    secrets = Secrets.load(folder)
    _allow_many_connections()
    with contextlib.closing(_listen(address)) as listening:
        port = int(listening.getsockname()[1])
        url = address.base_url.rstrip("/") or f"{address.scheme}://{_url_host(address.host)}:{port}"
        store = Store.open(study, secrets)
        try:
            app = build_app(study, secrets, store)
            server = _Server(_configure(app, address), lambda: ready(url))
            server.run(sockets=[listening])
        finally:
            store.close()


class _Server(uvicorn.Server):
    """Uvicorn server that reports when it is ready and returns, instead of exiting, on signals."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start listening, then call ``ready``."""
        await super().startup(sockets)
        self._ready()

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Let signals end the serving only.

        Uvicorn's own version raises the signal again afterwards, which would end the process before
        the store is closed.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {
            number: signal.signal(number, self._stop) for number in (signal.SIGTERM, signal.SIGINT)
        }
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        """Stop serving; a second SIGINT stops at once."""
        self.force_exit = self.should_exit and number == signal.SIGINT
        self.should_exit = True


def _configure(app: FastAPI, address: Address) -> uvicorn.Config:
    """Return uvicorn's configuration, with every feature off that the study does not need."""
    config = uvicorn.Config(
        app,
        ws="none",
        lifespan="on",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=bool(address.proxies),
        forwarded_allow_ips=list(address.proxies),
        timeout_keep_alive=KEEP_ALIVE_SECONDS,
        timeout_graceful_shutdown=STOP_SECONDS,
        ssl_certfile=address.certificate,
        ssl_keyfile=address.key,
    )
    try:
        config.load()
    except (OSError, ssl.SSLError) as error:
        reason = error.strerror or str(error)
        raise BadInputError(f"certificate {address.certificate}: {reason}") from error
    return config


def _listen(address: Address) -> socket.socket:
    """Open the listening socket."""
    try:
        resolved = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(resolved[4][:2], family=resolved[0], backlog=2048)
    except (OSError, UnicodeError) as error:
        number = error.errno if isinstance(error, OSError) else None
        reason = os.strerror(number) if number and number > 0 else error
        raise BadInputError(
            f"cannot listen on {address.host} port {address.port}: {reason}; "
            "another --port or --host may be free"
        ) from error


def _check_address(address: Address) -> None:
    """Raise `BadInputError` for an invalid port, certificate or proxy."""
    if not 0 <= address.port <= 65535:
        # The system would silently use the port modulo 65536.
        raise BadInputError(f"--port must be from 0 to 65535, not {address.port}")
    if (address.certificate is None) != (address.key is None):
        raise BadInputError("--https-cert and --https-key belong together; give both or none")
    for proxy in address.proxies:
        try:
            ipaddress.ip_network(proxy, strict=False)
        except ValueError as error:
            raise BadInputError(
                f"--behind-proxy {proxy!r}: not an IP address or network"
            ) from error


def _is_loopback(host: str) -> bool:
    """Return whether a host is the loopback interface."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _url_host(host: str) -> str:
    """Return the host as written in a URL; the loopback address if it listens on all addresses."""
    if host in ("", "0.0.0.0", "::"):
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


def _set_logging(log_requests: bool) -> None:
    """Log errors to standard error and, with ``log_requests``, every request without its query."""
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.WARNING)
    logging.getLogger("physion.experiment").setLevel(
        logging.INFO if log_requests else logging.WARNING
    )


def _allow_many_connections() -> None:
    """Raise the limit on open files towards `OPEN_FILES`.

    A browser opens up to six connections, so the usual limit of 1024 files is reached by 170
    people.
    """
    try:
        import resource
    except ImportError:  # Windows, which has no such limit
        return
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = OPEN_FILES if hard == resource.RLIM_INFINITY else min(OPEN_FILES, hard)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
