"""Card of a dataset: a README for people, `croissant.json` for machines, a table for each split.

The tables are for `datasets.load_dataset`, one parquet file for each split: ``index`` has the rows
of the index; ``videos`` has what may be seen of a trial, with the observed movie itself as a column
of the type ``Video``. The front matter of the README names the files by split, because the library
otherwise gives all rows as training rows, with the labels of the tests.
"""

from __future__ import annotations

import datetime
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from physion.core.errors import BadInputError
from physion.core.files import folder_for_writing, write_atomic
from physion.core.tables import markdown_table
from physion.physics.replay import RECORDED_OUTCOMES
from physion.trials.dataset import indexed_file
from physion.trials.files import INDEX, MOVIE_ALONE
from physion.trials.index import INDEX_COLUMNS
from physion.trials.share.croissant import (
    SCENARIO_MEANINGS,
    SPLIT_MEANINGS,
    DatasetFacts,
    PublicationTerms,
    croissant,
    read_facts,
)

CARD = "README.md"
METADATA = "croissant.json"
MADE_BY = "Made with the package physion after the study of Bear et al. (2021)."
"""Sentence in every description, by which existing files are recognised as cards."""
CITATION = """@inproceedings{bear2021physion,
  title = {Physion: Evaluating Physical Prediction from Vision in Humans and Machines},
  author = {Bear, Daniel M. and Wang, Elias and Mrowca, Damian and Binder, Felix J. and
    Tung, Hsiao-Yu Fish and Pramod, R. T. and Holdaway, Cameron and Tao, Sirui and Smith, Kevin and
    Sun, Fan-Yun and Fei-Fei, Li and Kanwisher, Nancy and Tenenbaum, Joshua B. and
    Yamins, Daniel L. K. and Fan, Judith E.},
  booktitle = {Advances in Neural Information Processing Systems, Datasets and Benchmarks},
  year = {2021}
}"""
"""The original study (BibTeX)."""


@dataclass(frozen=True)
class Card:
    """Paths of the files, and the ``facts`` that they are made from."""

    readme: Path
    metadata: Path
    tables: tuple[Path, ...]
    facts: DatasetFacts


def write_card(
    folder: Path,
    out: Path | None = None,
    *,
    license: str = "MIT",
    version: str = "1.0.0",
    creator: str | None = None,
    url: str | None = None,
    published: str | None = None,
    verify: bool = True,
) -> Card:
    """Write `README.md`, `croissant.json` and ``data/`` for the dataset in ``folder``.

    All counts come from the current index: write the card again after the dataset has changed.

    Parameters
    ----------
    folder
        Folder of the dataset.
    out
        Folder to write into; by default ``folder``. An older card is replaced.
    license, version, creator, url, published
        See `PublicationTerms`; the day of publication is by default today.
    verify
        Compare the movies that are copied with their SHA-256 in the index.

    Raises
    ------
    BadInputError
        If there is no index or no trial, a file is damaged, a file that is not a card has one of
        the two names, or an argument is not valid.
    """
    day = published or datetime.date.today().isoformat()
    terms = _checked(PublicationTerms(day, license, version, creator, url))
    facts = read_facts(folder)
    target = folder if out is None else out
    _check_target(target)
    metadata = croissant(facts, terms, description(facts), CITATION)
    text = json.dumps(metadata, indent=1, ensure_ascii=False) + "\n"
    with folder_for_writing(target):
        tables = write_split_tables(folder, facts.index, target, verify=verify)
        write_atomic(target / METADATA, text.encode())
        write_atomic(target / CARD, card_text(facts, terms).encode())
    return Card(target / CARD, target / METADATA, tuple(tables), facts)


def _check_target(target: Path) -> None:
    """Raise `BadInputError` if a file that is not a card would be overwritten."""
    for path in (target / CARD, target / METADATA):
        there = path.exists() or path.is_symlink()
        if there and not (path.is_file() and MADE_BY.encode() in path.read_bytes()):
            raise BadInputError(
                f"{path} is not a dataset card and would be lost; move it away, or write the card "
                "into another folder (`physion export DATASET FOLDER --layout card`)"
            )


def description(facts: DatasetFacts) -> str:
    """Return a short description of the dataset."""
    return (
        f"{len(facts.index)} simulated physical scenes, {facts.movies or 'none'} of them with "
        "movies. The first part of a trial is shown; the question is whether one object, the "
        f"agent, touches another, the patient, at any time of the trial. {MADE_BY}"
    )


