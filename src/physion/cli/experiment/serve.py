"""Run the web server of a study, for participants and the experimenter, until it is stopped.

SIGTERM and Ctrl+C stop it after the current requests. Every acknowledged answer is on disk.
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
    """Options of ``physion experiment serve``."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    host: str = "127.0.0.1"
    """IP address to listen on; 0.0.0.0 for all."""
    port: int = 8000
    """Port to listen on; 0 for any free port."""
    base_url: str = ""
    """Public root URL of the server, if it differs (behind a proxy)."""
    behind_proxy: tuple[str, ...] = ()
    """Addresses or networks of proxies whose X-Forwarded-For and -Proto headers are trusted."""
    https_cert: Path | None = None
    """Certificate chain (PEM), to serve https without a proxy."""
    https_key: Path | None = None
    """Private key of the certificate (PEM)."""
    password_file: Path | None = None
    """File with a new password of the experimenter's pages in its first line. (There is no option
    for the password itself, since other users of the machine can see command lines.)"""
    log_requests: bool = False
    """Log method, path and status of each request to standard error, without ids."""
    json: bool = False
    """Print the URLs as one JSON object."""


def main(options: Options) -> int:
    """Serve until stopped; return exit status 0."""
    from physion.experiment.server import Address, serve
    from physion.experiment.study.identity import read_password, set_password

    if options.password_file is not None:
        set_password(options.study, read_password(options.password_file))
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
            "warning: answers and ids are sent unencrypted; give --https-cert and --https-key, or "
            "use a proxy with https and name it by --behind-proxy"
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

    serve(options.study, address, options.log_requests, say, warn)
    return 0
