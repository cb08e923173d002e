"""Facts about a dataset, and its machine-readable metadata: Croissant 1.0 (JSON-LD).

Every statement is computed from the index, read from the settings of the dataset, or true of all
datasets that this package makes. Terms follow the specifications of Croissant and of its
vocabulary for responsible AI (docs.mlcommons.org/croissant). The JSON-LD context is included in the
file, so that reading it requires no network access.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from physion.core.errors import BadInputError
from physion.core.files import digest_of
from physion.core.settings import read_json
from physion.trials.files import FILES, INDEX, SETTINGS
from physion.trials.index import INDEX_COLUMNS, IndexColumn, read_index

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
        return (
            f"Scenes sampled at random by {self.versions('package')}: {drawn}. Scenes imported "
            f"from records made elsewhere: {self.imported}. All were simulated by "
            f"{self.versions('engine')} and rendered by {self.versions('renderer')}."
        )

    def biases(self) -> list[str]:
        """Return the known biases, with counts."""
        index = self.index
        labelled = index[index["contact"].notna()]
        rates = labelled.groupby("split", observed=True)["contact"].agg(["mean", "size"])
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
        robust = index["robust"].dropna()
        return [
            "Rigid bodies and cloth are simulated; another engine may give some trials another "
            "outcome.",
            "The camera never moves, and there is no sound.",
            f"In {int(index['observed_contact'].sum())} of {n} trials agent and patient touch "
            "already in the observed part.",
            "How much labels depend on tiny changes of the scene was not measured."
            if robust.empty
            else "Jittered simulations agree with the label in "
            f"{float(robust.mean()):.3f} of cases, measured on {len(robust)} of {n} trials.",
            f"In {int((~index['completed']).sum())} of {n} trials something still moved at the "
            "time limit.",
        ]


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
    return DatasetFacts(index, len(data), digest_of(data), settings)


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

    - ``published``: day of publication, ``YYYY-MM-DD``.
    - ``license``: identifier of spdx.org; by default the licence of this package and of the
      official command logs.
    - ``version``: version of the dataset, three numbers with dots.
    - ``creator``: name of the person or group.
    - ``url``: page of the dataset; by default a URN with the SHA-256 of its index.
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
        "recordSet": [_trials(), *_videos(facts)],
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
        "rai:dataSocialImpact": "None is known beyond research on physical prediction.",
        "rai:personalSensitiveInformation": [
            "None. All pictures are rendered from synthetic scenes; no person was filmed, and no "
            "responses of people are part of the dataset."
        ],
        "rai:dataReleaseMaintenancePlan": f"The {n - facts.imported} trials with a seed can be "
        f"made again by {facts.versions('package')}; every file's SHA-256 is in the index, and "
        "`physion verify` compares them. A version of other pictures or labels gets a new number.",
        "rai:dataPreprocessingProtocol": [
            "States are stored as the engine computed them, in single precision.",
            "The observed part of a movie is a file of its own.",
        ],
    }


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
    return {
        "@type": "cr:Field",
        "@id": f"trials/{name}",
        "name": name,
        "description": column.meaning,
        "dataType": _TYPES[column.dtype],
        "source": {"fileObject": {"@id": INDEX}, "extract": {"column": name}},
    }
