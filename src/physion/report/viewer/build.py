"""Writer of the viewer: one HTML page that shows a dataset, by scenario and in detail.

Everything that comes from trials goes into blocks of JSON, which the script shows as text. The
page's policy allows only its own scripts and style, by their hashes, and no network. The scene in
3D is the glTF file of the trial, shown by three.js (folder ``vendor``).
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd

from physion.clips.batch import Imagine, ImaginedTrial
from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import write_atomic
from physion.core.html import Markup, environment
from physion.core.version import MADE_WITH
from physion.report.html import style
from physion.report.viewer import facts as viewer_facts
from physion.report.viewer import movies as viewer_movies
from physion.report.viewer.imagined import pack_imagined
from physion.trials.dataset import Dataset, read_unusable
from physion.trials.share.gltf import motion_gltf
from physion.trials.trial_file import Trial

SCRIPTS = ("scene", "pictures", "detail", "page")
"""Parts of the script; the last one starts it."""
CLOTH_SIDE, CLOTH_KEYS = 26, 50
"""Largest number of vertices along a side of a cloth, and of its key frames, in the page."""


@dataclass(frozen=True)
class TrialData:
    """Data of one trial: its ``card`` in the grid, its small ``movie``, and the ``detail`` view."""

    card: Mapping[str, Any]
    movie: Mapping[str, Any]
    detail: Mapping[str, Any]


def render_viewer(
    title: str,
    trials: Sequence[TrialData],
    totals: Mapping[str, int],
    unusable: Mapping[str, str] | None = None,
) -> str:
    """Return the page as text.

    - ``trials``, ``totals``: trials of the page, and the dataset's number by scenario.
    - ``unusable``: all trials of the dataset that are marked so, with reasons.
    """
    detailed = any("gltf" in trial.detail for trial in trials)
    look = Markup("\n") + style() + Markup(_part("templates", "viewer.css"))
    # The library is needed only where a trial has a scene in 3D.
    scripts = [_part("viewer", "vendor", "three.min.js")] if detailed else []
    scripts.append(_script())
    blocks = [("cards", [trial.card for trial in trials]), ("totals", totals)]
    blocks.append(("unusable", unusable or {}))
    for number, trial in enumerate(trials):
        blocks += [(f"movie-{number}", trial.movie), (f"detail-{number}", trial.detail)]
    return environment("physion.report").get_template("viewer.html").render(
        policy=_policy(look, scripts),
        title=title,
        made_with=MADE_WITH,
        style=look,
        blocks=[(name, Markup(embed_json(value))) for name, value in blocks],
        scripts=[Markup(script) for script in scripts],
    )  # fmt: skip


def embed_json(value: Any) -> str:
    """Return JSON without ``<``, ``>`` and ``&``, so that it cannot end its element."""
    try:
        text = json.dumps(value, separators=(",", ":"), sort_keys=True, allow_nan=False)
    except ValueError as error:
        raise BadInputError(f"a trial holds a number that is none: {error}") from error
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def _policy(look: str, scripts: Sequence[str]) -> str:
    rules = {
        "default-src": "'none'",
        "script-src": " ".join(_hash(script) for script in scripts),
        "style-src": _hash(look),
        "media-src": "blob:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _script() -> str:
    parts = "\n".join(_part("viewer", f"{name}.js") for name in SCRIPTS)
    return f'\n(() => {{\n"use strict";\n{parts}}})();\n'


def _part(*names: str) -> str:
    return files("physion.report").joinpath(*names).read_text(encoding="utf-8")


@dataclass(frozen=True)
class ViewerOptions:
    """Settings of the viewer.

    - ``trials``: largest number of each scenario; ``details``: how many of them with all passes and
      the scene in 3D.
    - ``scenario``, ``split``: only these, or all.
    - ``card_size``, ``pass_size``: pixels of the longer side of the movies.
    - ``stride``: every how many frames the passes are shown.
    """

    trials: int = 6
    details: int = 3
    scenario: str | None = None
    split: str | None = None
    card_size: int = 128
    pass_size: int = 160
    stride: int = 2

    def __post_init__(self) -> None:
        for name, least in (("trials", 1), ("details", 0), ("stride", 1)):
            if getattr(self, name) < least:
                raise BadInputError(f"{name} must be {least} or more, not {getattr(self, name)}")
        for name in ("card_size", "pass_size"):
            if not 16 <= getattr(self, name) <= 1024:
                raise BadInputError(f"{name} must be 16 to 1024 pixels, not {getattr(self, name)}")


@dataclass(frozen=True)
class ViewerReport:
    """Result of `build_viewer`: path, bytes, and numbers of trials shown and left out."""

    page: Path
    size: int
    shown: int
    left_out: int


def build_viewer(
    folder: Path,
    out: Path,
    options: ViewerOptions | None = None,
    *,
    imagine: Imagine | None = None,
    verify: bool = True,
    progress: Progress | None = None,
) -> ViewerReport:
    """Write the page of the dataset in ``folder`` to the file ``out``, whole or not at all.

    The page needs no other file and no network. The same trials and options give the same bytes.
    ``imagine`` is called once with the names of the trials that have details; what it returns is
    shown next to what is true. With ``verify``, files are compared with their SHA-256 in the index.
    Raises `BadInputError` where there is no dataset, a trial is damaged, an imagined trial cannot
    be shown, or ``out`` is a folder or cannot be written, and `UnknownNameError` for a scenario or
    split that the dataset does not hold.
    """
    options = options or ViewerOptions()
    dataset = Dataset(folder, verify=verify)
    if out.is_dir():
        raise BadInputError(f"{out} is a folder; give a file for the page")
    if not out.parent.is_dir():
        raise BadInputError(f"folder {out.parent} does not exist; make it, or choose another")
    # Checked first, since rendering takes minutes.
    if not os.access(out.parent, os.W_OK):
        raise _unwritable(out, "the folder is read-only")
    chosen, totals = choose_trials(dataset.index, options)
    rows = [row for _, row in chosen.iterrows()]
    detailed = [str(row["trial"]) for row in rows if row["detailed"]]
    imagined = imagine(detailed) if imagine is not None else {}
    marks = read_unusable(dataset)
    found = [
        _trial_data(dataset, row, options, imagined.get(row["trial"], ()), marks)
        for row in tracked(rows, "viewing", len(rows), progress)
    ]
    title = ", ".join(sorted(set(dataset.index["dataset"].astype(str)))) or "no trials"
    page = render_viewer(title, found, totals, marks).encode()
    try:
        write_atomic(out, page)
    except OSError as error:
        raise _unwritable(out, error.strerror or str(error)) from error
    return ViewerReport(out, len(page), len(found), sum(totals.values()) - len(found))


def _unwritable(out: Path, reason: str) -> BadInputError:
    return BadInputError(f"cannot write {out}: {reason}; give another place for the page (--out)")


def choose_trials(
    index: pd.DataFrame, options: ViewerOptions
) -> tuple[pd.DataFrame, dict[str, int]]:
    """Return the rows of the index for the page, and how many trials each scenario has.

    Of each scenario the first trials are taken, alternating between splits. The column ``detailed``
    marks those that are shown with all passes.
    """
    table = index
    for column, wanted in (("scenario", options.scenario), ("split", options.split)):
        if wanted is not None:
            known = [str(name) for name in index[column].unique()]
            if wanted not in known:
                raise UnknownNameError(f"{column} of the dataset", wanted, known)
            table = table[table[column] == wanted]
    turn = table.groupby(["scenario", "split"]).cumcount()
    table = table.assign(turn=turn).sort_values(["scenario", "turn", "split"], kind="stable")
    place = table.groupby("scenario").cumcount()
    table = table.assign(detailed=place < options.details)[place < options.trials]
    totals = turn.groupby(index.loc[turn.index, "scenario"].astype(str)).size()
    ordered = table.sort_values(["scenario", "split", "trial"], ignore_index=True)
    return ordered, {str(name): int(count) for name, count in totals.items()}


def _trial_data(
    dataset: Dataset,
    row: pd.Series,
    options: ViewerOptions,
    imagined: Sequence[ImaginedTrial],
    marks: Mapping[str, str],
) -> TrialData:
    """Return the data of one trial."""
    paths = dataset.paths(row["trial"])
    trial = dataset.trial(row["trial"])
    if trial.metadata.playback_rate < 1:
        raise BadInputError(f"{paths.trial_file}: a movie of {trial.metadata.playback_rate} Hz")
    detail: dict[str, Any] = {
        "tables": viewer_facts.tables(trial),
        "runs": viewer_facts.contact_runs(trial),
        "legend": viewer_facts.legend(trial.scene),
    }
    if row["detailed"]:
        strip, ranges = viewer_movies.passes_movie(trial, options.pass_size, options.stride)
        detail["passes"] = strip.as_record()
        detail["ranges"] = {"near": ranges.near, "far": ranges.far, "flow": ranges.flow}
        detail["gltf"] = base64.b64encode(_scene(trial)).decode("ascii")
        detail["scenery"] = any(body.scenery for body in trial.scene.bodies)
        detail["paths"] = viewer_facts.paths(trial)
        detail["touches"] = viewer_facts.touches(trial)
        detail["imagined"] = [
            pack_imagined(
                one,
                trial.scene,
                trial.metadata.frames,
                observed=bool(viewer_facts.labels_of(trial).observed),
            )
            for one in imagined
        ]
    stored = dataset.file(row["trial"], "movie")
    if stored is not None:
        stored.check()
    movie = viewer_movies.small_movie(paths.movie, trial, options.card_size)
    size = {"width": movie.width, "height": movie.height}
    card = viewer_facts.card(trial, marks.get(row["trial"], "")) | size
    return TrialData(card, movie.as_record(), detail)


def _scene(trial: Trial) -> bytes:
    """Return the trial as a glTF file, with agent red, patient yellow, and coarse cloths."""
    meta = trial.metadata
    return motion_gltf(
        trial.shown("redyellow"),
        trial.trajectory,
        frame_time=meta.frame_time,
        aspect=meta.width / meta.height,
        cloth_keys=CLOTH_KEYS,
        cloth_side=CLOTH_SIDE,
        contacts=False,
        facts={"trial": meta.trial},
    )
