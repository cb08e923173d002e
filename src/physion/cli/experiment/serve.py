"""Serve a study to participants, and the experimenter's pages, until it is stopped.

SIGTERM and Ctrl+C end it after the requests in work; every acknowledged answer is on the disk.
"""

from __future__ import annotations

import json as json_module
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Options:
    """What to serve, and where."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for all."""
    port: int = 8000
    """Port to listen on; 0 takes a free one."""
    database: str | None = None
    """URL of a PostgreSQL database; responses.sqlite in the folder if not given."""
    base_url: str = ""
    """Address by which people reach the server, where it differs (behind a proxy)."""
    behind_proxy: tuple[str, ...] = ()
    """Addresses or networks of proxies, whose X-Forwarded-For and -Proto are believed."""
    https_cert: Path | None = None
    """Certificate chain (PEM), to serve https without a proxy."""
    https_key: Path | None = None
    """Its private key (PEM)."""
    log_requests: bool = False
    """Write a line for each request to standard error: method, path and status, no ids."""
    json: bool = False
    """Say where it serves as one JSON object."""


def main(options: Options) -> int:
    """Serve; 0 after a stop that was asked for."""
    from physion.cli.experiment.experiment import require_extra

    require_extra()
    from physion.experiment.server import Address, serve

    address = Address(
        options.host,
        options.port,
        options.base_url,
        options.behind_proxy,
        options.https_cert,
        options.https_key,
    )

    def warn(line: str) -> None:
        print(f"physion: {line}", file=sys.stderr, flush=True)

    if address.is_readable_on_the_way():
        warn(
            "warning: answers and ids travel unencrypted; give --https-cert and --https-key, or "
            "put a proxy with https in front and name it by --behind-proxy"
        )

    def say(url: str) -> None:
        pages = f"{url}/experimenter"
        if options.json:
            print(json_module.dumps({"address": url, "experimenter": pages}), flush=True)
            return
        print(f"study:        {url}")
        print(f"experimenter: {pages}")
        print(
            f"links:        physion experiment links {options.study} --base-url {url}", flush=True
        )

    serve(options.study, address, options.database, options.log_requests, say, warn)
    return 0
