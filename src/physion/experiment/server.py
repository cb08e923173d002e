"""The server process of one study: opens the store, listens, stops without losing anything."""

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

from physion.errors import BadInputError
from physion.experiment.app import build_app
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media_checks import check_media
from physion.experiment.study.recruitment import undecided
from physion.experiment.study.study import load_study
from physion.experiment.web.connections import CarefulProtocol

STOP_SECONDS = 5
"""Requests in work, and browsers that do not let go, are given so long to end."""
KEEP_ALIVE_SECONDS = 75
"""Longer than a trial, so that a participant's browser keeps its connection."""
OPEN_FILES = 65_536


@dataclass(frozen=True)
class Address:
    """Where the server listens. ``proxies``: whose word on the client's address is believed."""

    host: str = "127.0.0.1"
    port: int = 8000
    base_url: str = ""
    proxies: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None

    @property
    def scheme(self) -> str:
        """By which this process itself is reached."""
        return "http" if self.certificate is None else "https"

    def is_readable_on_the_way(self) -> bool:
        """Would other people's requests travel in clear?"""
        return self.certificate is None and not self.proxies and not _is_loopback(self.host)


def serve(
    folder: Path,
    address: Address,
    database: str | None = None,
    log_requests: bool = False,
    ready: Callable[[str], None] = lambda url: None,
    warn: Callable[[str], None] = lambda line: None,
) -> None:
    """Serve the study in ``folder`` until SIGTERM or SIGINT. ``ready`` is told the address.

    ``warn`` is told, a line each, what should be filled in before people come (`undecided`).

    Raises:
        PhysionError: no such study, a fault in it, a port in use, a bad certificate, a database
            that cannot be reached or that another server uses.
    """
    _check(address)
    _set_logging(log_requests)
    study = load_study(folder)
    check_media(study)
    for line in undecided(study):
        warn(line)
    secrets = Secrets.load(folder)
    _allow_many_connections()
    with contextlib.closing(_listen(address)) as listening:
        port = int(listening.getsockname()[1])
        url = address.base_url.rstrip("/") or f"{address.scheme}://{_as_host(address.host)}:{port}"
        store = Store.open(study, secrets, database)
        try:
            app = build_app(study, secrets, store)
            server = _Server(_configure(app, address), lambda: ready(url))
            server.run(sockets=[listening])
        finally:
            store.close()


class _Server(uvicorn.Server):
    """Uvicorn's server, which says when it is ready and leaves the process alive in the end."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, then say so."""
        await super().startup(sockets)
        self._ready()

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Signals end the serving alone; uvicorn would kill us before the store is closed."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {one: signal.signal(one, self._stop) for one in (signal.SIGTERM, signal.SIGINT)}
        try:
            yield
        finally:
            for one, handler in before.items():
                signal.signal(one, handler)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.force_exit = self.should_exit and number == signal.SIGINT
        self.should_exit = True


def _configure(app: FastAPI, address: Address) -> uvicorn.Config:
    """The settings of uvicorn, with everything off that the study does not need."""
    config = uvicorn.Config(
        app,
        http=CarefulProtocol,
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
    try:
        found = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(found[4][:2], family=found[0], backlog=2048)
    except (OSError, UnicodeError) as error:
        number = error.errno if isinstance(error, OSError) else None
        reason = os.strerror(number) if number and number > 0 else error
        raise BadInputError(
            f"cannot listen on {address.host} port {address.port}: {reason}; "
            "another --port or --host may be free"
        ) from error


def _check(address: Address) -> None:
    if not 0 <= address.port <= 65535:
        # The system would take what is left of it by 65536.
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
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _as_host(host: str) -> str:
    """The host as part of an address; for all addresses, the one of this machine itself."""
    if host in ("", "0.0.0.0", "::"):
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


def _set_logging(log_requests: bool) -> None:
    """Faults go to standard error; requests, by path alone, where asked for."""
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.WARNING)
    logging.getLogger("physion.experiment").setLevel(
        logging.INFO if log_requests else logging.WARNING
    )


def _allow_many_connections() -> None:
    """A browser opens up to six connections; the usual limit of 1024 files ends at 170 people."""
    try:
        import resource
    except ImportError:  # not on this system, which has no such limit either
        return
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = OPEN_FILES if hard == resource.RLIM_INFINITY else min(OPEN_FILES, hard)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
