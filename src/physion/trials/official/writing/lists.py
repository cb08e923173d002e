"""Lists of all trials in an exported folder, written from the exported files themselves."""

from __future__ import annotations

import csv
import io
import json
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from physion.atomic import write_atomic
from physion.errors import BadInputError
from physion.stimulus_names import FOLDERS
from physion.trials.official.names import split_name
from physion.trials.official.read_hdf5 import OfficialFile
from physion.trials.official.writing.metadata import trial_stats

EVALUATOR_LABELS = "all_video_labels.json"


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


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=4) + "\n").encode()


def _csv(rows: list[Any]) -> bytes:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue().encode()
