"""Card of a dataset: a README for people, `croissant.json` for machines, a table for each split."""

from __future__ import annotations

import datetime
import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from physion.core.errors import BadInputError
from physion.core.files import write_atomic
from physion.core.settings import read_json
from physion.trials.files import FILES, INDEX, SETTINGS
from physion.trials.index import INDEX_COLUMNS, IndexColumn, read_index
from physion.trials.share.tables import FOLDER, table_configs, write_split_tables

# Facts about a dataset, for its card and its metadata.
#
# Every statement is computed from the index, read from the settings of the dataset, or true of all
# datasets that this package makes.

SPLIT_MEANINGS = {
    "training": "for a model's own training",
    "readout": "for fitting a readout on a model's features",
    "testing": "for the test that models and people take",
    "familiarization": "for people to practise on",
}
SCENARIO_MEANINGS = {
    "collide": "one object is thrown at another",
    "contain": "objects lie in a bowl or round a post, and something is thrown at them",
    "dominoes": "a row of upright objects topples",
    "drape": "a cloth falls over things that stand in its way",
    "drop": "one object falls on another",
    "link": "rings hang on a post, and something is thrown at them",
    "roll": "an object rolls or slides down a ramp or off a ledge",
    "support": "a stack of objects stands or falls",
}


@dataclass(frozen=True)
class DatasetFacts:
    """Index of a dataset with size and SHA-256 of its file, and the settings of the dataset.

    ``settings`` is empty if the folder has none.
    """

    index: pd.DataFrame
    index_bytes: int
    index_sha256: str
    settings: dict[str, Any]

    @property
    def name(self) -> str:
        """Name of the dataset; several names are joined by ``+``."""
        return "+".join(sorted(set(self.index["dataset"])))

    @property
    def imported(self) -> int:
        """Number of trials whose scenes were imported, not sampled."""
        return int(self.index["seed"].isna().sum())

    @property
    def movies(self) -> int:
        """Number of trials with movies."""
        return int(self.index["movie"].notna().sum())

    def versions(self, column: str) -> str:
        """Return the distinct values of a column as one text."""
        return ", ".join(sorted({str(value) for value in self.index[column].dropna()}))

    def total_bytes(self) -> int:
        """Return the total size in bytes of all files in the index."""
        return int(self.index[[f"{name}_bytes" for name in FILES]].sum().sum())

    def collection(self) -> str:
        """Return how the trials were made."""
        drawn = len(self.index) - self.imported
        parts = []
        if drawn:
            parts.append(
                f"{drawn} {_scenes(drawn)} sampled at random by {self.versions('package')}."
            )
        if self.imported:
            parts.append(
                f"{self.imported} {_scenes(self.imported)} imported from records made elsewhere."
            )
        parts.append(
            f"All were simulated by {self.versions('engine')} and rendered by "
            f"{self.versions('renderer')}."
        )
        return " ".join(parts)

    def missing(self) -> str:
        """Return the numbers of missing cells of the index, by column."""
        columns = [name for name in INDEX_COLUMNS if not name.endswith(("_bytes", "_sha256"))]
        counts = self.index[columns].isna().sum()
        gaps = [f"{name} ({count})" for name, count in counts.items() if count]
        return f"Missing cells by column, of {len(self.index)}: {', '.join(gaps) or 'none'}."

    def biases(self) -> list[str]:
        """Return the known biases, with counts."""
        index = self.index
        rates = index.groupby("split", observed=True)["contact"].agg(["mean", "size"])
        statements = [
            f"Agent and patient touch in {row['mean']:.3f} of the {row['size']:.0f} {split} trials."
            for split, row in rates.iterrows()
        ]
        chosen = {
            name: self.settings[name]
            for name in ("min_visible", "robust", "observed_contact")
            if name in self.settings
        }
        if chosen and self.imported < len(index):
            text = ", ".join(f"{name} = {value}" for name, value in chosen.items())
            statements.append(
                f"Sampled trials were chosen with these settings of `physion generate`: {text}."
            )
        statements.append(
            "Shapes, sizes, colours, rooms and cameras follow the package's samplers or the "
            "imported scenes, not the statistics of any real place."
        )
        return statements

    def limitations(self) -> list[str]:
        """Return the known limitations, with counts."""
        index, n = self.index, len(self.index)
        statements = [
            "Rigid bodies and cloth are simulated; another engine may give some trials another "
            "outcome.",
            "The camera never moves, and there is no sound.",
            f"In {int(index['observed_contact'].sum())} of {n} trials agent and patient touch "
            "already in the observed part.",
        ]
        robust = index["robust"].dropna()
        if len(robust):
            statements.append(
                "Jittered simulations agree with the label in "
                f"{float(robust.mean()):.3f} of cases, measured on {len(robust)} of {n} trials."
            )
        else:
            statements.append(
                "How much labels depend on tiny changes of the scene was not measured."
            )
        unfinished = int((~index["completed"]).sum())
        statements.append(f"In {unfinished} of {n} trials something still moved at the time limit.")
        return statements


