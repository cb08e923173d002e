"""The files of examples/server fit each other, the options of serve, and the repository."""

from __future__ import annotations

import ipaddress
import json
import re
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.cli.experiment import serve

ROOT = Path(__file__).parents[3]
SERVER = ROOT / "examples" / "server"
DEFAULTS = {field.name: field.default for field in fields(serve.Options)}


@pytest.fixture(scope="module")
def services() -> dict[str, Any]:
    yaml = pytest.importorskip("yaml")
    found: dict[str, Any] = yaml.safe_load((SERVER / "compose.yaml").read_text())
    subnet = found["networks"]["default"]["ipam"]["config"][0]["subnet"]
    return {**found["services"], "subnet": subnet}


def options_of(command: list[str]) -> dict[str, str]:
    """Return the options of a command by the names of the fields of `serve.Options`."""
    assert command[:2] == ["serve", "/study"] and len(command) % 2 == 0
    pairs = zip(command[2::2], command[3::2], strict=True)
    return {name.removeprefix("--").replace("-", "_"): value for name, value in pairs}


def test_the_command_is_one_that_serve_accepts(services: dict[str, Any]) -> None:
    options = options_of(services["study"]["command"])
    assert set(options) <= set(DEFAULTS)
    assert ipaddress.ip_network(options["behind_proxy"]) == ipaddress.ip_network(services["subnet"])
    assert services["study"]["volumes"][0].endswith(":/study")


def test_the_proxy_reaches_the_study(services: dict[str, Any]) -> None:
    target = re.search(r"reverse_proxy (\w+):(\d+)", (SERVER / "Caddyfile").read_text())
    assert target is not None
    assert target[1] in services and int(target[2]) == DEFAULTS["port"]
    assert services["proxy"]["volumes"][0].startswith("./Caddyfile:")
    assert "ports" not in services["study"]


def test_the_image_is_built_from_what_is_there(services: dict[str, Any]) -> None:
    built = services["study"]["build"]
    text = (SERVER / built["context"] / built["dockerfile"]).resolve().read_text()
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
