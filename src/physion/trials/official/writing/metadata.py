"""Records of trials for ``metadata.json`` and ``trial_stats.json``.

Keys, definitions and roundings are the official ones (docs/official-system.md, section 4.3),
except that a room is called by its name (``box``, not ``b'box'``) and that where an object is not
to be seen its place in the picture is null.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.stimulus_names import CONTROLLERS
from physion.trials.official.names import ROOMS
from physion.trials.official.writing.frames import Labels
from physion.trials.official.writing.objects import OfficialObjects

HIDDEN = 0.005
"""Fraction of the picture, rounded to 3 digits as officially, below which an object counts as fully
occluded."""


def trial_record(
    objects: OfficialObjects,
    labels: Labels,
    first: NDArray[np.int16],
    last: NDArray[np.int16] | None,
    static: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the record of one trial.

    Parameters
    ----------
    objects, labels
        Objects of the trial, and the labels of all frames (F, ...) by name.
    first, last
        Official object ids by pixel (H, W), 0 the room, of the first and the last frame; the last
        may be None, if nothing was rendered.
    static
        Scalars of the static group.
    """
    scene, frames = objects.scene, len(objects.trajectory)
    ids, roles = objects.ids, scene.roles
    target = ids[roles.agent]
    moves = _any(labels, "target_has_moved")
    contact = _any(labels, "target_contacting_zone")
    record: dict[str, Any] = {
        "stimulus_name": static["stimulus_name"],
        "controller_name": CONTROLLERS.get(scene.scenario, scene.scenario),
        "git_commit": static["git_commit"],
        "num_frames": frames,
        "is_trial_valid": _any(labels, "trial_end"),
        "does_target_move": moves,
        "does_target_contact_zone": contact,
        "does_target_miss_zone": None if moves is None else moves and not contact,
        "does_target_hit_ground": _any(labels, "target_on_ground"),
        "first_target_move_frame": _first(labels, "target_has_moved"),
        "first_target_contact_zone_frame": _first(labels, "target_contacting_zone"),
        "first_target_hit_ground_frame": _first(labels, "target_on_ground"),
        "final_target_displacement": _displacement(labels),
        "final_target_mask_displacement": None
        if last is None
        else _shift(first == target, last == target),
        "target_visible_area": _area(first == target),
        "zone_visible_area": _area(first == ids[roles.patient]),
        "probe_visible_area": _area(first == ids[roles.probe]) if roles.probe else None,
        "is_any_object_fully_occluded": any(_area(first == id_) < HIDDEN for id_ in ids.values()),
        "room": ROOMS.get(scene.room, scene.room),
        "trial_seed": static["trial_seed"],
        "trial_num": static["trial_num"],
        "push_time": static["push_time"],
        "num_distractors": len(objects.scenery["distractors"]),
        "num_occluders": len(objects.scenery["occluders"]),
    }
    if scene.scenario in ("dominoes", "support"):
        record["num_middle_objects"] = len(objects.middle)
    if scene.scenario == "dominoes":
        record["remove_middle"] = bool(scene.parameters.get("remove_middle", False))
    if scene.scenario == "support":
        record["did_tower_fall"] = _any(labels, "did_fall")
    if scene.cloths:
        gaps = [gap for gap in labels["minimum_distance_target_to_zone"] if np.isfinite(gap)]
        record["minimum_distance_target_to_zone"] = float(min(gaps)) if gaps else None
    return record


def trial_stats(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return means over the trials of a configuration; of texts the first and the last value."""
    keys = dict.fromkeys(key for record in records for key in record if key != "trial_num")
    found: dict[str, Any] = {
        f"{key}/avg_label": _average([record.get(key) for record in records]) for key in keys
    }
    return {**found, "num_trials": len(records)}


def _average(values: Sequence[Any]) -> Any:
    known = [value for value in values if value is not None]
    if not known:
        return None
    if isinstance(known[0], str):
        return known[0] if len(set(known)) == 1 else f"{min(known)}-{max(known)}"
    if isinstance(known[0], dict):
        return {
            axis: _three_decimals(np.mean([value[axis] for value in known])) for axis in known[0]
        }
    if isinstance(known[0], list):
        return [_three_decimals(mean) for mean in np.mean(np.array(known, float), axis=0)]
    return _three_decimals(np.mean(np.array(known, float)))


def _three_decimals(value: Any) -> float:
    return round(float(value), 3)


def _any(labels: Labels, name: str) -> bool | None:
    return bool(np.any(labels[name])) if name in labels else None


def _first(labels: Labels, name: str) -> int | None:
    frames = np.flatnonzero(labels.get(name, []))
    return int(frames[0]) if len(frames) else None


def _displacement(labels: Labels) -> dict[str, float] | None:
    if "target_delta_position" not in labels:
        return None
    last = labels["target_delta_position"][-1]
    return {axis: _three_decimals(value) for axis, value in zip("xyz", last, strict=True)}


def _area(mask: NDArray[np.bool_]) -> float:
    return _three_decimals(mask.mean())


def _shift(first: NDArray[np.bool_], last: NDArray[np.bool_]) -> list[float] | None:
    """Return the shift (down, right) of the centre of the target's pixels; pictures are 2 wide."""
    if not (first.any() and last.any()):
        return None
    height, width = first.shape
    middles = []
    for mask in (first, last):
        row, column = (indices.mean() for indices in np.nonzero(mask))
        middles.append((2 * row / max(height - 1, 1) - 1, 2 * column / max(width - 1, 1) - 1))
    return [_three_decimals(after - before) for before, after in zip(*middles, strict=True)]