def read_facts(folder: Path) -> DatasetFacts:
    """Read the facts of a dataset; `BadInputError` if it has no index or no trial."""
    index = read_index(folder)
    if index.empty:
        raise BadInputError(f"{folder} has no trial to describe")
    data = (folder / INDEX).read_bytes()
    path, settings = folder / SETTINGS, {}
    if path.is_file():
        try:
            settings = dict(read_json(path, dict[str, Any])["settings"])
        except (KeyError, TypeError, ValueError) as error:
            raise BadInputError(f"{path} is damaged: field 'settings' is missing") from error
    return DatasetFacts(index, len(data), hashlib.sha256(data).hexdigest(), settings)


def _scenes(count: int) -> str:
    return "scene was" if count == 1 else "scenes were"


# Machine-readable metadata of a dataset: Croissant 1.0 with responsible-AI vocabulary (JSON-LD).
#
# Terms are those of the specifications (docs.mlcommons.org/croissant). The JSON-LD context is
# included in the file, so that reading it requires no network access.

CROISSANT = "http://mlcommons.org/croissant/1.0"
RAI = "http://mlcommons.org/croissant/RAI/1.0"

_TYPES = {"string": "sc:Text", "int64": "sc:Integer", "bool": "sc:Boolean", "float64": "sc:Float"}
_TYPES |= {"Int64": "sc:Integer", "boolean": "sc:Boolean", "Float64": "sc:Float"}
"""Type in the Croissant vocabulary by pandas type."""
_FILES = {
    "trial-files": ("*/*/*.h5", "application/x-hdf5", "trial_file"),
    "movies": ("*/*/*_img.mp4", "video/mp4", "movie"),
    "observed-movies": ("*/*/*_observed.mp4", "video/mp4", "observed_movie"),
    "maps": ("*/*/*_map.png", "image/png", "map"),
}
VIDEO_TABLES = "video-tables"
_MINE = """citeAs column extract field fileProperty fileObject fileSet format includes isLiveDataset
jsonPath key md5 parentField path recordSet references regex repeated replace separator source
subField transform"""
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "samplingRate": "cr:samplingRate",
    **{word: f"cr:{word}" for word in _MINE.split()},
}


@dataclass(frozen=True)
class PublicationTerms:
    """Information that the publisher of a dataset provides.

    Parameters
    ----------
    published
        Day of publication, ``YYYY-MM-DD``.
    license
        Identifier of spdx.org; by default that of this package and of the official command logs.
    version
        Version of the dataset, three numbers with dots.
    creator
        Name of the person or group.
    url
        Page of the dataset; by default a URN with the SHA-256 of its index.
    """

    published: str
    license: str = "MIT"
    version: str = "1.0.0"
    creator: str | None = None
    url: str | None = None


def croissant(
    facts: DatasetFacts, terms: PublicationTerms, description: str, citation: str
) -> dict[str, Any]:
    """Return the metadata as JSON-LD; ``citation`` is BibTeX."""
    package = facts.versions("package")
    creator = terms.creator or f"An unnamed user of {package}"
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [CROISSANT, RAI],
        "name": facts.name,
        "description": description,
        "url": terms.url or f"urn:sha256:{facts.index_sha256}",
        "license": f"https://spdx.org/licenses/{terms.license}.html",
        "version": terms.version,
        "datePublished": terms.published,
        "creator": {"@type": "sc:Organization", "name": creator},
        "citeAs": citation,
        "keywords": ["physics", "video", "prediction", "cognitive science", "benchmark"],
        "distribution": _distribution(facts),
        "recordSet": [*_enumerations(facts), _trials(), *_videos(facts)],
        **responsible(facts),
    }


