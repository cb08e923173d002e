"""Export of a dataset in the folder layouts that published code reads.

A layout says which files a trial has, and where, and which lists a folder has.

``official``
    As the study published and generated its stimuli::

        labels.csv                              as in PhysionTest-Core: <stimulus>_img, True/False
        stimulus_names_and_labels.csv           as published; URLs are paths below the folder, and
                                                the responses of people ("correct") are empty
        Dominoes/maps/<stimulus>_map.png        PhysionTest-Core: the testing split
        Dominoes/mp4s/<stimulus>_img.mp4        free colours
        Dominoes/mp4s-redyellow/<config>-redyellow_0000_img.mp4
        configurations/Dominoes/<config>/0000.hdf5      as the generator writes a configuration,
                                        /0000_img.mp4   every split
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
    ``pretraining_val`` (the first trial of each scenario, and a tenth by the hash of the name) in
    free colours from the training split, ``readout_train_redyellow`` from readout,
    ``readout_test_redyellow`` from testing.

``physion-evaluator``
    ``physion_mp4s/train/<name>.mp4`` (readout split) and ``physion_mp4s/test`` (testing split) with
    ``all_video_labels.json``, for neuroailab/physion_evaluator; the folder is its
    ``data_root_path``. Names have the words by which it finds scenarios; it has no Drape.

``mp4s``
    The study's downloads of movies, for pairlab/SlotFormer and object_centric_bench;
    the folder is their ``data_root``::

        PhysionTrainMP4s/Dominoes_training_MP4s/<stimulus>_img.mp4      free colours
                        /Dominoes_readout_MP4s/<stimulus>_img.mp4       red and yellow
                        /readout_labels.csv                             <stimulus>, True/False
        PhysionTestMP4s/Dominoes/maps, mp4s, mp4s-redyellow             as in ``official``
                       /labels.csv
        splits/Physion/training_train.json, ...     lists of files, which SlotFormer has in its own
                                                    folder; validation as in ``physopt``

``hdf5s``
    The study's downloads of HDF5 files: ``Dominoes/hdf5s/<stimulus>.hdf5`` of the testing split,
    ``Dominoes_training_HDF5s/<stimulus>.hdf5`` and ``Dominoes_readout_HDF5s`` of the others.

A trial called ``dominoes_testing_0007`` is number 0007 of the configuration ``dominoes_testing``.
Scenario folders are capitalised, as in the published archives. As there, what has no ``-redyellow``
in its name shows natural colours, except the readout split, which is red and yellow; so are the
movies of physion_evaluator, which cannot read names with ``-redyellow``.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from physion.compute.run_tasks import RunReport, run_tasks
from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import folder_for_writing, remove_leftovers, write_atomic
from physion.core.names import FOLDERS, evaluator_name
from physion.core.seeds import stable_hash
from physion.trials.dataset import Dataset
from physion.trials.files import IndexedFile, Metadata, TrialPaths, encode_png
from physion.trials.making.pairs import without_pairs
from physion.trials.official.names import (
    EVALUATOR_LABELS,
    EVALUATOR_SPLITS,
    redyellow_name,
    shown_name,
    split_name,
)
from physion.trials.official.read_file import OfficialFile
from physion.trials.official.write_file import trial_stats
from physion.trials.trial_file import Trial
from physion.trials.video import MovieEncoder

# Lists of all trials in an exported folder, written from the exported files themselves.


def write_core_lists(out: Path) -> tuple[Path, dict[str, str]]:
    """Write metadata.json, trial_stats.json and the lists of the layout ``official``.

    Returns the path of ``labels.csv``, and errors by path of unreadable files.
    """
    by_folder: dict[Path, list[dict[str, Any]]] = defaultdict(list)
    failed = {}
    for path in sorted(out.glob("configurations/*/*/[0-9][0-9][0-9][0-9].hdf5")):
        try:
            with OfficialFile.open(path) as file:
                by_folder[path.parent].append(json.loads(file.text("physion/record")))
        except (BadInputError, ValueError) as error:
            failed[str(path.relative_to(out))] = f"{error}; delete it to make it again"
    rows = []
    for folder, records in by_folder.items():
        write_atomic(folder / "metadata.json", _json(records))
        write_atomic(folder / "trial_stats.json", _json(trial_stats(records)))
        rows += [row for record in records if (row := _list_row(out, folder, record))]
    labels = [("", "ground truth outcome")]
    labels += [(f"{row['stim_ID']}_img", row["label"]) for row in rows]
    write_atomic(out / "labels.csv", _csv(labels))
    columns = ("stim_ID", "scenario", "stim_url", "map_url", "hdf5_url", "correct", "label")
    table = [columns, *(tuple(row[column] for column in columns) for row in rows)]
    write_atomic(out / "stimulus_names_and_labels.csv", _csv(table))
    return out / "labels.csv", failed


def _list_row(out: Path, folder: Path, record: Mapping[str, Any]) -> dict[str, str] | None:
    """Return the row of a trial in the lists of PhysionTest-Core; None for other trials."""
    stimulus, core = str(record["stimulus_name"]), out / folder.parent.name
    files = {
        "stim_url": core / "mp4s" / f"{stimulus}_img.mp4",
        "map_url": core / "maps" / f"{stimulus}_map.png",
        "hdf5_url": folder / f"{split_name(stimulus)[1]}.hdf5",
    }
    if not files["stim_url"].is_file():
        return None
    titles = {title: name for name, title in FOLDERS.items()}
    return {
        "stim_ID": stimulus,
        "scenario": titles.get(core.name, core.name),
        **{column: path.relative_to(out).as_posix() for column, path in files.items()},
        "correct": "",
        "label": str(bool(record["does_target_contact_zone"])),
    }


def write_evaluator_labels(out: Path) -> tuple[Path, dict[str, str]]:
    """Write ``all_video_labels.json`` of both phases of the layout ``physion-evaluator``.

    Each movie's name without ending has ``label`` and ``contact_frame_label``: the first frame of
    contact, or half the number of frames, as in ``get_label`` of its ``dataloader_mp4s.py``.
    """
    failed, folder = {}, out / "physion_mp4s"
    for phase in sorted(path.parent for path in folder.glob("*/records")):
        labels = {}
        for path in sorted(phase.glob("records/*.json")):
            try:
                record = json.loads(path.read_bytes())
                labels[path.stem] = {
                    name: record[name] for name in ("label", "contact_frame_label")
                }
            except (OSError, ValueError, KeyError, TypeError) as error:
                failed[str(path.relative_to(out))] = f"{error!r}; delete it to make it again"
        write_atomic(phase / EVALUATOR_LABELS, _json(labels))
    return folder, failed


def write_movie_lists(out: Path) -> tuple[Path, dict[str, str]]:
    """Write the lists of labels of the layout ``mp4s``, and the lists of files for SlotFormer."""
    failed: dict[str, str] = {}
    labels: dict[str, list[tuple[str, str]]] = {"readout": [], "testing": []}
    files: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for path in sorted(out.glob(f"{RECORDS}/*/*/*.json")):
        stimulus, folder, split = path.stem, path.parent.name, path.parent.parent.name
        try:
            label = bool(json.loads(path.read_bytes())["label"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            failed[str(path.relative_to(out))] = f"{error!r}; delete it to make it again"
            continue
        if split in labels:
            labels[split].append((stimulus, str(label)))
        subset = {"testing": "test"}.get(split, split)
        part = "test"
        if split != CORE_SPLIT:
            first = not files[f"{subset}_val"][folder]
            part = "val" if _is_held_out(stimulus, first) else "train"
        files[f"{subset}_{part}"][folder].append(_shown_movie(split, folder, stimulus))
    head = ("", "ground truth outcome")
    written = {
        "PhysionTrainMP4s/readout_labels.csv": labels["readout"],
        "PhysionTestMP4s/labels.csv": [(f"{name}_img", label) for name, label in labels["testing"]],
    }
    contents = {name: _csv([head, *rows]) for name, rows in written.items() if rows}
    contents |= {f"splits/Physion/{name}.json": _json(found) for name, found in files.items()}
    for name, content in contents.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(out / name, content)
    return out, failed


def _shown_movie(split: str, folder: str, stimulus: str) -> str:
    """Return the path of a movie below the folder of the layout ``mp4s``; red-yellow if tested."""
    if split == CORE_SPLIT:
        return f"PhysionTestMP4s/{folder}/mp4s-redyellow/{redyellow_name(stimulus)}_img.mp4"
    return f"PhysionTrainMP4s/{folder}_{split}_MP4s/{stimulus}_img.mp4"


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=4) + "\n").encode()


def _csv(rows: list[Any]) -> bytes:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue().encode()


CORE_SPLIT = "testing"
"""Split that PhysionTest-Core consists of."""
VALIDATION = 10
"""One of this many training trials is for validation in ``physopt`` and ``mp4s``."""
RECORDS = "records"
"""Folder of the layout ``mp4s`` with what its lists need to know of each trial."""


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

    ``files`` takes the trial's paths, and whether it is the first of its split and scenario.
    ``write_lists`` returns the path of the list, and errors by path of files that it cannot read.
    """

    files: Callable[[TrialPaths, bool], Files]
    write_lists: Callable[[Path], tuple[Path, dict[str, str]]]


