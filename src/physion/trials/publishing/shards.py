"""A dataset as tar shards that webdataset reads, for training over a network or from object stores.

A sample is one trial: files of one key in one shard, told apart by what follows the first dot.
What may be seen by who predicts, and what may not, never share a file:

- ``json``: name, scenario, look, picture size, length of the observed part.
- ``observed.mp4``, ``free_observed.mp4``: the observed frames alone, in the trial's look and free.
- ``map.png``: agent and patient in the first frame.
- ``outcome.json``: label, length, seed and all else of the index: the answer.
- ``full.mp4``, ``free_full.mp4``, ``trial.h5``: the future.

The same dataset and options give the same bytes. Keys are trial names with dots as underscores.
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

from physion.atomic import folder_lock, remove_leftovers, write_atomic
from physion.errors import BadInputError, UnknownNameError
from physion.trials.index import COLUMNS, read_index
from physion.trials.layout import TrialPaths

MANIFEST = "shards.json"
"""What the shards of a folder are: written anew with every shard, ``complete`` with the last."""
SHARD_BYTES = 2**28
LAYOUT = 1
"""Version of names and contents of the files in a sample."""

FILE_PARTS: Mapping[str, str] = {
    "full.mp4": "movie",
    "free_full.mp4": "free_movie",
    "free_observed.mp4": "free_observed_movie",
    "map.png": "map",
    "observed.mp4": "observed_movie",
    "trial.h5": "trial_file",
}
"""Extension in a sample, and the index column of the file that it is."""
_NAMES, _PICTURE = ("trial", "dataset", "scenario", "split"), ("look", "width", "height")
SEEN_COLUMNS = (*_NAMES, *_PICTURE, "observed_frames")
"""Columns of the index that tell nothing of what happens."""
SEEN_PARTS = ("free_observed.mp4", "json", "map.png", "observed.mp4")
"""Parts that may be given to who predicts."""
PARTS = tuple(sorted((*FILE_PARTS, "json", "outcome.json")))
"""All parts, in their order within a sample."""

_BLOCK = tarfile.BLOCKSIZE


@dataclass(frozen=True)
class Shard:
    """One tar file: ``split`` and count of ``samples``, ``bytes`` and ``sha256`` of the file.

    ``contents`` is a digest of what went in, known before the file is made.
    """

    name: str
    split: str
    samples: int
    contents: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class ShardReport:
    """The ``shards`` of a folder, which of them were ``made`` now, and the ``manifest``'s path."""

    shards: tuple[Shard, ...]
    made: tuple[str, ...]
    manifest: Path

    @property
    def samples(self) -> int:
        """Trials in all shards."""
        return sum(shard.samples for shard in self.shards)

    @property
    def bytes(self) -> int:
        """Size of all shards."""
        return sum(shard.bytes for shard in self.shards)


@dataclass(frozen=True)
class _Sample:
    """One trial to be: its texts by extension; its files with the sizes and hashes to find."""

    key: str
    split: str
    texts: Mapping[str, bytes]
    files: Mapping[str, tuple[Path, int, str]]

    def sizes(self) -> list[int]:
        """Bytes of every file in the sample."""
        return [len(text) for text in self.texts.values()] + [f[1] for f in self.files.values()]

    def digest(self) -> str:
        """Of all that will be in the sample."""
        known = {ending: hashlib.sha256(text).hexdigest() for ending, text in self.texts.items()}
        known |= {ending: sha for ending, (_, _, sha) in self.files.items()}
        return hashlib.sha256(json.dumps([self.key, known], sort_keys=True).encode()).hexdigest()


def export_shards(
    folder: Path,
    out: Path,
    *,
    split: str | None = None,
    scenario: str | None = None,
    parts: Sequence[str] = PARTS,
    shard_bytes: int = SHARD_BYTES,
) -> ShardReport:
    """Write the trials of ``folder``, or of one split and scenario, as tar shards into ``out``.

    Shards are called ``physion-<split>-000000.tar`` and hold trials in the order of the index, up
    to ``shard_bytes`` (a trial larger than that has a shard of its own). ``parts`` says which files
    a sample has: `SEEN_PARTS` gives shards that hold no answer and no future. Files that a trial
    does not have are left out.

    Every file is compared with its hash in the index on the way. A stopped call goes on where it
    stopped; shards of trials that have changed are made anew. Raises `BadInputError` where a file
    is not what the index says, or ``out`` holds something else or shards of other options, and
    `UnknownNameError` for an unknown split, scenario or part.
    """
    for part in parts:
        if part not in PARTS:
            raise UnknownNameError("part", part, PARTS)
    if shard_bytes < 1 or not parts:
        raise BadInputError(f"shards need a part and a size above 0, not {shard_bytes} bytes")
    table = _select(read_index(folder), split, scenario)
    plan = _plan(_samples(folder, table, sorted(set(parts))), shard_bytes)
    options = {"layout": LAYOUT, "dataset": sorted(set(table["dataset"])), "split": split}
    options |= {"scenario": scenario, "parts": sorted(set(parts)), "shard_bytes": shard_bytes}
    try:
        out.mkdir(parents=True, exist_ok=True)
        with folder_lock(out):
            remove_leftovers(out)
            return _write_all(out, plan, options)
    except OSError as error:
        raise BadInputError(f"cannot write into {out}: {error.strerror or error}") from error


def _select(table: pd.DataFrame, split: str | None, scenario: str | None) -> pd.DataFrame:
    for column, wanted in (("split", split), ("scenario", scenario)):
        if wanted is not None:
            if wanted not in set(table[column]):
                raise UnknownNameError(column, wanted, set(table[column]))
            table = table[table[column] == wanted]
    if table.empty:
        raise BadInputError("there is no trial to export: the index is empty, or its choice is")
    return table


