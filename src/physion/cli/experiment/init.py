"""Create a study folder from a generated dataset, official scenes, or official lists and movies.

Movies are cut to their observed frames. Texts, settings and stimuli are files that can be edited.
The experimenter's password is shown once.
"""

from __future__ import annotations

import json as json_module
import os
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from physion.core.errors import BadInputError

if TYPE_CHECKING:
    from physion.experiment.study.choose import StimulusSelection
    from physion.experiment.study.study import Study


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment init``; all other settings are in study.toml."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the study; new or empty."""
    trials: Path | None = None
    """Dataset from which testing and familiarization trials are drawn."""
    scenes: Path | None = None
    """Instead of --trials: official scenes, which are rendered first: the package's own
    (official), a folder made by physion import, or one with command logs, which are looked for
    in all folders in it."""
    rendered: Path | None = None
    """Folder of the trials that --scenes makes; existing ones are kept. Default: next to the study,
    with -trials after its name."""
    stimuli: tuple[Path, ...] = ()
    """Instead of --trials: official stimulus lists (JSON or CSV), one per scenario."""
    familiarization: tuple[Path, ...] = ()
    """Lists of the familiarization stimuli in the same format, in their order, one per scenario."""
    familiarization_trials: Path | None = None
    """Instead of --familiarization: dataset from which familiarization trials are drawn."""
    movies: Path | None = None
    """Folder with the movies of the lists, STIM_ID.mp4, with all frames; they will be cut."""
    maps: Path | None = None
    """Folder with the maps of the lists. Default: searched for next to the movies."""
    scenario: tuple[str, ...] = ()
    """Scenarios of --trials or --scenes. Default: all that have testing trials."""
    test: int | None = None
    """Test trials per session, half with contact. Default: 150 or as many as there are, or the
    whole lists."""
    practice: int = 10
    """Familiarization trials drawn from a dataset, half with contact."""
    preset: Literal["recommended", "paper"] = "recommended"
    """Settings to begin with: "recommended", or as in the study of the "paper": no breaks, 4 USD
    for 20 minutes, only preregistered exclusions, a question of mental rotation at the end."""
    mental_rotation: bool = False
    """Ask the question of mental rotation also without the preset of the paper."""
    look: Literal["free", "redyellow"] = "free"
    """Colours of trials from a dataset; free in the official study."""
    name: str | None = None
    """Short name of the study. Default: the name of the folder."""
    title: str = "Predict what happens"
    """Title at the top of the participants' pages."""
    contact: str = ""
    """Contact for participants, needed: a name and an e-mail address, which the pages show."""
    participants: int = 100
    """Complete sessions wanted for each scenario."""
    languages: tuple[str, ...] = ("en", "de")
    """Languages whose texts are copied into the study."""
    seed: int = 0
    """Seed of the draw of trials and of all trial orders."""
    workers: int = os.cpu_count() or 1
    """Processes that render the trials of --scenes."""
    password_file: Path | None = None
    """File with the experimenter's password. Default: a random one is created and shown."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Create the study; print its password once, and the next steps."""
    from physion.cli.output import Stages
    from physion.experiment.export.documents import write_documents
    from physion.experiment.study.identity import read_password
    from physion.experiment.study.make import make_study

    if not options.contact:
        raise BadInputError(
            'give --contact "NAME, EMAIL": participants see it with the consent, to ask questions '
            "and to have their data deleted"
        )
    # A random password has 96 bits.
    file = options.password_file
    password = secrets.token_urlsafe(12) if file is None else read_password(file)
    chosen = _choose(options)
    with Stages() as stages:
        study = make_study(
            _study(options, chosen.scenarios), chosen.sources, password, progress=stages
        )
        write_documents(study)
    _print(options, study, chosen, password if file is None else None)
    return 0


def _choose(options: Options) -> StimulusSelection:
    """Select the stimuli from the dataset, the official scenes or the lists."""
    given = [bool(options.trials), bool(options.scenes), bool(options.stimuli)]
    if sum(given) != 1:
        raise BadInputError(
            "give either --trials DATASET, --scenes official, or --stimuli LISTS with --movies DIR"
        )
    if options.rendered is not None and options.scenes is None:
        raise BadInputError("--rendered goes with --scenes, whose trials are rendered first")
    if options.stimuli:
        return _choose_listed(options)
    for name in ("familiarization", "familiarization_trials", "movies", "maps"):
        if getattr(options, name):
            raise BadInputError(f"--{name.replace('_', '-')} needs --stimuli")
    if options.trials is not None:
        return _choose_made(options, options.trials, options.scenario)
    return _choose_official(options)


