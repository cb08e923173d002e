"""Sample scenes, simulate and render them, and write trials; existing trials are kept."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from physion.cli.arguments import take_options
from physion.cli.output import Stages, print_report
from physion.compute.run_tasks import ExecutorSettings
from physion.core.errors import BadInputError
from physion.core.settings import check_keys
from physion.trials.making.generate import FailedTrialsError, generate
from physion.trials.making.plan import FULL_COUNTS, SPLITS, GenerateSettings


@dataclass(frozen=True)
class Options:
    """Options of ``physion generate``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset: new, empty, or one to resume."""
    scenario: str = "all"
    """Name of a scenario, several joined by commas, or all."""
    split: Literal["training", "readout", "testing", "familiarization", "all"] = "testing"
    """Split to generate; all with --full generates the sets of the study."""
    count: int = 10
    """Trials per scenario."""
    full: bool = False
    """Use the sizes of the study instead of --count: training 2000, readout 1000, testing 150,
    familiarization 10 per scenario."""
    presets: tuple[str, ...] = ()
    """Presets that are used in turn (see physion ls presets), or FILE.toml:NAME; default: the
    published configurations. Requires one --scenario."""
    whatif: tuple[
        Literal["remove", "mass", "friction", "push", "cue-mass", "cue-friction"], ...
    ] = ()
    """Make variants of each trial, too, with one thing changed: a body removed, the agent's mass,
    all friction, or the push; or four trials that show the agent's mass or friction before they ask
    about it. physion evaluate scores whether predictions change with them."""
    pairs: tuple[Literal["vanish", "teleport", "swap", "stop-in-air", "pass-through"], ...] = ()
    """Make two possible and two impossible movies of each testing trial and kind, too; physion
    evaluate --surprise scores which of two surprises a model more."""
    name: str = "physion"
    """Name of the dataset, part of the seed of every trial."""
    settings: Annotated[GenerateSettings, tyro.conf.arg(name="")] = field(
        default_factory=GenerateSettings
    )
    """How trials are chosen, rendered and stored."""
    option: tuple[str, ...] = ()
    """Further settings. robust=0.9: at least 90 % of the jittered simulations have the trial's
    outcome (default: 0). min_visible=0.01: agent and patient each cover at least 1 % of the first
    frame (default: 0.0005). observed_contact=true: also readout, testing and familiarization trials
    with a contact in the observed part. labels=false: neither labels nor maps in the split
    training. compatible=true: compression by gzip instead of zstd."""
    compute: Annotated[ExecutorSettings, tyro.conf.arg(name="")] = field(
        default_factory=ExecutorSettings
    )
    """Where tasks run, and their limits."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Make the missing trials; 1 if one failed."""
    settings, unknown = take_options(options.settings, options.option)
    own = [field.name for field in fields(GenerateSettings)]
    check_keys((pair.partition("=")[0] for pair in unknown), own, "--option")
    if unknown:
        name = unknown[0].partition("=")[0]
        raise BadInputError(f"{name} has an option of its own: --{name.replace('_', '-')}")
    splits = SPLITS if options.split == "all" else (options.split,)
    counts = {split: FULL_COUNTS[split] if options.full else options.count for split in splits}
    try:
        with Stages() as stages:
            report = generate(
                options.folder,
                options.scenario,
                counts,
                presets=options.presets,
                whatif=options.whatif,
                pairs=options.pairs,
                name=options.name,
                settings=settings,
                executor=options.compute.open(),
                progress=stages,
            ).report
    except FailedTrialsError as error:
        report = error.report
    return print_report(report, options.json)