def _stimulus(paths: TrialPaths) -> str:
    return "_".join(split_name(paths.trial))


def _folder(paths: TrialPaths) -> str:
    return FOLDERS.get(paths.scenario, paths.scenario)


def _plain_look(split: str) -> str | None:
    """Return the look of files whose names say nothing of colours; None is the trial's own."""
    return None if split == "readout" else "free"


def _core(paths: TrialPaths) -> Files:
    """Return the files of a testing trial in PhysionTest-Core."""
    stimulus, folder = _stimulus(paths), _folder(paths)
    return {
        f"{folder}/mp4s/{stimulus}_img.mp4": Content("movie", "free"),
        f"{folder}/mp4s-redyellow/{redyellow_name(stimulus)}_img.mp4": Content(
            "movie", "redyellow"
        ),
        f"{folder}/maps/{stimulus}_map.png": Content("map"),
    }


def _official(paths: TrialPaths, _first: bool) -> Files:
    config, number = split_name(paths.trial)
    look = _plain_look(paths.split)
    place = f"configurations/{_folder(paths)}/{config}/{number}"
    files = {f"{place}_img.mp4": Content("movie", look), f"{place}_map.png": Content("map")}
    if paths.split == CORE_SPLIT:
        files |= _core(paths)
    return files | {f"{place}.hdf5": Content("state", look)}


