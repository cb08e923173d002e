"""PostgreSQL server for tests: the one of $PHYSION_POSTGRES, or a temporary one.

The temporary server has its data in a temporary folder, listens on the loopback interface only and
ends with the tests. It is as durable as a real one (fsync on). Without PostgreSQL's programs the
tests that need it are skipped.
"""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.engine import make_url

from support.programs import absent

USER = "postgres"


class Cluster:
    """A temporary server that tests of lost connections can stop and start again."""

    def __init__(self, folder: Path, programs: Path) -> None:
        self._folder, self._programs = folder, programs
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.url = f"postgresql://{USER}@127.0.0.1:{self.port}/postgres"
        self._run("initdb", "-A", "trust", "-U", USER, "-E", "UTF8", "--locale=C", "-N")
        with (folder / "data" / "postgresql.conf").open("a") as settings:
            settings.write("fsync = on\nsynchronous_commit = on\nmax_connections = 50\n")

    def start(self) -> None:
        """Start the server and wait until it accepts connections."""
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -k {self._folder}"
        self._run(
            "pg_ctl", "start", "-w", "-t", "300", "-l", str(self._folder / "log"), "-o", options
        )

    def stop(self, mode: str = "fast") -> None:
        """Stop the server; mode ``immediate`` acts like a crash."""
        self._run("pg_ctl", "stop", "-w", "-t", "300", "-m", mode)

    def _run(self, program: str, *words: str) -> None:
        command = [str(self._programs / program), "-D", str(self._folder / "data"), *words]
        if os.geteuid() == 0:  # the server refuses to run as root
            command = ["runuser", "-u", USER, "--", *command]
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            cwd=self._folder, check=False, timeout=330,
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError(f"{program}: {done.stdout.decode(errors='replace')[-2000:]}")


def _programs() -> Path | None:
    found = shutil.which("initdb")
    if found and shutil.which("pg_ctl"):
        return Path(found).parent
    versions = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return versions[-1].parent if versions else None


def _has_user() -> bool:
    try:
        pwd.getpwnam(USER)
    except KeyError:
        return False
    return shutil.which("runuser") is not None


@pytest.fixture(scope="session")
def postgres_cluster() -> Iterator[Cluster]:
    """A running temporary server."""
    programs = _programs()
    if programs is None:
        absent("PostgreSQL is absent: install it, or set PHYSION_POSTGRES to a server's URL")
    if os.geteuid() == 0 and not _has_user():
        absent("PostgreSQL does not run as root, and there is no user postgres")
    # Not below pytest's folder, which the user postgres cannot enter. initdb creates `data`.
    folder = Path(tempfile.mkdtemp(prefix="physion-postgres-"))
    try:
        if os.geteuid() == 0:
            shutil.chown(folder, USER)
        cluster = Cluster(folder, programs)
        cluster.start()
        try:
            yield cluster
        finally:
            cluster.stop("immediate")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def postgres_url(request: pytest.FixtureRequest) -> str:
    """URL of a server on which tests can create databases."""
    named = os.environ.get("PHYSION_POSTGRES")
    if named:
        return named
    cluster: Cluster = request.getfixturevalue("postgres_cluster")
    return cluster.url


def _fresh(server: str) -> Iterator[str]:
    admin = create_engine(
        make_url(server).set(drivername="postgresql+psycopg"), isolation_level="AUTOCOMMIT"
    )
    name = f"physion_test_{uuid4().hex}"
    with admin.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    try:
        yield make_url(server).set(database=name).render_as_string(hide_password=False)
    finally:
        # Dropping takes half a second; a temporary server is deleted as a whole.
        if os.environ.get("PHYSION_POSTGRES"):
            with admin.connect() as connection:
                connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
        admin.dispose()


@pytest.fixture
def fresh_postgres(postgres_url: str) -> Iterator[str]:
    """URL of an empty PostgreSQL database."""
    yield from _fresh(postgres_url)


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of an empty database, parametrised over both kinds."""
    if request.param == "sqlite":
        (tmp_path / "database").mkdir()
        return f"sqlite:///{tmp_path / 'database' / 'responses.sqlite'}"
    url: str = request.getfixturevalue("fresh_postgres")
    return url