def card_text(facts: DatasetFacts, terms: PublicationTerms) -> str:
    """Return the README: YAML front matter as on the Hugging Face hub, then Markdown."""
    name = terms.creator or "not named"
    sections = [
        _front_matter(facts, terms),
        f"# {facts.name}\n{description(facts)}",
        f"## How it was made\n{facts.collection()}\n\n"
        f"{about_states(facts.index['engine'])}\n\n"
        f"Creator: {name}. Version {terms.version}, {terms.published}. "
        f"Licence: {terms.license}.",
        f"## Splits\n{_table(_counts(facts.index))}\n\n{_meanings('split', SPLIT_MEANINGS, facts)}",
        f"## Scenarios\n{_meanings('scenario', SCENARIO_MEANINGS, facts)}",
        f"## Files\nOne folder for each split, in it one for each scenario. `{INDEX}` has one row "
        "for each trial, with the path, size and SHA-256 of its files; together they have "
        f"{facts.total_bytes() / 1e6:.1f} MB. `{METADATA}` is the machine-readable form. "
        f"`{FOLDER}/` has the index by split, and tables of the observed movies (`videos`). A "
        "model or participant that predicts may use the observed movies and the maps, and nothing "
        "else: the index, the trial files and the full movies contain the answers.",
        f"## Columns of the index\n{_table(_columns(facts))}",
        _list("Biases", facts.biases()),
        _list("Known limits", facts.limitations()),
        f"## Citation\n```bibtex\n{CITATION}\n```",
    ]
    return "\n\n".join(sections) + "\n"


def about_states(engines: Iterable[str]) -> str:
    """Return where states come from, and how often their outcome is the recorded one.

    ``engines``: names of the engines as trials have them.
    """
    sentences = []
    for engine in sorted(set(engines)):
        name = engine.partition("-")[0]
        if engine.startswith("imported: "):
            source = engine.removeprefix("imported: ")
            sentences.append(f"States, contacts and labels of some trials are imported ({source}).")
            continue
        sentences.append(
            f"States, contacts and labels are computed by the engine {engine}, also where a scene "
            "comes from the original study; they are not recorded from the simulator of that study."
        )
        known = RECORDED_OUTCOMES.get(name)
        if known is None:
            found = "How often its outcome is the recorded one was not measured."
        else:
            drape = f"; {known['drape']:.3f} in Drape" if "drape" in known else ""
            found = (
                f"On the official scenes its outcome is the recorded one in {known['rigid']:.3f} "
                f"of the trials (mean over the seven rigid scenarios{drape})."
            )
        sentences.append(found)
    return " ".join(sentences)


def refuse_movies(index: pd.DataFrame) -> None:
    """Raise `BadInputError` if trials (rows of an index, by name) were imported without motion."""
    still = index.index[index["engine"] == MOVIE_ALONE]
    if len(still):
        raise BadInputError(
            f"trial {still[0]!r} was imported as a movie, without motion: nothing can be exported "
            "but movies (--layout card)"
        )


def check_readme(out: Path, title: str) -> None:
    """Raise `BadInputError` if `write_readme` would replace a file of others."""
    path = out / CARD
    if path.exists() and not (path.is_file() and path.read_bytes().startswith(title.encode())):
        raise BadInputError(f"{path} is there and would be lost: give another folder")


def write_readme(out: Path, title: str, text: str, engines: Iterable[str]) -> Path:
    """Write a short README with the title, a text and `about_states`; return its path."""
    check_readme(out, title)
    write_atomic(out / CARD, f"{title}\n{text}\n\n{about_states(engines)}\n".encode())
    return out / CARD


def _front_matter(facts: DatasetFacts, terms: PublicationTerms) -> str:
    """Return the front matter of the hub; values are JSON, which is valid YAML."""
    values: dict[str, Any] = {
        "license": terms.license.lower(),
        "pretty_name": f"Physion: {facts.name}",
        "task_categories": ["video-classification"],
        "annotations_creators": ["machine-generated"],
        "size_categories": [_size_category(len(facts.index))],
        "tags": ["physics", "intuitive-physics", "video", "simulation", "croissant"],
        "configs": table_configs(facts.index),
    }
    lines = [f"{name}: {json.dumps(value, ensure_ascii=False)}" for name, value in values.items()]
    return "\n".join(["---", *lines, "---"])


def _size_category(count: int) -> str:
    """Return the hub's category for a number of records."""
    bounds = (1_000, 10_000, 100_000, 1_000_000)
    names = ("n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M")
    return names[sum(count >= bound for bound in bounds)]


def _counts(index: pd.DataFrame) -> pd.DataFrame:
    """Return counts and rates of each split and scenario, one row each."""
    rows = []
    for (split, scenario), part in index.groupby(["split", "scenario"], observed=True):
        robust, known = part["robust"].dropna(), part["contact"].notna()
        rows.append(
            {
                "split": split,
                "scenario": scenario,
                "trials": len(part),
                "contact rate": f"{part['contact'].mean():.3f}" if known.all() else "no labels",
                "contact while observed": int(part["observed_contact"].sum()),
                "frames, median": f"{part['frames'].median():.0f}",
                "agreement under jitter": f"{robust.mean():.3f}" if len(robust) else "-",
                "looks": ", ".join(sorted(set(part["look"]))),
            }
        )
    return pd.DataFrame(rows)


def _columns(facts: DatasetFacts) -> pd.DataFrame:
    rows = [
        {"column": f"`{name}`", "meaning": column.meaning}
        for name, column in INDEX_COLUMNS.items()
        if name in facts.index.columns and not name.endswith(("_bytes", "_sha256"))
    ]
    rows.append(
        {"column": "`*_bytes`, `*_sha256`", "meaning": "size and hash of the file named in `*`"}
    )
    return pd.DataFrame(rows)