def _physion_particles(paths: TrialPaths, _first: bool) -> Files:
    place = f"{paths.split}/{_folder(paths)}/{_stimulus(paths)}.hdf5"
    return {place: Content("state", _plain_look(paths.split))}


def _is_held_out(trial: str, first: bool) -> bool:
    """Return whether a training trial is for validation: the first one, and a tenth by its name."""
    return first or stable_hash("validation", trial) % VALIDATION == 0


def _physopt(paths: TrialPaths, first: bool) -> Files:
    held_out = _is_held_out(paths.trial, first)
    parts = {
        "training": ("pretraining_val" if held_out else "pretraining_train", "free"),
        "readout": ("readout_train_redyellow", "redyellow"),
        "testing": ("readout_test_redyellow", "redyellow"),
    }
    if paths.split not in parts:
        return {}
    part, look = parts[paths.split]
    name = shown_name(paths.trial, paths.split, look)
    return {f"physion_data/{part}/{_folder(paths)}/{name}.hdf5": Content("state", look)}


def _physion_evaluator(paths: TrialPaths, _first: bool) -> Files:
    phase = EVALUATOR_SPLITS.get(paths.split)
    if phase is None or paths.scenario == "drape":
        return {}
    name, folder = evaluator_name(_stimulus(paths), paths.scenario), f"physion_mp4s/{phase}"
    return {
        f"{folder}/{name}.mp4": Content("movie", "redyellow"),
        f"{folder}/records/{name}.json": Content("record", "redyellow"),
    }


def _mp4s(paths: TrialPaths, _first: bool) -> Files:
    stimulus, folder = _stimulus(paths), _folder(paths)
    if paths.split == CORE_SPLIT:
        files = {f"PhysionTestMP4s/{path}": content for path, content in _core(paths).items()}
    elif paths.split in ("training", "readout"):
        look = "free" if paths.split == "training" else "redyellow"
        files = {_shown_movie(paths.split, folder, stimulus): Content("movie", look)}
    else:
        return {}
    return files | {f"{RECORDS}/{paths.split}/{folder}/{stimulus}.json": Content("record")}


def _hdf5s(paths: TrialPaths, _first: bool) -> Files:
    folder = _folder(paths)
    place = f"{folder}/hdf5s" if paths.split == CORE_SPLIT else f"{folder}_{paths.split}_HDF5s"
    return {f"{place}/{_stimulus(paths)}.hdf5": Content("state", _plain_look(paths.split))}


