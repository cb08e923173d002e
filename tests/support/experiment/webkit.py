"""WebKit for browser tests: the browser of Debian's WebKitGTK on a screen in memory.

It is driven by the WebDriver protocol (W3C, https://www.w3.org/TR/webdriver2/), since Playwright
drives only its own build of WebKit, which is not a package of Debian.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import httpx2
import pytest

from support.programs import find_program, find_webkit

PATIENCE_S = 60.0
POLL_S = 0.05
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
"""Key under which the protocol passes references to elements."""
FIND = """
const [selector, text] = arguments;
// Options of a closed list have no box of their own.
const visible = (element) => element.matches("option") || element.checkVisibility();
const wanted = (element) => visible(element) && element.textContent.includes(text);
return [...document.querySelectorAll(selector)].find(wanted) ?? null;
"""


@pytest.fixture
def webkit() -> Iterator[WebKit]:
    """A window of the browser, without the data of any other one."""
    driver, screen = find_webkit(), find_program("Xvfb")
    with started_screen(screen) as display, started_driver(driver, display) as address:
        window = WebKit(address)
        yield window
        window.close()


@contextlib.contextmanager
def started_screen(program: str) -> Iterator[str]:
    """Start an X server that draws into memory; give the name of its display."""
    mine, its = os.pipe()
    options = ["-displayfd", str(its), "-screen", "0", "1280x900x24", "-nolisten", "tcp"]
    with subprocess.Popen([program, *options], pass_fds=[its], stderr=subprocess.DEVNULL) as server:
        os.close(its)
        try:
            with os.fdopen(mine) as told:
                yield f":{told.readline().strip()}"
        finally:
            server.terminate()


@contextlib.contextmanager
def started_driver(program: str, display: str) -> Iterator[str]:
    """Start the driver, which starts the browser; give its address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = os.environ | {"DISPLAY": display}
    with subprocess.Popen([program, f"--port={port}"], env=environment) as driver:
        try:
            yield f"http://127.0.0.1:{port}"
        finally:
            driver.terminate()


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """Return the first value of ``condition`` that is true."""
    end = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert time.monotonic() < end, f"waited for {what}"
        time.sleep(POLL_S)
    return value


class WebKit:
    """A window of the browser. Each step waits for its element, at most `PATIENCE_S`."""

    def __init__(self, address: str) -> None:
        self._http = httpx2.Client(base_url=address, timeout=PATIENCE_S, trust_env=False)
        wait_for(self._ready, "the driver of WebKit to start")
        made = self._ask("POST", "/session", {"capabilities": {}})
        self._session = f"/session/{made['sessionId']}"

    def close(self) -> None:
        """Close the browser."""
        self._ask("DELETE", self._session)
        self._http.close()

    def go(self, url: str) -> None:
        """Open an address."""
        self._tell("url", url=url)

    def run(self, script: str, *arguments: Any) -> Any:
        """Return what the body of a function returns in the page."""
        return self._tell("execute/sync", script=script, args=list(arguments))

    def find(self, selector: str, text: str = "") -> str:
        """Wait until an element is visible and contains a text; return a reference to it."""
        found = self._until(lambda: self.run(FIND, selector, text), f"{selector} {text!r}")
        return str(found[ELEMENT])

    def gone(self, selector: str) -> None:
        """Wait until no such element is visible."""
        self._until(lambda: self.run(FIND, selector, "") is None, f"the end of {selector}")

    def text(self, selector: str) -> str:
        """Return the text of an element."""
        return str(self._ask("GET", f"{self._session}/element/{self.find(selector)}/text"))

    def click(self, selector: str) -> None:
        """Click with the mouse on an element."""
        self._tell(f"element/{self.find(selector)}/click")

    def type(self, selector: str, text: str) -> None:
        """Type a text into a field."""
        self._tell(f"element/{self.find(selector)}/value", text=text)

    def press(self, key: str) -> None:
        """Press and release a key."""
        strokes = [{"type": kind, "value": key} for kind in ("keyDown", "keyUp")]
        self._tell("actions", actions=[{"type": "key", "id": "keyboard", "actions": strokes}])

    def _until(self, condition: Callable[[], Any], what: str) -> Any:
        try:
            return wait_for(condition, what)
        except AssertionError as error:
            error.add_note(f"The page says: {self.run('return document.body.innerText')}")
            raise

    def _ready(self) -> bool:
        try:
            return bool(self._ask("GET", "/status")["ready"])
        except httpx2.ConnectError:
            return False

    def _tell(self, command: str, **body: Any) -> Any:
        return self._ask("POST", f"{self._session}/{command}", body)

    def _ask(self, method: str, path: str, body: Mapping[str, Any] | None = None) -> Any:
        reply = self._http.request(method, path, json=body)
        value = reply.json()["value"]
        assert reply.is_success, f"{path}: {value['error']}: {value['message']}"
        return value
