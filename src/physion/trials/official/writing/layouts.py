"""Folder layouts that published code reads: which files a trial has in each, and where.

``official``
    As the study published and generated its stimuli::

        labels.csv                              as in PhysionTest-Core: <stimulus>_img, True/False
        stimulus_names_and_labels.csv           as published; URLs are paths below the folder, and
                                                the responses of people ("correct") are empty
        Dominoes/maps/<stimulus>_map.png        PhysionTest-Core: the testing split
        Dominoes/mp4s/<stimulus>_img.mp4        free colours
        Dominoes/mp4s-redyellow/<config>-redyellow_0000_img.mp4
        configurations/Dominoes/<config>/0000.hdf5      as the generator writes a configuration,
                                        /0000_img.mp4   every split, in the trial's own look
                                        /0000_map.png
                                        /metadata.json
                                        /trial_stats.json

    ``configurations/Dominoes/`` is the ``local_stem`` of ``stimuli/generate_metadata.ipynb``.

``physion-particles``
    ``<split>/Dominoes/<stimulus>.hdf5``. ``training`` and ``testing`` are ``training_data_dir`` and
    ``testing_data_dir`` of ``paths.yaml`` in htung0101/Physion-particles.

``physopt``
    ``physion_data/<part>/Dominoes/<stimulus>.hdf5`` for neuroailab/physopt-physics-benchmarking
    with neuroailab/physics-models; the folder is the ``basedir``. Parts: ``pretraining_train`` and
    ``pretraining_val`` (a tenth, by the hash of the name) in free colours from the training split,
    ``readout_train_redyellow`` from readout, ``readout_test_redyellow`` from testing.

``physion-evaluator``
    ``physion_mp4s/train/<name>.mp4`` (readout split) and ``physion_mp4s/test`` (testing split) with
    ``all_video_labels.json``, for neuroailab/physion_evaluator; the folder is its
    ``data_root_path``. Names have the words by which it finds scenarios; it has no Drape.

A trial called ``dominoes_testing_0007`` is number 0007 of the configuration ``dominoes_testing``.
Scenario folders are capitalised, as in the published archives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from physion.seeds import stable_hash
from physion.stimulus_names import FOLDERS, NAMES, canonical_name, scenario_of
from physion.trials.layout import TrialPaths
from physion.trials.official.names import redyellow_name, split_name
from physion.trials.official.writing.lists import write_core_lists, write_evaluator_labels

CORE_SPLIT = "testing"
"""Split that PhysionTest-Core consists of."""
VALIDATION = 10
"""One of this many training trials is for validation in ``physopt``."""


class Content(NamedTuple):
    """What a file holds: its kind, and the look of its pictures; None is the trial's own look.

    ``state`` is an official HDF5 file, ``record`` a JSON file with what lists of labels need.
    """

    kind: Literal["state", "movie", "map", "record"]
    look: str | None = None


Files = Mapping[str, Content]
"""Contents by path below the folder; the last file is written last. Empty: no place."""


@dataclass(frozen=True)
class Layout:
    """A layout: the files of a trial, and the function that writes the lists of a whole folder.

    ``write_lists`` returns the path of the list, and errors by path of files that it cannot read.
    """

    files: Callable[[TrialPaths], Files]
    write_lists: Callable[[Path], tuple[Path, dict[str, str]]]


def _stimulus(paths: TrialPaths) -> str:
    return "_".join(split_name(paths.trial))


def _folder(paths: TrialPaths) -> str:
    return FOLDERS.get(paths.scenario, paths.scenario)


def _official(paths: TrialPaths) -> Files:
    config, number = split_name(paths.trial)
    stimulus, folder = _stimulus(paths), _folder(paths)
    place = f"configurations/{folder}/{config}/{number}"
    files = {f"{place}_img.mp4": Content("movie"), f"{place}_map.png": Content("map")}
    if paths.split == CORE_SPLIT:
        redyellow = redyellow_name(stimulus)
        files |= {
            f"{folder}/mp4s/{stimulus}_img.mp4": Content("movie", "free"),
            f"{folder}/mp4s-redyellow/{redyellow}_img.mp4": Content("movie", "redyellow"),
            f"{folder}/maps/{stimulus}_map.png": Content("map"),
        }
    return files | {f"{place}.hdf5": Content("state")}


def _physion_particles(paths: TrialPaths) -> Files:
    return {f"{paths.split}/{_folder(paths)}/{_stimulus(paths)}.hdf5": Content("state")}


def _physopt(paths: TrialPaths) -> Files:
    held_out = stable_hash("validation", paths.trial) % VALIDATION == 0
    parts = {
        "training": ("pretraining_val" if held_out else "pretraining_train", "free"),
        "readout": ("readout_train_redyellow", "redyellow"),
        "testing": ("readout_test_redyellow", "redyellow"),
    }
    if paths.split not in parts:
        return {}
    part, look = parts[paths.split]
    return {f"physion_data/{part}/{_folder(paths)}/{_stimulus(paths)}.hdf5": Content("state", look)}


def _physion_evaluator(paths: TrialPaths) -> Files:
    phase = {"readout": "train", "testing": "test"}.get(paths.split)
    if phase is None or paths.scenario == "drape":
        return {}
    name, folder = evaluator_name(paths), f"physion_mp4s/{phase}"
    return {
        f"{folder}/{name}.mp4": Content("movie", "redyellow"),
        f"{folder}/records/{name}.json": Content("record", "redyellow"),
    }


def evaluator_name(paths: TrialPaths) -> str:
    """Return a name of the trial in which physion_evaluator finds its scenario, and no dot.

    Official names stay; ``collide_testing_0003`` becomes ``collision_testing_0003``.
    """
    stimulus = canonical_name(_stimulus(paths)).replace(".", "_")
    if scenario_of(stimulus) == paths.scenario or paths.scenario not in NAMES:
        return stimulus
    rest = stimulus.removeprefix(paths.scenario).lstrip("_")
    return f"{NAMES[paths.scenario].experiment}_{rest}"


def _no_lists(out: Path) -> tuple[Path, dict[str, str]]:
    return out, {}


LAYOUTS: Mapping[str, Layout] = {
    "official": Layout(_official, write_core_lists),
    "physion-particles": Layout(_physion_particles, _no_lists),
    "physopt": Layout(_physopt, _no_lists),
    "physion-evaluator": Layout(_physion_evaluator, write_evaluator_labels),
}
"""Layouts by name."""
