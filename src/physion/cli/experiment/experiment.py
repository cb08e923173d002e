"""Run the experiment with people: make a study, serve it, export what they answered.

`physion experiment init DIR --trials DATASET`: a study folder from our trials, or --stimuli LISTS.

`physion experiment serve DIR`: the web server, for people and the experimenter.

`physion experiment links DIR`: addresses for Prolific, SONA, MTurk, previews and pilots.

`physion experiment simulate DIR`: simulated participants for piloting, marked as such for good.

`physion experiment export DIR`: the answers as the analysis reads them, with a data dictionary.

`physion experiment password DIR`: a new password for the experimenter's pages.

`physion experiment forget DIR`: delete the ids that recruiters gave, or all of a session.

Each says more with --help.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated

import tyro

from physion.errors import MissingExtraError, UnknownNameError

SUBVERBS = {
    "init": "physion.cli.experiment.init",
    "serve": "physion.cli.experiment.serve",
    "export": "physion.cli.experiment.export",
    "simulate": "physion.cli.experiment.simulate",
    "links": "physion.cli.experiment.links",
    "password": "physion.cli.experiment.password",
    "forget": "physion.cli.experiment.forget",
}
"""Words after ``physion experiment``, and the module of each."""
NEEDED = ("fastapi", "uvicorn", "sqlalchemy", "alembic", "argon2", "jinja2", "pydantic")
"""Modules of the extra ``experiment``."""


@dataclass(frozen=True)
class Options:
    """The experiment itself does nothing: say what to do."""

    words: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """One of init, serve, links, simulate, export, password, forget."""


def main(options: Options) -> int:
    """Say which words there are; 2, since nothing was done."""
    from physion.cli.output import console

    if options.words:
        raise UnknownNameError("word after 'physion experiment'", options.words[0], SUBVERBS)
    console.print((__doc__ or "").strip(), markup=False, soft_wrap=True)
    return 2


def require_extra() -> None:
    """`MissingExtraError` unless everything is installed that the experiment needs."""
    if any(find_spec(name) is None for name in NEEDED):
        raise MissingExtraError("the experiment", "experiment")