def _choose_made(options: Options, trials: Path, scenario: tuple[str, ...]) -> StimulusSelection:
    """Select the stimuli from a dataset."""
    from physion.experiment.study.choose import TEST, choose_trials

    return choose_trials(
        trials,
        scenarios=scenario,
        test=TEST if options.test is None else options.test,
        practice=options.practice,
        look=options.look,
        seed=options.seed,
    )


def _choose_official(options: Options) -> StimulusSelection:
    """Select official scenes, render the trials that are missing, and take the stimuli of them."""
    from physion.analysis.tables import read_humans
    from physion.cli.output import Stages
    from physion.compute.local import LocalExecutor
    from physion.data.official import find_official, read_official_trials
    from physion.experiment.study.choose import SIZE, TEST, choose_official
    from physion.trials.making.generate import make_trials
    from physion.trials.making.plan import GenerateSettings

    assert options.scenes is not None
    data, logs = find_official(options.scenes), read_official_trials(options.scenes)
    logs.require_trials()
    folder = options.rendered or options.folder.with_name(f"{options.folder.name}-trials")
    with LocalExecutor(workers=options.workers) as executor, Stages() as stages:
        chosen = choose_official(
            logs.trials,
            None if data is None else set(read_humans(data.humans)["stimulus"]),
            scenarios=options.scenario,
            test=TEST if options.test is None else options.test,
            practice=options.practice,
            executor=executor,
            progress=stages,
        )
        settings = GenerateSettings(SIZE, SIZE, options.look, jitters=0)
        report = make_trials(folder, chosen.tasks, settings, executor=executor, progress=stages)
    failures = [f"left out: {name}: {reason}" for name, reason in report.failed.items()]
    made = _choose_made(options, folder, tuple(dict.fromkeys(t.scenario for t in chosen.tasks)))
    return type(made)(made.sources, (*chosen.notes, *failures, *made.notes))


def _choose_listed(options: Options) -> StimulusSelection:
    """Select the stimuli from official lists."""
    from physion.experiment.study.choose import choose_familiarization, choose_listed

    if options.movies is None:
        raise BadInputError("--stimuli needs --movies DIR, the folder with STIM_ID.mp4")
    if options.scenario:
        raise BadInputError("--scenario goes with --trials; each list is of one scenario")
    if bool(options.familiarization) == (options.familiarization_trials is not None):
        raise BadInputError(
            "give the familiarization stimuli: --familiarization LISTS in the same format, or "
            "--familiarization-trials DATASET (physion generate DATASET --split familiarization)"
        )
    listed = choose_listed(
        options.stimuli, options.familiarization, options.movies, options.maps,
        test=options.test, seed=options.seed,
    )  # fmt: skip
    parts = [listed]
    if options.familiarization_trials is not None:
        parts += [
            choose_familiarization(
                options.familiarization_trials, scenario,
                count=options.practice, look=options.look, seed=options.seed,
            )
            for scenario in listed.scenarios
        ]  # fmt: skip
    return type(listed)(
        tuple(source for part in parts for source in part.sources),
        tuple(note for part in parts for note in part.notes),
    )


def _study(options: Options, scenarios: tuple[str, ...]) -> Study:
    """Return the settings of the new study."""
    from physion.experiment.study.settings import MENTAL_ROTATION, PAPER
    from physion.experiment.study.study import Study

    chosen = dict(PAPER) if options.preset == "paper" else {}
    if options.mental_rotation:
        chosen["questions"] = (MENTAL_ROTATION,)
    return Study(
        folder=options.folder,
        name=options.name or options.folder.resolve().name,
        version="1",
        title=options.title,
        contact=options.contact,
        scenarios=scenarios,
        languages=options.languages,
        participants=options.participants,
        seed=options.seed,
        **chosen,
    )


def _print(options: Options, study: Study, chosen: StimulusSelection, password: str | None) -> None:
    """Print the counts of stimuli, the password and the next steps."""
    from physion.cli.output import console

    counts = {
        scenario: {
            phase: len(study.phase(scenario, phase)) for phase in ("familiarization", "test")
        }
        for scenario in study.scenarios
    }
    if options.json:
        values = {"study": str(study.folder), "digest": study.digest, "stimuli": counts}
        print(json_module.dumps(values | {"notes": chosen.notes, "password": password}))
        return
    for note in chosen.notes:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    for scenario, phases in counts.items():
        console.print(
            f"{scenario}: {phases['test']} test and {phases['familiarization']} familiarization "
            "trials", markup=False, soft_wrap=True,
        )  # fmt: skip
    lines = [f"study: {study.folder}"]
    if password is not None:
        lines.append(f"password of the experimenter's pages, shown only now: {password}")
    lines.append("its preregistration and a figure of its trials: preregistration.md, trial.svg")
    lines.append("next: set the title in study.toml, edit texts/ (the consent!), then run")
    lines.append(f"  physion experiment serve {study.folder}")
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)
