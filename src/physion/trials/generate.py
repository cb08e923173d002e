"""Generation of a dataset in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from physion.compute.executor import Executor
from physion.compute.progress import Progress
from physion.errors import BadInputError, PhysionError
from physion.scenes.sampling.registry import scenarios
from physion.trials.dataset import Dataset
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_dataset


def generate(
    folder: Path | str,
    scenario: str | Sequence[str] = "all",
    counts: Mapping[str, int] | int = 10,
    *,
    presets: Sequence[str] = (),
    name: str = "physion",
    settings: GenerateSettings | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Sample scenes, simulate and render them, and write trials; existing trials are kept.

    An interrupted call is resumed by the same call. Equal arguments give equal bytes.

    Parameters
    ----------
    folder
        Folder of the dataset: new, empty, or one to resume or extend.
    scenario
        Name of a scenario, names of several, or ``all``.
    counts
        Trials per scenario by split (training, readout, testing, familiarization), or a number of
        testing trials.
    presets
        Names of presets that the trials of a scenario take in turn, or ``FILE.toml:NAME``; by
        default the published configurations.
    name
        Name of the dataset, part of the seed of every trial.
    settings
        How trials are chosen, rendered and stored.
    executor
        Where to run; by default one process per core, for which a script needs
        ``if __name__ == "__main__":``.
    progress
        Called with (stage, done, total) after every trial.

    Returns
    -------
    dataset
        All trials of the folder, including those of earlier calls.

    Raises
    ------
    UnknownNameError
        For an unknown scenario, split or preset.
    BadInputError
        If the folder was made with other settings or is not a dataset, or for presets of more than
        one scenario.
    PhysionError
        If some trials could not be made. The others are in the folder, and the same call tries
        those that are missing again.
    """
    names = [scenario] if isinstance(scenario, str) else list(scenario)
    if names == ["all"]:
        names = scenarios.names()
    if presets and len(names) != 1:
        raise BadInputError("presets need one scenario: each scenario has its own presets")
    planned = {"testing": counts} if isinstance(counts, int) else dict(counts)
    if not planned or min(planned.values()) < 1:
        raise BadInputError(f"counts must be 1 or more for each split, not {planned}")
    chosen = {names[0]: tuple(presets)} if presets else None
    tasks = plan_dataset(name, names, planned, chosen)
    report = make_trials(Path(folder), tasks, settings, executor=executor, progress=progress)
    if report.failed:
        trial, reason = next(iter(report.failed.items()))
        raise PhysionError(
            f"{len(report.failed)} of {len(tasks)} trials could not be made, such as {trial!r}: "
            f"{reason}; the others are in {folder}, and the same call tries again"
        )
    return Dataset(folder)
