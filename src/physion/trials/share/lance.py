"""Export of a dataset as tables of Lance, as stable-worldmodel reads them: one row for each frame.

It needs the extra ``lance``. Tables in the folder:

- ``trials.lance``: ``episode_idx`` and ``step_idx``; ``pixels``, a JPEG of the full movie;
  and lists of 32-bit numbers: ``state`` and ``action`` as `physion.trials.share.lerobot` has them,
  ``success`` (1 once agent and patient have touched) and ``done`` (1 in the last frame);
- ``trials_episodes.lance``: ``trial``, ``scenario``, ``split``, ``contact`` and
  ``first_contact_frame`` (-1 for none) of each ``episode_idx``.

References
----------
stable-worldmodel 0.1.1, module stable_worldmodel.data.formats.lance,
https://github.com/galilai-group/stable-worldmodel
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from PIL import Image

from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError, MissingExtraError
from physion.core.files import folder_for_writing, new_folder
from physion.trials.dataset import Dataset
from physion.trials.share.card import check_readme, write_readme
from physion.trials.share.lerobot import (
    ACTION,
    NAMES,
    UNITS,
    actions_of,
    labelled,
    most_of,
    states_of,
)

TABLE, EPISODES = "trials.lance", "trials_episodes.lance"
TITLE = "# Physion trials as tables of Lance"
README = (
    f"`stable_worldmodel.data.load_dataset('{TABLE}')` reads `{TABLE}`, one row for each frame; "
    f"`{EPISODES}` has one row for each trial. {UNITS}"
)
QUALITY = 95
"""Quality of the pictures, as stable-worldmodel writes them."""


def export_lance(
    folder: Path,
    out: Path,
    *,
    split: str | None = None,
    scenario: str | None = None,
    verify: bool = True,
    progress: Progress | None = None,
) -> list[Path]:
    """Write trials of a dataset as two tables of Lance, and return their folders.

    ``split``, ``scenario``: only these. ``verify``: whether files are compared with the index.

    Raises
    ------
    BadInputError
        If no trial is chosen, one has no motion, label or movie, the frame of a contact is not
        known, a movie has another number of frames than the motion, or the tables are there
        already. No table is written then.
    MissingExtraError
        If pylance is not installed.
    """
    try:
        import lance
    except ImportError as error:
        raise MissingExtraError("to write tables of Lance", "lance") from error
    dataset, names = labelled(folder, split, scenario, verify=verify)
    for path in (out / TABLE, out / EPISODES):
        if path.exists():
            raise BadInputError(f"{path} is there already: delete it, or give another folder")
    check_readme(out, TITLE)
    with folder_for_writing(out):
        slots, pushes = most_of(dataset, names)
        sizes = {
            "state": slots * len(NAMES), "action": pushes * len(ACTION), "success": 1, "done": 1
        }  # fmt: skip
        schema = pa.schema(
            {"episode_idx": pa.int32(), "step_idx": pa.int32(), "pixels": pa.binary()}
            | {name: pa.list_(pa.float32(), size) for name, size in sizes.items()}
        )
        rows: list[dict[str, Any]] = []
        wrong: list[BadInputError] = []

        def episodes() -> Iterator[pa.RecordBatch]:
            # Lance would report an error of its reader as one of its own.
            try:
                yield from batches()
            except BadInputError as error:
                wrong.append(error)
                raise

        def batches() -> Iterator[pa.RecordBatch]:
            for number, name in enumerate(tracked(names, "episodes", len(names), progress)):
                columns, row = _episode(dataset, name, slots, pushes)
                frames = len(columns["pixels"])
                columns["episode_idx"] = [number] * frames
                columns["step_idx"] = list(range(frames))
                rows.append({"episode_idx": number, **row})
                yield pa.record_batch([pa.array(columns[f.name], f.type) for f in schema], schema)

        reader = pa.RecordBatchReader.from_batches(schema, episodes())
        with new_folder(out / TABLE) as part:
            try:
                lance.write_dataset(reader, part / "table", schema=schema)
            except Exception:
                if wrong:
                    raise wrong[0] from None
                raise
            _lift(part)
        table = pa.Table.from_pylist(rows)
        index = table.schema.get_field_index("episode_idx")
        table = table.set_column(index, "episode_idx", table["episode_idx"].cast(pa.int32()))
        with new_folder(out / EPISODES) as part:
            lance.write_dataset(table, part / "table")
            _lift(part)
        write_readme(out, TITLE, README, dataset.index.set_index("trial").loc[names, "engine"])
    return [out / TABLE, out / EPISODES]


def _lift(folder: Path) -> None:
    """Move what is in the sub-folder ``table``, which Lance makes itself, into ``folder``."""
    for path in (folder / "table").iterdir():
        path.rename(folder / path.name)
    (folder / "table").rmdir()


def _episode(
    dataset: Dataset, name: str, slots: int, pushes: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the columns of the frames of a trial, and what is known of the trial."""
    if dataset.file(name, "movie") is None:
        raise BadInputError(f"trial {name!r} has no movie: make the trials without --no-movies")
    trial, pictures = dataset.trial(name), dataset.frames(name)
    labels, meta = trial.known_labels(), trial.metadata
    states = states_of(trial.scene, trial.trajectory, slots)
    frames = len(states)
    if len(pictures) != frames:
        raise BadInputError(f"trial {name!r}: the movie has {len(pictures)} frames, not {frames}")
    first = frames if labels.first_frame is None else labels.first_frame
    place = np.arange(frames)[:, None]
    columns = {
        "pixels": [_jpeg(picture) for picture in pictures],
        "state": list(states),
        "action": list(actions_of(trial.scene, trial.trajectory, pushes)),
        "success": list((place >= first).astype(np.float32)),
        "done": list((place == frames - 1).astype(np.float32)),
    }
    return columns, {
        "trial": meta.trial,
        "scenario": meta.scenario,
        "split": meta.split,
        "contact": labels.contact,
        "first_contact_frame": -1 if labels.first_frame is None else labels.first_frame,
    }


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="JPEG", quality=QUALITY)
    return buffer.getvalue()
