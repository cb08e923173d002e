"""Test client of the experimenter's pages, and a study that is served to it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from starlette.testclient import TestClient

from physion.experiment.app import build_app
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import Study
from support.experiment.tiny_study import PASSWORD, make_tiny_study

BASE = "/experimenter"
TWO = ("collide", "drop")


class Visitor(TestClient):
    """Test client that submits forms as a browser would."""

    def see(self, path: str = "") -> Any:
        """Get a page without following redirects."""
        return self.get(f"{BASE}{path}", follow_redirects=False)

    def submit(self, path: str, origin: str = "", **fields: str) -> Any:
        """Submit a form of this site, or of another ``origin``."""
        kind = "application/x-www-form-urlencoded"
        headers = {"origin": origin or str(self.base_url), "content-type": kind}
        return self.post(f"{BASE}{path}", data=fields, headers=headers, follow_redirects=False)

    def log_in(self, password: str = PASSWORD) -> Any:
        """Submit the password on the login page."""
        return self.submit("/login", password=password)


class Lab:
    """A tiny study, its store and its application."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        settings = {"test": 6, "scenarios": TWO, "size": 64, "languages": ("en",)} | settings
        self.study: Study = make_tiny_study(folder, **settings)
        self.secrets = Secrets.load(folder)
        self.store = Store.open(self.study, self.secrets)
        self.app = build_app(self.study, self.secrets, self.store)
        self._visitors = contextlib.ExitStack()

    def visitor(self, base_url: str = "http://testserver", address: str = "192.0.2.1") -> Visitor:
        """Return a new client that is not logged in."""
        return self._visitors.enter_context(
            Visitor(self.app, base_url=base_url, client=(address, 5000))
        )

    def experimenter(self, **settings: Any) -> Visitor:
        """Return a new client that is logged in."""
        visitor = self.visitor(**settings)
        assert visitor.log_in().status_code == 303
        return visitor

    def close(self) -> None:
        """Close the clients and the store."""
        self._visitors.close()
        self.store.close()


@contextlib.contextmanager
def lab(folder: Path, **settings: Any) -> Iterator[Lab]:
    """Create a `Lab` and close it at the end."""
    opened = Lab(folder, **settings)
    try:
        yield opened
    finally:
        opened.close()
