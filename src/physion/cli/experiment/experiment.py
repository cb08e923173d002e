"""Run the experiment with people: create a study, serve it, export the answers.

`physion experiment init DIR --trials DATASET`: create a study folder (or from --stimuli LISTS).

`physion experiment serve DIR`: run the web server for participants and the experimenter.

`physion experiment links DIR`: print links for Prolific, SONA, MTurk, previews and piloting.

`physion experiment simulate DIR`: run simulated participants, permanently marked as such.

`physion experiment export DIR`: export the answers for the analysis, with a data dictionary.

`physion experiment describe DIR`: write its preregistration and a figure of its trials.

`physion experiment backup DIR`: copy the database, settings and texts while the study is served.

`physion experiment forget DIR`: delete recruiters' ids, or all data of a session.

`physion experiment power`: how many people and stimuli a study needs.

For details, use --help after any of these.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated

import tyro

from physion.core.errors import MissingExtraError, UnknownNameError

SUBVERBS = {
    "init": "physion.cli.experiment.init",
    "serve": "physion.cli.experiment.serve",
    "export": "physion.cli.experiment.export",
    "simulate": "physion.cli.experiment.simulate",
    "links": "physion.cli.experiment.links",
    "describe": "physion.cli.experiment.describe",
    "backup": "physion.cli.experiment.backup",
    "forget": "physion.cli.experiment.forget",
    "power": "physion.cli.experiment.power",
}
"""Sub-verbs of ``physion experiment``, and the module of each."""
NEEDED = ("fastapi", "uvicorn", "sqlalchemy", "argon2", "jinja2", "pydantic")
"""Modules that the extra ``experiment`` installs."""


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment`` without a sub-verb."""

    words: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """One of init, serve, links, simulate, export, describe, backup, forget, power."""


def main(options: Options) -> int:
    """Print the sub-verbs; return exit status 2, since nothing was done."""
    from physion.cli.output import console

    if options.words:
        raise UnknownNameError("sub-verb of 'physion experiment'", options.words[0], SUBVERBS)
    console.print((__doc__ or "").strip(), markup=False, soft_wrap=True)
    return 2


def require_extra() -> None:
    """Raise `MissingExtraError` unless the extra ``experiment`` is installed."""
    if any(find_spec(name) is None for name in NEEDED):
        raise MissingExtraError("the experiment", "experiment")
