"""Run the experiment with people: create a study, serve it, export the answers.

STUDY is the folder of the study. Sub-verbs, whose options --help lists after each of them:
  init STUDY       create a study from trials, official scenes, or lists of stimuli
  serve STUDY      run the web server for participants and the experimenter
  links STUDY      print links for Prolific, SONA, MTurk, previews and piloting
  simulate STUDY   run simulated participants, permanently marked as such
  export STUDY     export the answers for the analysis, with a data dictionary
  describe STUDY   write the preregistration of the study and a figure of its trials
  backup STUDY     copy the database, settings and texts while the study is served
  forget STUDY     delete the ids of recruiters, or all data of a session
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated

import tyro

from physion.core.errors import MissingExtraError

SUBVERBS = {
    "init": "physion.cli.experiment.init",
    "serve": "physion.cli.experiment.serve",
    "export": "physion.cli.experiment.export",
    "simulate": "physion.cli.experiment.simulate",
    "links": "physion.cli.experiment.links",
    "describe": "physion.cli.experiment.describe",
    "backup": "physion.cli.experiment.backup",
    "forget": "physion.cli.experiment.forget",
}
"""Sub-verbs of ``physion experiment``, and the module of each."""
NEEDED = ("fastapi", "uvicorn", "sqlalchemy", "argon2", "jinja2", "pydantic")
"""Modules that the extra ``experiment`` installs."""


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment`` without a sub-verb."""

    sub_verb: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """One of init, serve, links, simulate, export, describe, backup, forget."""


def main(options: Options) -> int:
    """Print the sub-verbs; return exit status 2, since nothing was done."""
    from physion.cli.arguments import no_such
    from physion.cli.output import console

    if options.sub_verb:
        raise no_such("sub-verb", options.sub_verb[0], SUBVERBS, "physion experiment --help")
    console.print((__doc__ or "").strip(), markup=False, soft_wrap=True)
    return 2


def require_extra() -> None:
    """Raise `MissingExtraError` unless the extra ``experiment`` is installed."""
    if any(find_spec(name) is None for name in NEEDED):
        raise MissingExtraError("the experiment", "experiment")