def _meanings(column: str, meanings: dict[str, str], facts: DatasetFacts) -> str:
    found = sorted(set(facts.index[column]))
    return _table(
        pd.DataFrame([{column: f"`{name}`", "meaning": meanings.get(name, "-")} for name in found])
    )


def _table(table: pd.DataFrame) -> str:
    """Return a Markdown table."""
    return markdown_table(list(table.columns), table.astype(str).values.tolist())


def _list(title: str, items: list[str]) -> str:
    return "\n".join([f"## {title}", *(f"- {item}" for item in items)])


def _checked(terms: PublicationTerms) -> PublicationTerms:
    """Return ``terms``; `BadInputError` for values that the formats do not allow."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9.+-]*", terms.license):
        raise BadInputError(
            f"licence {terms.license!r} is not an identifier of spdx.org, such as MIT or CC-BY-4.0"
        )
    if not re.fullmatch(r"\d+\.\d+\.\d+", terms.version):
        raise BadInputError(f"version {terms.version!r} is not three numbers, such as 1.0.0")
    if terms.url is not None and not re.fullmatch(r"https?://\S+|urn:\S+", terms.url):
        raise BadInputError(f"{terms.url!r} is not an address that begins with http:// or https://")
    try:
        datetime.date.fromisoformat(terms.published)
    except ValueError:
        raise BadInputError(f"day {terms.published!r} does not have the form 2026-01-31") from None
    return terms


# Tables for `datasets.load_dataset`.

FOLDER = "data"
"""Folder of the tables, next to the card."""
HUB_SPLITS: Mapping[str, str] = {"training": "train", "testing": "test"}
"""Names of splits on the hub, where they differ from ours."""
SEEN = ("trial", "dataset", "scenario", "split", "look", "width", "height", "observed_frames")
"""Columns of the index in ``videos``; none reveals an outcome."""
_VIDEO = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_ROWS = 100
"""Rows in a group of ``videos``, so that a reader need not hold all movies in memory."""


def table_configs(index: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the entry ``configs`` of the front matter: the files of each split by table."""
    configs = [_config("index", index, default=True)]
    seen = index[index["observed_movie"].notna()]
    return configs + ([_config("videos", seen)] if len(seen) else [])


def _config(name: str, index: pd.DataFrame, default: bool = False) -> dict[str, Any]:
    files = [
        {"split": HUB_SPLITS.get(split, split), "path": _path(name, split)}
        for split in sorted(set(index["split"]))
    ]
    return {"config_name": name, "data_files": files} | ({"default": True} if default else {})


def _path(name: str, split: str) -> str:
    return f"{FOLDER}/{name}-{HUB_SPLITS.get(split, split)}.parquet"


def write_split_tables(
    folder: Path, index: pd.DataFrame, out: Path, *, verify: bool = True
) -> list[Path]:
    """Write the tables of the dataset in ``folder`` below ``out``; return their paths.

    `BadInputError` if an observed movie cannot be read or, with ``verify``, does not have its
    SHA-256 in the index.
    """
    made = []
    (out / FOLDER).mkdir(parents=True, exist_ok=True)
    for split, rows in index.groupby("split", observed=True):
        path = out / _path("index", str(split))
        write_atomic(path, _parquet(pa.Table.from_pandas(rows, preserve_index=False)))
        made.append(path)
        seen = rows[rows["observed_movie"].notna()]
        if len(seen):
            path = out / _path("videos", str(split))
            write_atomic(path, _parquet(_videos(folder, seen, verify)))
            made.append(path)
    return made


def _videos(folder: Path, rows: pd.DataFrame, verify: bool) -> pa.Table:
    """Return the table ``videos``, with the types of the library in its schema."""
    table = pa.Table.from_pandas(rows[list(SEEN)], preserve_index=False)
    movies = [_movie(folder, row, verify) for row in rows.to_dict("records")]
    table = table.append_column("video", pa.array(movies, _VIDEO))
    features: dict[str, Any] = {
        name: {"dtype": "string" if kind in (pa.string(), pa.large_string()) else str(kind)}
        | {"_type": "Value"}
        for name, kind in zip(table.column_names, table.schema.types, strict=True)
    }
    features["video"] = {"_type": "Video"}
    text = json.dumps({"info": {"features": features}})
    strings = [
        field.with_type(pa.string()) if field.type == pa.large_string() else field
        for field in table.schema
    ]
    return table.cast(pa.schema(strings)).replace_schema_metadata({"huggingface": text})


def _movie(folder: Path, row: Mapping[Any, Any], verify: bool) -> dict[str, Any]:
    file = indexed_file(folder, row, "observed_movie", verify=verify)
    assert file is not None, "trials without a movie were left out"
    return {"bytes": file.read(), "path": file.path.name}


def _parquet(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", row_group_size=_ROWS)
    return bytes(sink.getvalue())
