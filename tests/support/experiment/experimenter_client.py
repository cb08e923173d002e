"""A browser without a screen for the experimenter's pages."""

from __future__ import annotations

import contextlib
import re
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
    """Sends forms as a browser would, with the token of the page that was seen last."""

    def token(self, page: str = "/login") -> str:
        """The token in the forms of a page."""
        found = re.search(r'name="form_token" value="([0-9a-f]{64})"', self.see(page).text)
        assert found is not None
        return found[1]

    def see(self, place: str = "") -> Any:
        """A page; what it says where one is sent elsewhere, not the other page."""
        return self.get(f"{BASE}{place}", follow_redirects=False)

    def submit(self, place: str, form_token: str | None = None, **fields: str) -> Any:
        """A form, without a token where none is given."""
        data = fields | ({} if form_token is None else {"form_token": form_token})
        return self.post(f"{BASE}{place}", data=data, follow_redirects=False)

    def log_in(self, password: str = PASSWORD) -> Any:
        """The password, as on the login page."""
        return self.submit("/login", self.token(), password=password)

    def open_payments(self) -> Any:
        """The password once more, then the page of payments."""
        assert self.submit("/payments", self.token("/export"), password=PASSWORD).status_code == 303
        return self.see("/payments")


class Lab:
    """A study that is served to visitors."""

    def __init__(self, folder: Path, url: str | None = None, **settings: Any) -> None:
        settings = {"test": 6, "scenarios": TWO, "size": 64, "languages": ("en",)} | settings
        self.study: Study = make_tiny_study(folder, **settings)
        self.secrets = Secrets.load(folder)
        self.store = Store.open(self.study, self.secrets, url)
        self.app = build_app(self.study, self.secrets, self.store)
        self._visitors = contextlib.ExitStack()

    def visitor(self, base_url: str = "http://testserver", address: str = "192.0.2.1") -> Visitor:
        """A new browser, not logged in."""
        return self._visitors.enter_context(
            Visitor(self.app, base_url=base_url, client=(address, 5000))
        )

    def experimenter(self, **settings: Any) -> Visitor:
        """A new browser that is logged in."""
        visitor = self.visitor(**settings)
        assert visitor.log_in().status_code == 303
        return visitor

    def close(self) -> None:
        """Ends the server and its processes."""
        self._visitors.close()
        self.store.close()


@contextlib.contextmanager
def lab(folder: Path, url: str | None = None, **settings: Any) -> Iterator[Lab]:
    """A `Lab` for a while."""
    found = Lab(folder, url, **settings)
    try:
        yield found
    finally:
        found.close()
