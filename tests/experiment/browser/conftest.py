"""One browser, and one study on one server, for each file of tests in this folder."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from physion.experiment.study.settings import Recruitment
from physion.experiment.study.study import Study
from support.experiment.browser import MTURK, chromium, driver, firefox, served

__all__ = ["chromium", "driver", "firefox"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    """A study of one practice trial and three test trials, and the URL of its server."""
    settings: dict[str, Any] = {
        "recruitment": Recruitment(
            prolific_code="PROLIFIC7",
            mturk_code="TURK-CODE",
            link_code="TINY-CODE",
            link_address="https://lab.example/done",
        ),
        "embed_from": (MTURK,),
        "percentile_from": 1,
    }
    with served(tmp_path_factory.mktemp("study"), **settings) as (study, server):
        yield study, server.url
