"""Export of a dataset as tar shards for webdataset: training over a network or from object stores.

A sample is one trial: the files of one shard that share a key, distinguished by what follows the
first dot. Keys are trial names with dots replaced by underscores. Information that a predictor may
use and information about the outcome are in separate files:

- ``json``: name, scenario, look, picture size, length of the observed part.
- ``observed.mp4``, ``free_observed.mp4``: the observed frames alone, in the trial's look and free.
- ``map.png``: agent and patient in the first frame.
- ``outcome.json``: label, length, seed and all other columns of the index: the answer.
- ``full.mp4``, ``free_full.mp4``, ``trial.hdf5``: the future. The last is the trial's ``.h5``
  file; webdataset takes an extension ``h5`` for a picture (``IMAGE_EXTENSIONS`` in its
  ``autodecode.py``) and fails at it with ``decode("pil")``.

Equal datasets and options give equal bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from physion.compute.run_tasks import run_tasks
from physion.compute.tasks import Executor, Progress, TaskOutcome
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import folder_for_writing, remove_leftovers, write_atomic
from physion.trials.files import TrialPaths
from physion.trials.index import COLUMNS, read_index

MANIFEST = "shards.json"
"""File that lists the shards of a folder; rewritten with every shard, ``complete`` at the end."""
SHARD_BYTES = 2**28
LAYOUT = 2
"""Version of names and contents of the files in a sample."""

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
    """One tar file: its ``split``, number of ``samples``, size in ``bytes`` and ``sha256``.

    ``contents`` is a digest of the content, which is known before the file is made.
    """

    name: str
    split: str
    samples: int
    contents: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class ShardReport:
    """All ``shards`` of a folder, names of those ``made`` now, and path of the ``manifest``."""

    shards: tuple[Shard, ...]
    made: tuple[str, ...]
    manifest: Path

    @property
    def samples(self) -> int:
        """Number of trials in all shards."""
        return sum(shard.samples for shard in self.shards)

    @property
    def bytes(self) -> int:
        """Size of all shards in bytes."""
        return sum(shard.bytes for shard in self.shards)


@dataclass(frozen=True)
class _Sample:
    """One planned sample: texts, and files with expected size and SHA-256, by extension."""

    key: str
    split: str
    texts: Mapping[str, bytes]
    files: Mapping[str, tuple[Path, int, str]]

    def sizes(self) -> list[int]:
        """Return the sizes in bytes of the files of the sample."""
        return [len(text) for text in self.texts.values()] + [f[1] for f in self.files.values()]

    def digest(self) -> str:
        """Return a digest of the content of the sample."""
        known = {ending: hashlib.sha256(text).hexdigest() for ending, text in self.texts.items()}
        known |= {ending: sha for ending, (_, _, sha) in self.files.items()}
        return hashlib.sha256(json.dumps([self.key, known], sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class _ShardTask:
    """One shard to write: its path, its samples, and the digest of their content."""

    path: Path
    samples: tuple[_Sample, ...]
    contents: str


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
) -> ShardReport:
    """Write trials of the dataset in ``folder`` as tar shards into ``out``.

    Shards are called ``physion-<split>-000000.tar`` and contain trials in the order of the index.
    Every file is compared with its SHA-256 in the index. An interrupted export is continued by the
    same call; shards whose trials have changed are made again.

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

    Raises
    ------
    BadInputError
        If a file is not the one in the index (the shards without such files are written), or
        ``out`` contains other files or shards of other options.
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
    table = _select(read_index(folder), split, scenario)
    plan = _plan(_samples(folder, table, sorted(set(parts))), shard_bytes)
    options = {"layout": LAYOUT, "dataset": sorted(set(table["dataset"])), "split": split}
    options |= {"scenario": scenario, "parts": sorted(set(parts)), "shard_bytes": shard_bytes}
    with folder_for_writing(out):
        remove_leftovers(out)
        return _write_all(out, plan, options, executor, progress)


def _select(table: pd.DataFrame, split: str | None, scenario: str | None) -> pd.DataFrame:
    for column, wanted in (("split", split), ("scenario", scenario)):
        if wanted is not None:
            if wanted not in set(table[column]):
                raise UnknownNameError(column, wanted, set(table[column]))
            table = table[table[column] == wanted]
    if table.empty:
        raise BadInputError(
            "there is no trial to export: the index has none of this split and scenario"
        )
    return table


def _samples(folder: Path, table: pd.DataFrame, parts: Sequence[str]) -> list[_Sample]:
    keys = table["trial"].str.replace(".", "_", regex=False)
    if keys.duplicated().any():
        twice = sorted(table["trial"][keys.duplicated(keep=False)])
        raise BadInputError(f"trials {twice[:2]} differ in dots only, which keys cannot contain")
    return [
        _sample(folder, key, row, parts)
        for key, row in zip(keys, table.to_dict("records"), strict=True)
    ]


