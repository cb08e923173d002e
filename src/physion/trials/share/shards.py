"""Export of a dataset as tar shards for webdataset: training over a network or from object stores.

A sample is one trial: the files of one shard that share a key, distinguished by what follows the
first dot. Keys are trial names with dots replaced by underscores. Information that a predictor may
use and information about the outcome are in separate files:

- ``json``: name, scenario, look, picture size, length of the observed part.
- ``observed.mp4``, ``free_observed.mp4``: only the observed frames, in the trial's look and free.
- ``map.png``: agent and patient in the first frame.
- ``outcome.json``: label, length, seed and all other columns of the index: the answer.
- ``full.mp4``, ``free_full.mp4``, ``trial.hdf5``: the future. The last is the trial's ``.h5``
  file; webdataset takes an extension ``h5`` for a picture (``IMAGE_EXTENSIONS`` in its
  ``autodecode.py``) and fails at it with ``decode("pil")``.

Equal datasets and options give equal bytes. Next to each shard is its digest file.
"""

from __future__ import annotations

import io
import json
import re
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from physion.compute.run_tasks import run_tasks
from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import (
    digest_path,
    folder_for_writing,
    remove_leftovers,
    write_atomic,
    write_with_digest,
)
from physion.core.settings import read_json
from physion.trials.dataset import indexed_file
from physion.trials.files import IndexedFile
from physion.trials.index import COLUMNS, read_index

MANIFEST = "shards.json"
"""File that lists the shards of a folder, written last."""
SHARD_BYTES = 2**28

FILE_PARTS: Mapping[str, str] = {
    "full.mp4": "movie",
    "free_full.mp4": "free_movie",
    "free_observed.mp4": "free_observed_movie",
    "map.png": "map",
    "observed.mp4": "observed_movie",
    "trial.hdf5": "trial_file",
}
"""Columns of the index that name the files of a sample, by the extension in the sample."""
_NAMES, _PICTURE = ("trial", "dataset", "scenario", "split"), ("look", "width", "height")
SEEN_COLUMNS = (*_NAMES, *_PICTURE, "observed_frames")
"""Columns of the index that reveal nothing about the outcome."""
SEEN_PARTS = ("free_observed.mp4", "json", "map.png", "observed.mp4")
"""Parts that may be given to a model or participant that predicts."""
PARTS = tuple(sorted((*FILE_PARTS, "json", "outcome.json")))
"""All parts, in their order in a sample."""

_BLOCK = tarfile.BLOCKSIZE


@dataclass(frozen=True)
class Shard:
    """One tar file: its ``split``, number of ``samples``, and size in ``bytes``."""

    name: str
    split: str
    samples: int
    bytes: int


class _Sample(NamedTuple):
    """One planned sample: its texts and its files by extension, and the size of all in a shard."""

    key: str
    split: str
    texts: Mapping[str, bytes]
    files: Mapping[str, IndexedFile]
    bytes: int


