"""The server process: start, printed address, shutdown without data loss, one-line errors."""

from __future__ import annotations

import contextlib
import http.client
import ipaddress
import json
import re
import signal
import socket
import ssl
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from physion.analysis.people.exclusions import RULE_SETS
from physion.cli.experiment import serve
from physion.cli.main import main
from physion.experiment.server import Address
from physion.experiment.study.identity import Secrets, check_password
from physion.experiment.study.settings import StudySettings
from physion.experiment.study.study import Study
from support.experiment.app_walk import answer_body, served
from support.experiment.live_app import HOST, read_all, running
from support.experiment.tiny_study import PASSWORD, make_tiny_study
from support.paths import ROOT
from support.programs import find_program


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    folder = tmp_path_factory.mktemp("server") / "study"
    return make_tiny_study(folder, familiarization=1, test=3, size=64)


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A self-signed certificate for localhost, and its key."""
    openssl = find_program("openssl")
    folder = tmp_path_factory.mktemp("https")
    certificate, key = folder / "cert.pem", folder / "key.pem"
    subprocess.run(
        [openssl, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj",
         "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1",
         "-keyout", key, "-out", certificate],
        check=True, capture_output=True,
    )  # fmt: skip
    return certificate, key


@dataclass
class Process:
    """A server process and the address that it printed."""

    process: subprocess.Popen[str]
    said: dict[str, str]

    @property
    def port(self) -> int:
        return int(self.said["address"].rpartition(":")[2])

    def end(self, number: signal.Signals) -> tuple[int, str]:
        """Send a signal and return the exit code and standard error."""
        self.process.send_signal(number)
        _, errors = self.process.communicate(timeout=120)
        return self.process.returncode, errors


@contextlib.contextmanager
def started(folder: Path, *words: str) -> Iterator[Process]:
    command = [sys.executable, "-m", "physion.cli.main", "experiment", "serve", str(folder),
               "--port", "0", "--json", *words]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, process.communicate(timeout=120)[1]
        yield Process(process, json.loads(line))
    finally:
        process.kill()
        process.communicate(timeout=120)


def ask(port: int, method: str, path: str, body: Any = None, token: str = "") -> Any:
    connection = http.client.HTTPConnection(HOST, port, timeout=30)
    headers = {"content-type": "application/json", "authorization": f"Bearer {token}"}
    connection.request(method, path, None if body is None else json.dumps(body), headers)
    return json.loads(connection.getresponse().read())


@pytest.mark.nightly
@pytest.mark.slow
def test_stopping_finishes_requests_and_keeps_every_answer(study: Study) -> None:
    with started(study.folder) as server:
        entered = ask(server.port, "POST", "/api/enter", {})
        token = entered["token"]
        for name, data in (("consent", {"agreed": True}), ("instructions", {})):
            state = ask(server.port, "POST", "/api/page", {"page": name, "data": data}, token)
        assert state["stage"] == "familiarization"
        body = json.dumps(answer_body(0, "familiarization")).encode()
        lines = ["POST /api/answers HTTP/1.1", "Host: x", f"Authorization: Bearer {token}"]
        lines += ["Content-Type: application/json", f"Content-Length: {len(body)}", "", ""]
        head = "\r\n".join(lines)
        with (
            socket.create_connection((HOST, server.port), timeout=30) as idle,
            socket.create_connection((HOST, server.port), timeout=30) as connection,
        ):
            idle.sendall(b"GET /api/health HTTP/1.1\r\nHost: x\r\n\r\n")
            heard = b""
            while not heard.endswith(b'{"ok":true}'):
                heard += idle.recv(65536)
            assert heard.startswith(b"HTTP/1.1 200")
            connection.sendall(head.encode() + body[:10])
            ended: list[tuple[int, str]] = []
            thread = threading.Thread(target=lambda: ended.append(server.end(signal.SIGTERM)))
            thread.start()
            assert read_all(idle) == b"", "idle connections end at once"
            connection.sendall(body[10:])
            answer = read_all(connection)
            thread.join(30)
    assert answer.startswith(b"HTTP/1.1 200") and b'"duplicate":false' in answer
    assert ended == [(0, "")]
    # A second server finds no stale files, and the answer is stored.
    with started(study.folder) as server:
        assert ask(server.port, "GET", "/api/session", token=token)["stage"] == "ready"
        assert server.end(signal.SIGINT) == (0, "")


@pytest.mark.slow
def test_https_and_printed_url(study: Study, certificate: tuple[Path, Path]) -> None:
    words = ("--https-cert", str(certificate[0]), "--https-key", str(certificate[1]),
             "--log-requests", "--host", "127.0.0.1")  # fmt: skip
    with started(study.folder, *words) as server:
        assert server.said["address"] == f"https://127.0.0.1:{server.port}"
        assert server.said["experimenter"] == f"{server.said['address']}/experimenter"
        context = ssl.create_default_context(cafile=certificate[0])
        connection = http.client.HTTPSConnection(HOST, server.port, timeout=30, context=context)
        connection.request("GET", "/?PROLIFIC_PID=5f0c")
        answer = connection.getresponse()
        assert answer.status == 200 and b"<!doctype html>" in answer.read()
        assert answer.getheader("strict-transport-security") == "max-age=31536000"
        assert answer.getheader("server") is None
        connection.close()
        code, errors = server.end(signal.SIGTERM)
    assert code == 0
    assert "GET / 200" in errors and "5f0c" not in errors


@pytest.mark.parametrize("trusted", [True, False])
def test_only_named_proxies_are_trusted(tmp_path: Path, trusted: bool) -> None:
    proxies = ["127.0.0.1"] if trusted else ["10.0.0.1"]
    settings = {"proxy_headers": True, "forwarded_allow_ips": proxies}
    with (
        served(tmp_path / "s", familiarization=1, test=1) as site,
        running(site.client.app, **settings) as port,
    ):
        connection = http.client.HTTPConnection(HOST, port, timeout=30)
        headers = {"content-type": "application/json", "x-forwarded-for": "1.1.1.1",
                   "x-forwarded-proto": "https"}  # fmt: skip
        connection.request("POST", "/api/enter", "{}", headers)
        answer = connection.getresponse()
        assert answer.status == 200
        assert (answer.getheader("strict-transport-security") is not None) == trusted


def serve_badly(capsys: pytest.CaptureFixture[str], folder: Path, *words: str) -> str:
    """Return the one line of a server that cannot start."""
    assert main(["experiment", "serve", str(folder), *words]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1 and printed.err.startswith("physion: ")
    return printed.err


def test_a_port_in_use_is_named(study: Study, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server((HOST, 0)) as taken:
        port = str(taken.getsockname()[1])
        error = serve_badly(capsys, study.folder, "--port", port)
    assert f"cannot listen on 127.0.0.1 port {port}: Address already in use;" in error


@pytest.mark.parametrize(
    ("words", "said"),
    [
        *((f"--host {host} --port 0 --behind-proxy 10.0.0.1", f"cannot listen on {host} port 0")
          for host in ("no.such.host.invalid", "256.1.1.1", "203.0.113.7")),
        *((f"--port={port}", f"--port must be from 0 to 65535, not {port}")
          for port in ("80000", "65536", "-1")),
        ("--https-cert WRONG", "belong together"),
        ("--https-cert WRONG --https-key WRONG --port 0", "certificate WRONG"),
        ("--https-cert MISSING --https-key MISSING --port 0", "certificate MISSING"),
        ("--behind-proxy proxy.example.org", "--behind-proxy"),
        ("--behind-proxy *", "--behind-proxy"),
        ("--behind-proxy=", "--behind-proxy"),
    ],
)  # fmt: skip
def test_bad_options_are_one_line(
    study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, said: str
) -> None:
    (tmp_path / "wrong.pem").write_text("no certificate")
    for name in ("wrong", "missing"):
        path = str(tmp_path / f"{name}.pem")
        words, said = words.replace(name.upper(), path), said.replace(name.upper(), path)
    assert said in serve_badly(capsys, study.folder, *words.split())


def test_a_folder_without_a_study_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    said = serve_badly(capsys, tmp_path)
    assert "this is not a study folder; create one with physion experiment init" in said
    assert main(["experiment", "serve", str(tmp_path), "--host", "0.0.0.0"]) == 2
    assert "sent unencrypted" in capsys.readouterr().err


@pytest.mark.parametrize(("address", "readable"), [
    (Address(), False),
    (Address("localhost"), False),
    (Address("::1"), False),
    (Address("0.0.0.0"), True),
    (Address("192.0.2.1"), True),
    (Address("lab.example.org"), True),
    (Address("0.0.0.0", proxies=("10.0.0.1",)), False),
    (Address("0.0.0.0", certificate=Path("c"), key=Path("k")), False),
])  # fmt: skip
def test_unencrypted_addresses(address: Address, readable: bool) -> None:
    assert address.is_readable_on_the_way() == readable


def test_a_new_password_is_the_first_line_of_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, file = make_tiny_study(tmp_path / "s", familiarization=1, test=1).folder, tmp_path / "p"
    before = Secrets.load(folder)
    words = ["experiment", "serve", str(folder), "--password-file", str(file), "--port=-1"]
    for content in (b"", b"short\n", b"\xff\xff\xff\xff\xff\xff\xff\xff\xff"):
        file.write_bytes(content)
        assert main(words) == 2 and str(file) in capsys.readouterr().err
    assert Secrets.load(folder) == before
    file.write_text("another password \nnot this\n")
    assert main(words) == 2 and "--port" in capsys.readouterr().err
    after = Secrets.load(folder)
    assert check_password(after, "another password") and not check_password(after, PASSWORD)
    assert (after.hash_key, after.link_key) == (before.hash_key, before.link_key)


SLOW_TO_IMPORT = ("sklearn", "statsmodels", "matplotlib", "numba", "mujoco", "torch")


def test_rules_match_the_analysis() -> None:
    allowed = get_type_hints(StudySettings)["exclusions"]
    assert tuple(RULE_SETS) == get_args(allowed)


@pytest.mark.slow
def test_serving_imports_nothing_slow() -> None:
    found = f"[name for name in {SLOW_TO_IMPORT} if name in sys.modules]"
    code = f"import sys, physion.experiment.server; print({found})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


SERVER = ROOT / "examples" / "server"


def options_of(command: list[str]) -> dict[str, str]:
    """Return the options of a command by the names of the fields of `serve.Options`."""
    assert command[:2] == ["serve", "/study"] and len(command) % 2 == 0
    pairs = zip(command[2::2], command[3::2], strict=True)
    return {name.removeprefix("--").replace("-", "_"): value for name, value in pairs}


def test_the_image_is_built_from_what_is_there() -> None:
    """The example of a server: Docker builds what is here, and starts what serve accepts."""
    yaml = pytest.importorskip("yaml")
    compose = yaml.safe_load((SERVER / "compose.yaml").read_text())
    study, proxy = compose["services"]["study"], compose["services"]["proxy"]
    defaults = {field.name: field.default for field in fields(serve.Options)}
    options = options_of(study["command"])
    assert set(options) <= set(defaults)
    subnet = compose["networks"]["default"]["ipam"]["config"][0]["subnet"]
    assert ipaddress.ip_network(options["behind_proxy"]) == ipaddress.ip_network(subnet)
    assert study["volumes"][0].endswith(":/study") and "ports" not in study
    target = re.search(r"reverse_proxy (\w+):(\d+)", (SERVER / "Caddyfile").read_text())
    assert target is not None
    assert target[1] in compose["services"] and int(target[2]) == defaults["port"]
    assert proxy["volumes"][0].startswith("./Caddyfile:")
    text = (SERVER / study["build"]["context"] / study["build"]["dockerfile"]).resolve().read_text()
    for line in re.findall(r"^COPY (.*)", text, re.MULTILINE):
        for name in line.split()[:-1]:
            assert (ROOT / name).exists(), name
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    version = re.search(r"FROM python:([\d.]+)", text)
    assert version is not None and project["requires-python"] == f">={version[1]}"
    assert set(re.findall(r"\.\[(\w+)\]", text)) <= set(project["optional-dependencies"])
    entry = json.loads(re.findall(r"ENTRYPOINT (.*)", text)[0])
    assert entry[0] in project["scripts"] and entry[1:] == ["experiment"]
    assert set(options_of(json.loads(re.findall(r"^CMD (.*)", text, re.MULTILINE)[0]))) == {"host"}
