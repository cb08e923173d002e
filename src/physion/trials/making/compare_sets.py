"""Comparison of two datasets that should be equal, such as those of two machines or versions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physion.compute.progress import Progress, tracked
from physion.errors import BadInputError
from physion.trials.columns import FILES
from physion.trials.index import read_index, same_value
from physion.trials.layout import TrialPaths
from physion.trials.trial_file import Trial

_VERSIONS = ("engine", "renderer", "package")
_LABELS = ("contact", "first_frame", "observed_contact", "min_distance", "robust")
_PICTURES = tuple(name for name in FILES if name != "trial_file")


@dataclass
class DatasetComparison:
    """What differs between two datasets, one line per finding.

    - ``same``: number of trials of both sets that have the same scene, motion, labels and files.
    - ``only_first``, ``only_second``: names of the trials of one set alone.
    - ``versions``: engines, renderers or packages that made one set and not the other.
    - ``differences``: one line for each trial that differs.
    """

    same: int = 0
    only_first: list[str] = field(default_factory=list)
    only_second: list[str] = field(default_factory=list)
    versions: list[str] = field(default_factory=list)
    differences: list[str] = field(default_factory=list)

    @property
    def equal(self) -> bool:
        """Whether both sets have the same trials with the same content."""
        return not (self.only_first or self.only_second or self.differences)


def compare_datasets(
    first: Path, second: Path, *, progress: Progress | None = None
) -> DatasetComparison:
    """Compare the trials of two datasets by name.

    Scenes, motions, labels and files are compared by the digests in both indices; `verify_dataset`
    tells whether the files are those of the index. Trial files are read only where motions differ.
    Files that hold the same values in other bytes, for example by another compression, count as
    different. A trial file stores the version of the package that made it: if that version differs
    and nothing else does, the trials are the same.

    Raises
    ------
    BadInputError
        If a folder has no valid index, or the file of a trial whose motion differs is damaged.
    """
    tables = [read_index(folder).set_index("trial", drop=False) for folder in (first, second)]
    names = [set(table.index) for table in tables]
    result = DatasetComparison(
        only_first=sorted(names[0] - names[1]), only_second=sorted(names[1] - names[0])
    )
    for column in _VERSIONS:
        of = [sorted(set(table[column].dropna())) for table in tables]
        if of[0] != of[1]:
            result.versions.append(f"{column}: {_listed(of[0])}; against {_listed(of[1])}")
    shared = sorted(names[0] & names[1])
    rows = [table.loc[shared].to_dict("records") for table in tables]
    pairs = list(zip(*rows, strict=True))
    for one, other in tracked(pairs, "comparing", len(pairs), progress):
        findings = _differences(one, other, first, second)
        if findings:
            result.differences.append(f"{one['trial']}: {'; '.join(findings)}")
        else:
            result.same += 1
    return result


def _listed(versions: list[str]) -> str:
    return ", ".join(versions) or "none"


def _differences(
    one: Mapping[str, Any], other: Mapping[str, Any], first: Path, second: Path
) -> list[str]:
    """Return what differs between two trials of one name."""
    found = []
    if one["scene_digest"] != other["scene_digest"]:
        found.append("another scene")
    elif one["digest"] != other["digest"]:
        found.append(_describe_motions(_open(first, one), _open(second, other)))
    found += [
        f"{name} {_shown(one[name])} against {_shown(other[name])}"
        for name in _LABELS
        if not same_value(one[name], other[name])
    ]
    files = [
        name for name in _PICTURES if not same_value(one[f"{name}_sha256"], other[f"{name}_sha256"])
    ]
    if files:
        found.append(f"other bytes of {', '.join(files)}")
    same_file = one["trial_file_sha256"] == other["trial_file_sha256"]
    if not found and not same_file and one["package"] == other["package"]:
        found.append("other bytes of trial_file")
    return found


def _open(folder: Path, row: Mapping[str, Any]) -> Trial:
    return Trial.open(TrialPaths(folder, row["split"], row["scenario"], row["trial"]).trial_file)


def _describe_motions(one: Trial, other: Trial) -> str:
    """Return where two motions of a scene part, and how far."""
    motions = one.trajectory, other.trajectory
    frames = min(len(motion) for motion in motions)
    parts, bodies = [], one.scene.names()
    for name in ("positions", "cloth_vertices"):
        a, b = (getattr(motion, name)[:frames].astype(np.float64) for motion in motions)
        if a.shape != b.shape:
            raise BadInputError(f"{one.metadata.trial}: the sets hold other numbers of {name}")
        parts.append(np.linalg.norm(a - b, axis=-1))
    apart = np.concatenate(parts, axis=1) if frames else np.zeros((0, 1))
    lengths = f"{len(motions[0])} and {len(motions[1])} frames"
    if not apart.size or not (apart > 0).any():
        return f"other motion, with the same positions ({lengths})"
    frame = int(np.flatnonzero((apart > 0).any(axis=1))[0])
    column = int(np.argmax(apart.max(axis=0)))
    # Vertices of cloths follow the bodies.
    name = bodies[column] if column < len(one.scene.bodies) else "a cloth"
    return f"other motion from frame {frame} on, by up to {apart.max():.3g} m ({name}; {lengths})"


def _shown(value: Any) -> str:
    return "-" if pd.isna(value) else str(value)