def responsible(facts: DatasetFacts) -> dict[str, Any]:
    """Return the properties of the responsible-AI vocabulary."""
    n = len(facts.index)
    return {
        "rai:dataCollection": facts.collection(),
        "rai:dataCollectionType": ["Software Collection"]
        + (["Secondary Data analysis"] if facts.imported else []),
        "rai:dataCollectionRawData": "Scenes (bodies, poses, pushes, camera) and their simulated "
        "motion are stored in every trial file; pictures can be rendered again from them.",
        "rai:dataCollectionMissingData": facts.missing(),
        "rai:dataAnnotationProtocol": "Labels are computed, not judged by people: whether agent "
        "and patient touch at any time of the simulated trial, including its hidden part.",
        "rai:machineAnnotationTools": [facts.versions("engine"), facts.versions("package")],
        "rai:annotationsPerItem": "0 by people; one label is computed",
        "rai:dataBiases": facts.biases(),
        "rai:dataLimitations": facts.limitations(),
        "rai:dataUseCases": [
            "Training models that predict what happens next from video or from physical state.",
            "Testing whether such models predict contacts, and comparing them with people who "
            "judge the same movies.",
            "Not intended for decisions about real objects: nothing was measured on real objects.",
        ],
        "rai:dataSocialImpact": "None is known beyond that of research on physical prediction.",
        "rai:personalSensitiveInformation": [
            "None. All pictures are rendered from synthetic scenes; no person was filmed, and no "
            "responses of people are part of the dataset."
        ],
        "rai:dataReleaseMaintenancePlan": f"The {n - facts.imported} trials with a seed can be "
        f"made again by {facts.versions('package')}; every file's SHA-256 is in the index, and "
        "`physion verify` compares them. A version of other pictures or labels gets a new number.",
        "rai:dataPreprocessingProtocol": preprocessing(facts),
    }


def preprocessing(facts: DatasetFacts) -> list[str]:
    """Return how simulations were processed before they were stored."""
    sizes = facts.index[["width", "height"]].drop_duplicates().sort_values(["width", "height"])
    text = ", ".join(f"{row.width} x {row.height}" for row in sizes.itertuples())
    steps = ["States are stored as the engine computed them, in single precision."]
    if facts.movies:
        steps.append(f"Movies are H.264 ({text} pixels); the observed part is a file of its own.")
    return steps


def _distribution(facts: DatasetFacts) -> list[dict[str, Any]]:
    index_file = {
        "@type": "cr:FileObject",
        "@id": INDEX,
        "name": INDEX,
        "description": "One row per trial, with label, hashes and paths. Contains the answers.",
        "contentUrl": INDEX,
        "contentSize": f"{facts.index_bytes} B",
        "encodingFormat": "application/x-parquet",
        "sha256": facts.index_sha256,
    }
    sets = [
        {
            "@type": "cr:FileSet",
            "@id": name,
            "name": name,
            "description": f"{FILES[column][0].upper()}{FILES[column][1:]}. The SHA-256 of "
            "each file is in the index.",
            "encodingFormat": kind,
            "includes": pattern,
        }
        for name, (pattern, kind, column) in _FILES.items()
        if facts.index[column].notna().any()
    ]
    if facts.index["observed_movie"].notna().any():
        sets.append(
            {
                "@type": "cr:FileSet",
                "@id": VIDEO_TABLES,
                "name": VIDEO_TABLES,
                "description": "Observed movies in tables, one for each split.",
                "encodingFormat": "application/x-parquet",
                "includes": "data/videos-*.parquet",
            }
        )
    return [index_file, *sets]


def _enumerations(facts: DatasetFacts) -> list[dict[str, Any]]:
    """Return record sets of the splits and scenarios that occur, with their meanings."""
    sets = []
    for column, meanings, kind in (
        ("split", SPLIT_MEANINGS, "cr:Split"),
        ("scenario", SCENARIO_MEANINGS, "sc:Enumeration"),
    ):
        name = f"{column}s"
        rows = [
            {f"{name}/name": value, f"{name}/meaning": meanings.get(value, "of the user's own")}
            for value in sorted(set(facts.index[column]))
        ]
        fields = [
            {"@type": "cr:Field", "@id": f"{name}/{part}", "name": part, "dataType": "sc:Text"}
            for part in ("name", "meaning")
        ]
        sets.append(
            {
                "@type": "cr:RecordSet",
                "@id": name,
                "name": name,
                "dataType": kind,
                "key": {"@id": f"{name}/name"},
                "field": fields,
                "data": rows,
            }
        )
    return sets