def _samples(folder: Path, table: pd.DataFrame, parts: Sequence[str]) -> list[_Sample]:
    keys = table["trial"].str.replace(".", "_", regex=False)
    if keys.duplicated().any():
        twice = sorted(table["trial"][keys.duplicated(keep=False)])
        raise BadInputError(f"trials {twice[:2]} differ in dots alone, which keys may not have")
    return [
        _sample(folder, key, row, parts)
        for key, row in zip(keys, table.to_dict("records"), strict=True)
    ]


def _sample(folder: Path, key: str, row: Mapping[str, Any], parts: Sequence[str]) -> _Sample:
    paths = TrialPaths(folder, row["split"], row["scenario"], row["trial"])
    files = {
        # The paths of the index may point anywhere; those of the layout stay in the folder.
        part: (getattr(paths, column), int(row[f"{column}_bytes"]), str(row[f"{column}_sha256"]))
        for part, column in FILE_PARTS.items()
        if part in parts and not pd.isna(row[column])
    }
    told = {"json": SEEN_COLUMNS, "outcome.json": COLUMNS}
    texts = {
        part: json.dumps({name: _plain(row[name]) for name in columns}, sort_keys=True).encode()
        for part, columns in told.items()
        if part in parts
    }
    return _Sample(key, row["split"], texts, files)


def _plain(value: Any) -> Any:
    """A cell of the index as JSON has it."""
    if pd.isna(value):
        return None
    return value.item() if hasattr(value, "item") else value


def _plan(samples: Iterable[_Sample], shard_bytes: int) -> dict[str, list[_Sample]]:
    """Samples by the name of their shard."""
    plan: dict[str, list[_Sample]] = {}
    counts: dict[str, int] = {}
    room = 0
    for sample in samples:
        size = sum(_BLOCK * (4 + -(-bytes_ // _BLOCK)) for bytes_ in sample.sizes())
        if sample.split not in counts or size > room:
            counts[sample.split] = counts.get(sample.split, -1) + 1
            # The end of an archive is padded to a whole record.
            room = shard_bytes - tarfile.RECORDSIZE
        room -= size
        name = f"physion-{sample.split}-{counts[sample.split]:06d}.tar"
        plan.setdefault(name, []).append(sample)
    return plan


def _write_all(
    out: Path, plan: Mapping[str, Sequence[_Sample]], options: Mapping[str, Any]
) -> ShardReport:
    before = _known_shards(out, options)
    done: dict[str, Shard] = {}
    made = []
    for name, samples in plan.items():
        contents = hashlib.sha256("".join(s.digest() for s in samples).encode()).hexdigest()
        known = before.get(name)
        if known is None or known.contents != contents or not _is_whole(out / name, known):
            data = _archive(samples)
            write_atomic(out / name, data)
            sha = hashlib.sha256(data).hexdigest()
            known = Shard(name, samples[0].split, len(samples), contents, len(data), sha)
            made.append(name)
        done[name] = known
        if made:
            # What is left of another plan stays listed until its file is gone.
            _write_manifest(out, options, {**before, **done}, complete=False)
    for name in before.keys() - done.keys():
        (out / name).unlink(missing_ok=True)
    _write_manifest(out, options, done, complete=True)
    return ShardReport(tuple(done.values()), tuple(made), out / MANIFEST)


def _archive(samples: Sequence[_Sample]) -> bytes:
    """The bytes of one shard."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for sample in samples:
            for part in sorted((*sample.texts, *sample.files)):
                data = sample.texts[part] if part in sample.texts else _read(*sample.files[part])
                # Owner, time and mode are tarfile's constants, so that they say nothing.
                member = tarfile.TarInfo(f"{sample.key}.{part}")
                member.size = len(data)
                archive.addfile(member, io.BytesIO(data))
    return buffer.getvalue()


def _read(path: Path, size: int, sha: str) -> bytes:
    """The bytes of a file, which must be those that the index promises."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInputError(f"{path} cannot be read: {error.strerror}") from error
    if len(data) != size or hashlib.sha256(data).hexdigest() != sha:
        raise BadInputError(f"{path} is not the file of the index; run `physion verify` on it")
    return data


def _is_whole(path: Path, shard: Shard) -> bool:
    """The file of a shard is there, unchanged."""
    if not path.is_file() or path.stat().st_size != shard.bytes:
        return False
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == shard.sha256


def _known_shards(out: Path, options: Mapping[str, Any]) -> dict[str, Shard]:
    """The shards that the manifest of ``out`` lists; none where the folder is new and empty."""
    path = out / MANIFEST
    if not path.is_file():
        strangers = sorted(item.name for item in out.iterdir() if not item.name.startswith("."))
        # A call that was killed early leaves one shard and no manifest.
        if strangers and not all(name.startswith("physion-") for name in strangers):
            raise BadInputError(
                f"{out} holds {strangers[0]!r} and no {MANIFEST}; choose an empty or new folder"
            )
        return {}
    try:
        known = json.loads(path.read_text(encoding="utf-8", errors="replace"))
        before = {item["name"]: Shard(**item) for item in known["shards"]}
        theirs = known["options"]
    except (ValueError, KeyError, TypeError) as error:
        raise BadInputError(f"{path} is damaged ({error}); delete it to make all anew") from error
    if theirs != options:
        raise BadInputError(
            f"{out} holds shards of other options, see {path}; choose another folder"
        )
    if not all(name.startswith("physion-") and Path(name).name == name for name in before):
        raise BadInputError(f"{path} names files that are no shards; choose another folder")
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