def _no_lists(out: Path) -> tuple[Path, dict[str, str]]:
    return out, {}


LAYOUTS: Mapping[str, Layout] = {
    "official": Layout(_official, write_core_lists),
    "physion-particles": Layout(_physion_particles, _no_lists),
    "physopt": Layout(_physopt, _no_lists),
    "physion-evaluator": Layout(_physion_evaluator, write_evaluator_labels),
    "mp4s": Layout(_mp4s, write_movie_lists),
    "hdf5s": Layout(_hdf5s, _no_lists),
}
"""Layouts by name."""


_SAME = ("digest", "look", "width", "height", "playback_rate", "package")
"""Metadata that an exported file must share with its trial to be kept."""
_IMAGE = "frames/0000/images/_img"


@dataclass(frozen=True)
class ExportJob:
    """One trial to export.

    - ``paths``: files of the trial.
    - ``out``, ``files``: folder to write into, and contents by path below it; the last is written
      last.
    - ``stored``: files of the index by column: trial file, own movie, and that in free colours.
    - ``images``: whether HDF5 files get pictures.
    """

    paths: TrialPaths
    out: Path
    files: Files
    stored: Mapping[str, IndexedFile]
    images: bool = True

    @property
    def last(self) -> tuple[Path, Content]:
        """Path and content of the file that is written last."""
        name, content = list(self.files.items())[-1]
        return self.out / name, content