def export_shards(
    folder: Path,
    out: Path,
    *,
    split: str | None = None,
    scenario: str | None = None,
    parts: Sequence[str] = PARTS,
    shard_bytes: int = SHARD_BYTES,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> list[Shard]:
    """Write trials of the dataset in ``folder`` as tar shards into ``out``.

    Shards are called ``physion-<split>-000000.tar`` and contain trials in the order of the index.
    Every file is compared with its SHA-256 in the index. Shards of an earlier export are replaced.

    Parameters
    ----------
    folder, out
        Folder of the dataset, and folder to write into.
    split, scenario
        Trials to export; by default all.
    parts
        Files of a sample; `SEEN_PARTS` gives shards without answer and future. Files that a trial
        does not have are left out.
    shard_bytes
        Largest size of a shard; a trial that is larger has a shard of its own.
    executor
        Where to run; by default one process per core.
    progress
        Shows the progress.

    Returns
    -------
    shards
        All shards of the folder, which the file `MANIFEST` in it lists.

    Raises
    ------
    BadInputError
        If a file is not the one in the index (the shards without such files are written), or
        ``out`` contains other files, or shards of other options.
    PhysionError
        If nothing more can be written into ``out``.
    UnknownNameError
        For an unknown split, scenario or part.
    """
    for part in parts:
        if part not in PARTS:
            raise UnknownNameError("part", part, PARTS)
    if shard_bytes < 1 or not parts:
        raise BadInputError(
            f"shards need at least one part and a size above 0, not {shard_bytes} bytes"
        )
    table = read_index(folder)
    for column, wanted in (("split", split), ("scenario", scenario)):
        if wanted is not None and wanted not in set(table[column]):
            raise UnknownNameError(column, wanted, set(table[column]))
        table = table if wanted is None else table[table[column] == wanted]
    if table.empty:
        raise BadInputError(f"{folder} has no trial of split {split} and scenario {scenario}")
    chosen = sorted(set(parts))
    plan = _plan(_samples(folder, table, chosen), shard_bytes)
    options: dict[str, Any] = {
        "dataset": sorted(set(table["dataset"])),
        "split": split,
        "scenario": scenario,
        "parts": chosen,
        "shard_bytes": shard_bytes,
    }
    with folder_for_writing(out):
        remove_leftovers(out)
        _check_folder(out, options)
        (out / MANIFEST).unlink(missing_ok=True)
        made, failed = run_tasks(
            _write_shard,
            {name: (out / name, samples) for name, samples in plan.items()},
            folder=out,
            what="shards",
            executor=executor,
            progress=progress,
        )
        if failed:
            more = f" (and {len(failed) - 1} more shards failed)" if len(failed) > 1 else ""
            raise BadInputError(f"{next(iter(failed.values()))}{more}")
        for path in out.glob("physion-*.tar"):
            if path.name not in plan:
                path.unlink()
                digest_path(path).unlink(missing_ok=True)
        shards = list(made.values())
        _write_manifest(out / MANIFEST, options, shards)
    return shards


def _check_folder(out: Path, options: Mapping[str, Any]) -> None:
    """Raise `BadInputError` for a folder with other files, or with shards of other options."""
    ours = re.compile(r"physion-.+\.tar(\.sha256)?|" + re.escape(MANIFEST))
    names = sorted(path.name for path in out.iterdir() if not path.name.startswith("."))
    if other := [name for name in names if not ours.fullmatch(name)]:
        raise BadInputError(f"{out} contains {other[0]!r}; choose an empty or new folder")
    path = out / MANIFEST
    if path.is_file() and read_json(path, dict[str, Any]).get("options") != options:
        raise BadInputError(
            f"{out} contains shards of other options, see {path}; choose another folder"
        )


def _samples(folder: Path, table: pd.DataFrame, parts: Sequence[str]) -> list[_Sample]:
    keys = table["trial"].str.replace(".", "_", regex=False)
    if keys.duplicated().any():
        twice = sorted(table["trial"][keys.duplicated(keep=False)])
        raise BadInputError(f"trials {twice[:2]} differ in dots only, which keys cannot contain")
    samples = []
    for key, row in zip(keys, table.to_dict("records"), strict=True):
        columns_of = {"json": SEEN_COLUMNS, "outcome.json": tuple(COLUMNS)}
        texts = {
            part: json.dumps({n: _plain(row[n]) for n in columns}, sort_keys=True).encode()
            for part, columns in columns_of.items()
            if part in parts
        }
        files = {
            part: file
            for part, column in FILE_PARTS.items()
            if part in parts and (file := indexed_file(folder, row, column)) is not None
        }
        sizes = [len(text) for text in texts.values()]
        sizes += [int(row[f"{FILE_PARTS[part]}_bytes"]) for part in files]
        size = sum(_BLOCK * (4 + -(-size // _BLOCK)) for size in sizes)
        samples.append(_Sample(key, row["split"], texts, files, size))
    return samples


def _plain(value: Any) -> Any:
    """Return a cell of the index as a JSON value."""
    if pd.isna(value):
        return None
    return value.item() if hasattr(value, "item") else value


def _plan(samples: Iterable[_Sample], shard_bytes: int) -> dict[str, list[_Sample]]:
    """Return the samples by the name of their shard."""
    plan: dict[str, list[_Sample]] = {}
    counts: dict[str, int] = {}
    capacity = 0
    for sample in samples:
        if sample.split not in counts or sample.bytes > capacity:
            counts[sample.split] = counts.get(sample.split, -1) + 1
            # The end of an archive is padded to a whole record.
            capacity = shard_bytes - tarfile.RECORDSIZE
        capacity -= sample.bytes
        name = f"physion-{sample.split}-{counts[sample.split]:06d}.tar"
        plan.setdefault(name, []).append(sample)
    return plan


def _write_shard(task: tuple[Path, Sequence[_Sample]]) -> Shard:
    """Write one shard and its digest file."""
    path, samples = task
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for sample in samples:
            for part in sorted((*sample.texts, *sample.files)):
                data = sample.texts[part] if part in sample.texts else sample.files[part].read()
                # Owner, time and mode are the constant defaults of tarfile.
                member = tarfile.TarInfo(f"{sample.key}.{part}")
                member.size = len(data)
                archive.addfile(member, io.BytesIO(data))
    write_with_digest(path, buffer.getvalue())
    return Shard(path.name, samples[0].split, len(samples), len(buffer.getvalue()))


def _write_manifest(path: Path, options: Mapping[str, Any], shards: Sequence[Shard]) -> None:
    splits: dict[str, dict[str, int]] = {}
    for shard in shards:
        total = splits.setdefault(shard.split, {"samples": 0, "bytes": 0, "shards": 0})
        total["samples"] += shard.samples
        total["bytes"] += shard.bytes
        total["shards"] += 1
    content = {"options": options, "splits": splits, "shards": [asdict(one) for one in shards]}
    write_atomic(path, (json.dumps(content, indent=1, sort_keys=True) + "\n").encode())