def _trials() -> dict[str, Any]:
    """Return the record set of the index, with one field per column."""
    return {
        "@type": "cr:RecordSet",
        "@id": "trials",
        "name": "trials",
        "description": "One record per trial.",
        "key": {"@id": "trials/trial"},
        "field": [_field(name, column) for name, column in INDEX_COLUMNS.items()],
    }


def _videos(facts: DatasetFacts) -> list[dict[str, Any]]:
    """Return the record set of the observed movies, with each movie as content.

    They are taken from the tables, because the reference reader opens no MP4 files.
    """
    if facts.index["observed_movie"].isna().all():
        return []
    fields = {"trial": "sc:Text", "scenario": "sc:Text", "split": "sc:Text"}
    return [
        {
            "@type": "cr:RecordSet",
            "@id": "videos",
            "name": "videos",
            "description": "One record per trial with movies: what may be seen of it. The observed "
            "movie itself is in video, MP4.",
            "key": {"@id": "videos/trial"},
            "field": [
                *(_video_field(name, kind, {}) for name, kind in fields.items()),
                _video_field("video", "sc:VideoObject", {"transform": {"jsonPath": "bytes"}}),
            ],
        }
    ]


def _video_field(name: str, kind: str, transform: dict[str, Any]) -> dict[str, Any]:
    source = {"fileSet": {"@id": VIDEO_TABLES}, "extract": {"column": name}, **transform}
    return {
        "@type": "cr:Field",
        "@id": f"videos/{name}",
        "name": name,
        "dataType": kind,
        "source": source,
    }


def _field(name: str, column: IndexColumn) -> dict[str, Any]:
    field: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": f"trials/{name}",
        "name": name,
        "description": column.meaning,
        "dataType": _TYPES[column.dtype],
        "source": {"fileObject": {"@id": INDEX}, "extract": {"column": name}},
    }
    if name in ("split", "scenario"):
        field["references"] = {"field": {"@id": f"{name}s/name"}}
    return field


CARD = "README.md"
METADATA = "croissant.json"
TITLE = "Physion: "
"""Prefix of the name of the dataset in every card."""
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
    try:
        target.mkdir(parents=True, exist_ok=True)
        tables = write_split_tables(folder, facts.index, target, verify=verify)
        write_atomic(target / METADATA, text.encode())
        write_atomic(target / CARD, card_text(facts, terms).encode())
    except OSError as error:
        raise BadInputError(f"cannot write into {target}: {error.strerror or error}") from error
    return Card(target / CARD, target / METADATA, tuple(tables), facts)


def _check_target(target: Path) -> None:
    """Raise `BadInputError` if a file that is not a card would be overwritten."""
    for name, is_ours in ((CARD, _is_readme), (METADATA, _is_metadata)):
        path = target / name
        if not path.exists() and not path.is_symlink():
            continue
        if not (path.is_file() and is_ours(path)):
            raise BadInputError(
                f"{path} is not a dataset card and would be lost; move it away, or write the card "
                "into another folder (`physion export DATASET FOLDER --layout card`)"
            )


def _is_readme(path: Path) -> bool:
    """Return whether a README has the front matter of a card."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    if not lines or lines[0] != "---" or "---" not in lines[1:]:
        return False
    return any(x.startswith(f'pretty_name: "{TITLE}') for x in lines[1 : lines.index("---", 1)])


def _is_metadata(path: Path) -> bool:
    """Return whether a JSON file has the description of a card."""
    try:
        data = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return False
    return isinstance(data, dict) and str(data.get("description")).endswith(MADE_BY)


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
        "## Biases\n" + _list(facts.biases()),
        "## Known limits\n" + _list(facts.limitations()),
        f"## Citation\n```bibtex\n{CITATION}\n```",
    ]
    return "\n\n".join(sections) + "\n"


def _front_matter(facts: DatasetFacts, terms: PublicationTerms) -> str:
    """Return the front matter of the hub; values are JSON, which is valid YAML."""
    values: dict[str, Any] = {
        "license": terms.license.lower(),
        "pretty_name": f"{TITLE}{facts.name}",
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
        robust = part["robust"].dropna()
        rows.append(
            {
                "split": split,
                "scenario": scenario,
                "trials": len(part),
                "contact rate": f"{part['contact'].mean():.3f}",
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
    rows = [list(table.columns), ["---"] * len(table.columns), *table.astype(str).values.tolist()]
    return "\n".join("| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in rows)


def _list(items: list[str]) -> str:
    return "\n".join(f"- {item}" for item in items)


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