def export_official(
    dataset: Path,
    out: Path,
    *,
    layout: str = "official",
    verify: bool = True,
    split: str | None = None,
    scenario: str | None = None,
    images: bool = True,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Export trials of a dataset in a layout of published code.

    Exported trials with the same motion and look are kept. Lists are then written for everything
    in ``out``. An error in one trial is reported and does not stop the others.

    Parameters
    ----------
    dataset, out
        Folder of the dataset, and folder to write into, outside the dataset.
    layout
        One of `LAYOUTS`. Trials that have no place in it are named in the notes.
    verify
        Compare trial files and movies with their SHA-256 in the index.
    split, scenario
        Trials to export; by default all.
    images
        Whether HDF5 files get pictures; without, they are made 20 times as fast.
    executor
        Where to run; by default one process per core.
    progress
        Shows the progress.

    Raises
    ------
    BadInputError
        If ``dataset`` is not a dataset, it has no such trials, two trials would have the same
        name, or ``out`` cannot be written.
    UnknownNameError
        For an unknown layout.
    """
    if layout not in LAYOUTS:
        raise UnknownNameError("layout", layout, LAYOUTS)
    source = without_pairs(Dataset(dataset, verify=verify))
    names = source.trials(split, scenario)
    if not names:
        raise BadInputError(
            f"{dataset} has no trial of split {split or 'any'!r} and scenario {scenario or 'any'!r}"
        )
    files = {column: source.files(column) for column in ("trial_file", "movie", "free_movie")}
    planned = {}
    by_position = source.index.sort_values("index")
    first = set(by_position.groupby(["split", "scenario"])["trial"].first())
    for name in names:
        stored = {column: found[name] for column, found in files.items() if name in found}
        paths = source.paths(name)
        wanted = LAYOUTS[layout].files(paths, name in first)
        planned[name] = ExportJob(paths, out, wanted, stored, images)
    jobs = {name: job for name, job in planned.items() if job.files}
    notes = _without_place(planned, layout)
    if not jobs:
        raise BadInputError(f"{dataset}: {notes[layout][0]}")
    _check(jobs, dataset, out)
    with folder_for_writing(out):
        remove_leftovers(out)
        kept = {name for name, job in jobs.items() if _is_done(job)}
        missing = {name: job for name, job in jobs.items() if name not in kept}
        made, failed = run_tasks(
            export_trial,
            missing,
            folder=out,
            what="exporting",
            executor=executor,
            progress=progress,
        )
        index, broken = LAYOUTS[layout].write_lists(out)
    in_order = tuple(name for name in jobs if name in kept)
    return RunReport(tuple(made), in_order, {**failed, **broken}, index, notes)


def _without_place(planned: Mapping[str, ExportJob], layout: str) -> dict[str, tuple[str, ...]]:
    """Return a note on the trials that the layout has no files for, by name of the layout."""
    left = Counter(
        f"{job.paths.split} {job.paths.scenario}" for job in planned.values() if not job.files
    )
    if not left:
        return {}
    kinds = ", ".join(f"{count} {kind}" for kind, count in left.items())
    return {layout: (f"{left.total()} trials have no place in this layout ({kinds})",)}


def export_trial(job: ExportJob) -> str:
    """Write all files of one trial; return its name."""
    file = job.stored["trial_file"]
    trial = Trial(file.read(), f"trial file {file.path}")
    if not np.isfinite(trial.trajectory.positions).all() and "state" in _kinds(job):
        raise BadInputError(
            f"the motion of trial {job.paths.trial!r} is unknown (it was imported from a movie "
            "only), and official files require it"
        )
    made = {name: _content(job, trial, content) for name, content in job.files.items()}
    for name, data in made.items():
        path = job.out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, data)
    return job.paths.trial


def _kinds(job: ExportJob) -> set[str]:
    return {content.kind for content in job.files.values()}


def _content(job: ExportJob, trial: Trial, content: Content) -> bytes:
    """Return the bytes of one file."""
    # Imported late: loading engine and renderer takes time.
    from physion.rendering.renderer import role_map
    from physion.trials.official.write_file import official_file

    if content.kind == "state":
        return official_file(trial, look=content.look, images=job.images)[0]
    if content.kind == "map":
        return encode_png(role_map(trial.ids, trial.scene))
    if content.kind == "record":
        return json.dumps(_record(trial.metadata, content) | _label(trial)).encode()
    return _movie(job, trial, content.look or trial.metadata.look)


def _record(meta: Metadata, content: Content) -> dict[str, Any]:
    values = dataclasses.asdict(meta) | {"look": content.look or meta.look}
    return {name: values[name] for name in _SAME}


def _label(trial: Trial) -> dict[str, Any]:
    labels = trial.known_labels()
    first = labels.first_frame if labels.contact else None
    frame = trial.metadata.frames // 2 if first is None else first
    return {"label": labels.contact, "contact_frame_label": frame}


def _movie(job: ExportJob, trial: Trial, look: str) -> bytes:
    """Return the movie of the trial in a look: as in the index if there is one, else rendered."""
    meta = trial.metadata
    column = "movie" if look == meta.look else "free_movie" if look == "free" else None
    if column is not None and column in job.stored:
        return job.stored[column].read()
    if not np.isfinite(trial.trajectory.positions).all():
        raise BadInputError(
            f"trial {job.paths.trial!r} has no movie in the look {look!r}, and its motion is "
            "unknown, so none can be rendered"
        )
    encoder = MovieEncoder(meta.width, meta.height, meta.frames, rate=meta.playback_rate)
    renderer = trial.renderer(look=look)
    for frame in range(meta.frames):
        color = renderer.render(frame).color
        assert color is not None
        encoder.add(color)
    return encoder.finish()


def _check(jobs: Mapping[str, ExportJob], dataset: Path, out: Path) -> None:
    """Raise `BadInputError` if ``out`` is in the dataset or two trials would share a file."""
    if out.resolve().is_relative_to(dataset.resolve()):
        raise BadInputError(f"{out} lies in the dataset {dataset}; choose a folder outside it")
    seen: dict[str, str] = {}
    for name, job in jobs.items():
        # Some file systems do not distinguish upper and lower case.
        other = seen.setdefault(str(job.last[0]).lower(), name)
        if other != name:
            raise BadInputError(
                f"trials {other!r} and {name!r} would both be {job.last[0]}; export them by "
                "--split or --scenario into different folders"
            )


def _is_done(job: ExportJob) -> bool:
    """Return whether all files of the trial exist and the last one has its motion and look."""
    if not all((job.out / name).is_file() for name in job.files):
        return False
    path, content = job.last
    try:
        wanted = _record(Trial.open(job.paths.trial_file).metadata, content)
        found = json.loads(path.read_bytes()) if content.kind == "record" else _stored(path, job)
    except (BadInputError, OSError, ValueError):
        return False
    return isinstance(found, dict) and all(found.get(name) == wanted[name] for name in _SAME)


def _stored(path: Path, job: ExportJob) -> Any:
    """Return the metadata in an exported HDF5 file; None if it lacks wanted pictures."""
    with OfficialFile.open(path) as file:
        if job.images and not file.has(_IMAGE):
            return None
        return json.loads(file.text("physion/metadata"))
