"""Export a dataset to layouts that published code reads, as a dataset card, as movies that a
network elsewhere is to encode, or as questions for language models."""

from __future__ import annotations

import json as json_module
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from physion.cli.output import Stages, print_line, print_report
from physion.compute.local import LocalExecutor
from physion.core.errors import BadInputError


@dataclass(frozen=True)
class Options:
    """Options of ``physion export``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset; for result-tables, the folder that `physion evaluate` wrote."""
    out: Annotated[Path | None, tyro.conf.Positional] = None
    """Output folder; the default for a card is the dataset's folder."""
    layout: Literal[
        "official",
        "physion-particles",
        "physopt",
        "physion-evaluator",
        "mp4s",
        "hdf5s",
        "gltf",
        "lerobot",
        "lance",
        "features-request",
        "lmms-eval",
        "conditioning",
        "card",
        "result-tables",
    ] = "official"
    """official: HDF5 files, movies and PhysionTest-Core folders of the study; physion-particles,
    physopt, physion-evaluator: folders that this published code reads (of physion_evaluator,
    extract_features.py needs one edit: remove its check of the number of movies, after which it
    would download others); mp4s, hdf5s: the study's downloads of movies (SlotFormer) and of HDF5
    files;
    gltf: one GLB file for each trial, with its motion, for Blender and other 3D programs;
    lerobot: a LeRobot dataset (v3.0) of full movies, states and pushes, for world models;
    lance: the same as tables of Lance, for stable-worldmodel (extra lance);
    features-request: movies to be encoded elsewhere, their names, and a script that needs only
    torch; physion evaluate --features takes its result;
    lmms-eval: questions for language models with movies, as tasks of this harness;
    conditioning: pictures, movies and a prompt from which movies are generated, for physion judge;
    card: README with Croissant metadata and a table for each split; result-tables: predictions with
    the names of scenarios that the notebooks of the study use."""
    split: Literal["training", "readout", "testing", "familiarization"] | None = None
    """Export only this split."""
    scenario: str | None = None
    """Export only this scenario."""
    images: bool = True
    """Write pictures into HDF5 files; without, the export is 20 times as fast."""
    verify: bool = True
    """Compare files with their SHA-256 in the index before they are used."""
    readout: Literal["observed", "full"] = "observed"
    """For a features-request: movies that end with the observed part, or whole ones."""
    license: str | None = None
    """For a card: SPDX identifier of the licence, such as CC-BY-4.0; default: MIT."""
    creator: str | None = None
    """For a card: author of the dataset."""
    version: str | None = None
    """For a card: version with three numbers; default: 1.0.0."""
    url: str | None = None
    """For a card: URL of the dataset."""
    published: str | None = None
    """For a card: date of publication, such as 2026-01-31; default: today."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""
    json: bool = False
    """Print one JSON object."""


CARD_TERMS = ("license", "creator", "version", "url", "published")
"""Options that apply only to a card."""
HDF5_LAYOUTS = ("official", "physion-particles", "physopt", "hdf5s")
"""Layouts with official HDF5 files."""
WHOLE = ("card", "result-tables")
"""Layouts that describe a whole folder."""


def main(options: Options) -> int:
    """Export what is missing; return 1 if a trial failed."""
    _check(options)
    if options.layout == "card":
        from physion.trials.share.card import write_card

        given = {name: getattr(options, name) for name in CARD_TERMS}
        terms = {name: value for name, value in given.items() if value is not None}
        card = write_card(options.folder, options.out, verify=options.verify, **terms)
        return _print_paths([card.readme, card.metadata, *card.tables], options.json)
    if options.out is None:
        raise BadInputError(f"--layout {options.layout} needs a folder to write into")
    if options.layout == "result-tables":
        from physion.trials.share.result_tables import export_result_tables

        return _print_paths(export_result_tables(options.folder, options.out), options.json)
    with Stages() as stages:
        return _trials(options, options.out, stages)


def _check(options: Options) -> None:
    """Raise `BadInputError` for an option that does not apply to the layout."""
    layout = options.layout
    terms = [name for name in CARD_TERMS if getattr(options, name) is not None]
    if terms and layout != "card":
        raise BadInputError(f"--{terms[0]} applies only to a card: use it with --layout card")
    if options.readout != "observed" and layout != "features-request":
        raise BadInputError(
            "--readout applies only to a request: use it with --layout features-request"
        )
    if not options.images and layout not in HDF5_LAYOUTS:
        raise BadInputError(
            f"--no-images applies to HDF5 files: use it with --layout {', '.join(HDF5_LAYOUTS)}"
        )
    if not options.verify and layout == "result-tables":
        raise BadInputError(f"--no-verify does not apply to {layout}: leave it out")
    if layout in WHOLE and (options.split or options.scenario):
        raise BadInputError(
            f"--layout {layout} is of a whole folder: leave out --split, --scenario"
        )


def _trials(options: Options, out: Path, stages: Stages) -> int:
    """Export trials in one of the layouts that hold trials."""
    chosen: dict[str, Any] = {"split": options.split, "scenario": options.scenario}
    if options.layout == "gltf":
        from physion.trials.share.gltf import export_gltf

        made = export_gltf(options.folder, out, verify=options.verify, progress=stages, **chosen)
        return _print_paths(made, options.json)
    if options.layout == "lerobot":
        from physion.trials.share.lerobot import export_lerobot

        made = export_lerobot(options.folder, out, verify=options.verify, progress=stages, **chosen)
        return _print_paths(made, options.json)
    if options.layout == "lance":
        from physion.trials.share.lance import export_lance

        made = export_lance(options.folder, out, verify=options.verify, progress=stages, **chosen)
        return _print_paths(made, options.json)
    if options.layout == "features-request":
        from physion.trials.share.features_request import export_features_request

        paths = export_features_request(
            options.folder, out, readout=options.readout, verify=options.verify, progress=stages,
            **chosen,
        )  # fmt: skip
        return _print_paths(paths, options.json)
    if options.layout == "lmms-eval":
        from physion.trials.share.lmms_eval import export_lmms_eval

        paths = export_lmms_eval(
            options.folder, out, verify=options.verify, progress=stages, **chosen
        )
        return _print_paths(paths, options.json)
    if options.layout == "conditioning":
        from physion.trials.share.conditioning import export_conditioning

        paths = export_conditioning(
            options.folder, out, verify=options.verify, progress=stages, **chosen
        )
        return _print_paths(paths, options.json)
    chosen |= {"executor": LocalExecutor(workers=options.workers), "progress": stages}
    from physion.trials.official.export_folder import export_official

    report = export_official(
        options.folder, out, layout=options.layout, verify=options.verify, images=options.images,
        **chosen,
    )  # fmt: skip
    return print_report(report, options.json)


def _print_paths(paths: Sequence[Path], as_json: bool) -> int:
    if as_json:
        print(json_module.dumps({"made": [str(path) for path in paths]}))
    else:
        print_line("\n".join(map(str, paths)))
    return 0
