"""Test participant over HTTP, who records all responses of the server."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starlette.testclient import TestClient

from physion.experiment.app import build_app
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import Study
from support.experiment.store_walk import OPTIONAL_PAGES, ORDER, PAGES, visit_of
from support.experiment.tiny_study import make_tiny_study


@dataclass
class Served:
    """A study served in this process, with its test client."""

    study: Study
    secrets: Secrets
    store: Store
    client: TestClient

    def person(self, **enter: Any) -> Person:
        """Return a person who has entered; one with an id always has the same browser."""
        person = Person(self.client)
        visit = {"visit": visit_of(enter["id"])} if "id" in enter else {}
        person.ask("POST", "/api/enter", visit | enter)
        person.token = person.last["token"]
        return person


@contextlib.contextmanager
def served(folder: Path, **settings: Any) -> Iterator[Served]:
    """Create a tiny study in ``folder`` and serve it."""
    study = make_tiny_study(folder, **{"size": 64, **settings})
    secrets = Secrets.load(folder)
    store = Store.open(study, secrets)
    try:
        with TestClient(build_app(study, secrets, store)) as client:
            yield Served(study, secrets, store, client)
    finally:
        store.close()


@dataclass
class Person:
    """Client of one participant. ``heard`` has all requests with their responses."""

    client: TestClient
    token: str = ""
    heard: list[tuple[str, Any]] = field(default_factory=list)

    @property
    def last(self) -> Any:
        """The JSON body of the last response."""
        return self.heard[-1][1].json()

    def ask(self, method: str, path: str, body: Any = None, status: int = 200) -> Any:
        """Send a request, assert its status, and return the JSON body (else the response)."""
        headers = {"authorization": f"Bearer {self.token}"} if self.token else {}
        answer = self.client.request(method, path, json=body, headers=headers)
        self.heard.append((f"{method} {path}", answer))
        assert answer.status_code == status, (path, answer.status_code, answer.text[:300])
        return answer.json() if answer.headers["content-type"] == "application/json" else answer

    def state(self) -> Any:
        return self.ask("GET", "/api/session")

    def page(self, name: str, status: int = 200, **data: Any) -> Any:
        body = {"page": name, "data": data or (PAGES | OPTIONAL_PAGES).get(name, {})}
        return self.ask("POST", "/api/page", body, status)

    def answer(self, trial: int, phase: str = "test", status: int = 200, **more: Any) -> Any:
        return self.ask("POST", "/api/answers", answer_body(trial, phase, **more), status)

    def walk(self, stage: str) -> Person:
        """Submit pages and answers until a stage is reached."""
        while (state := self.state())["stage"] != stage:
            assert ORDER.index(state["stage"]) < ORDER.index(stage)
            if state["trial"] is None:
                self.page(state["stage"])
            else:
                self.answer(state["trial"], state["stage"])
        return self


def answer_body(trial: int, phase: str = "test", **more: Any) -> dict[str, Any]:
    """Return the body of an answer as the pages send it."""
    details = {"cue_changes": [0.0, 250.1, 500.2], "frames": [[0, 0.0], [1, 33.4]]}
    return {
        "key": f"{phase}-{trial:04d}", "phase": phase, "trial": trial, "response": "yes",
        "rt_ms": 812.5, "input": "keyboard", "frames_shown": 45, "frames_dropped": 0,
        "visibility_changes": 0, "window_width": 1280, "window_height": 720, "details": details,
        **more,
    }  # fmt: skip