def _sample(folder: Path, key: str, row: Mapping[str, Any], parts: Sequence[str]) -> _Sample:
    paths = TrialPaths(folder, row["split"], row["scenario"], row["trial"])
    files = {
        # Paths in the index could point outside the folder; those of the layout cannot.
        part: (getattr(paths, column), int(row[f"{column}_bytes"]), str(row[f"{column}_sha256"]))
        for part, column in FILE_PARTS.items()
        if part in parts and not pd.isna(row[column])
    }
    columns_of = {"json": SEEN_COLUMNS, "outcome.json": COLUMNS}
    texts = {
        part: json.dumps({name: _plain(row[name]) for name in columns}, sort_keys=True).encode()
        for part, columns in columns_of.items()
        if part in parts
    }
    return _Sample(key, row["split"], texts, files)


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
        size = sum(_BLOCK * (4 + -(-bytes_ // _BLOCK)) for bytes_ in sample.sizes())
        if sample.split not in counts or size > capacity:
            counts[sample.split] = counts.get(sample.split, -1) + 1
            # The end of an archive is padded to a whole record.
            capacity = shard_bytes - tarfile.RECORDSIZE
        capacity -= size
        name = f"physion-{sample.split}-{counts[sample.split]:06d}.tar"
        plan.setdefault(name, []).append(sample)
    return plan


def _write_all(
    out: Path,
    plan: Mapping[str, Sequence[_Sample]],
    options: Mapping[str, Any],
    executor: Executor | None,
    progress: Progress | None,
) -> ShardReport:
    before = _known_shards(out, options)
    done: dict[str, Shard] = {}
    missing: dict[str, _ShardTask] = {}
    for name, samples in plan.items():
        contents = hashlib.sha256("".join(s.digest() for s in samples).encode()).hexdigest()
        known = before.get(name)
        if known is None or known.contents != contents or not _is_whole(out / name, known):
            missing[name] = _ShardTask(out / name, tuple(samples), contents)
        else:
            done[name] = known

    def list_shard(outcome: TaskOutcome[Shard]) -> None:
        if outcome.error is None:
            done[outcome.key] = outcome.value
            # Shards of an earlier plan stay listed until their files are deleted.
            _write_manifest(out, options, {**before, **done}, complete=False)

    made, failed = run_tasks(
        _write_shard,
        missing,
        folder=out,
        what="shards",
        executor=executor,
        progress=progress,
        on_outcome=list_shard,
    )
    if failed:
        more = f" (and {len(failed) - 1} more shards failed)" if len(failed) > 1 else ""
        raise BadInputError(f"{next(iter(failed.values()))}{more}")
    for name in before.keys() - done.keys():
        (out / name).unlink(missing_ok=True)
    _write_manifest(out, options, done, complete=True)
    return ShardReport(tuple(done[name] for name in plan), tuple(made), out / MANIFEST)


def _write_shard(task: _ShardTask) -> Shard:
    """Write one shard atomically."""
    data = _archive(task.samples)
    write_atomic(task.path, data)
    sha, split = hashlib.sha256(data).hexdigest(), task.samples[0].split
    return Shard(task.path.name, split, len(task.samples), task.contents, len(data), sha)


def _archive(samples: Sequence[_Sample]) -> bytes:
    """Return the bytes of one shard."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for sample in samples:
            for part in sorted((*sample.texts, *sample.files)):
                data = sample.texts[part] if part in sample.texts else _read(*sample.files[part])
                # Owner, time and mode are the constant defaults of tarfile.
                member = tarfile.TarInfo(f"{sample.key}.{part}")
                member.size = len(data)
                archive.addfile(member, io.BytesIO(data))
    return buffer.getvalue()


def _read(path: Path, size: int, sha: str) -> bytes:
    """Return the bytes of a file; `BadInputError` unless they match size and SHA-256."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInputError(f"{path} cannot be read: {error.strerror}") from error
    if len(data) != size or hashlib.sha256(data).hexdigest() != sha:
        raise BadInputError(f"{path} is not the file of the index; run `physion verify` on it")
    return data


def _is_whole(path: Path, shard: Shard) -> bool:
    """Return whether the file of a shard exists and is unchanged."""
    if not path.is_file() or path.stat().st_size != shard.bytes:
        return False
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == shard.sha256


def _known_shards(out: Path, options: Mapping[str, Any]) -> dict[str, Shard]:
    """Return the shards listed in the manifest of ``out``; none for a new or empty folder."""
    path = out / MANIFEST
    if not path.is_file():
        others = sorted(item.name for item in out.iterdir() if not item.name.startswith("."))
        # An export that was killed early leaves one shard and no manifest.
        if others and not all(name.startswith("physion-") for name in others):
            raise BadInputError(
                f"{out} contains {others[0]!r} and no {MANIFEST}; choose an empty or new folder"
            )
        return {}
    try:
        known = json.loads(path.read_text(encoding="utf-8", errors="replace"))
        before = {item["name"]: Shard(**item) for item in known["shards"]}
        stored_options = known["options"]
    except (ValueError, KeyError, TypeError) as error:
        raise BadInputError(
            f"{path} is damaged ({error}); delete it to export everything again"
        ) from error
    if stored_options != options:
        raise BadInputError(
            f"{out} contains shards of other options, see {path}; choose another folder"
        )
    if not all(name.startswith("physion-") and Path(name).name == name for name in before):
        raise BadInputError(f"{path} lists files that are not shards; choose another folder")
    return before


def _write_manifest(
    out: Path, options: Mapping[str, Any], shards: Mapping[str, Shard], complete: bool
) -> None:
    listed = [asdict(shard) for _, shard in sorted(shards.items())]
    splits: dict[str, dict[str, int]] = {}
    for shard in shards.values():
        total = splits.setdefault(shard.split, {"samples": 0, "bytes": 0, "shards": 0})
        total["samples"] += shard.samples
        total["bytes"] += shard.bytes
        total["shards"] += 1
    content = {"complete": complete, "options": options, "splits": splits, "shards": listed}
    text = json.dumps(content, indent=1, sort_keys=True) + "\n"
    write_atomic(out / MANIFEST, text.encode())
