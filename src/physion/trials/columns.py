"""Columns of the index of a dataset: name, type and meaning of each, in their stored order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class IndexColumn(NamedTuple):
    """One column: its pandas type, and what its values are."""

    dtype: str
    meaning: str


FILES: Mapping[str, str] = {
    "trial_file": "scene, motion, contacts, label, first-frame ids (HDF5); contains the future",
    "movie": "all frames (MP4); contains the future",
    "observed_movie": "the observed frames alone (MP4)",
    "map": "agent in red and patient in yellow in the first frame (PNG)",
    "free_movie": "all frames in free colours (MP4); contains the future",
    "free_observed_movie": "the observed frames alone in free colours (MP4)",
}
"""Files that a trial can have, by the names of their columns, with their content."""

_FACTS: Mapping[str, IndexColumn] = {
    name: IndexColumn(dtype, meaning)
    for name, dtype, meaning in (
        ("trial", "string", "name of the trial, unique in the dataset"),
        ("dataset", "string", "name of the dataset, from which the seeds are derived"),
        ("scenario", "string", "scenario of the scene"),
        ("split", "string", "purpose of the trial"),
        ("index", "int64", "position of the trial in its split and scenario, from 0"),
        ("preset", "string", "parameter set of the scenario; missing for an imported scene"),
        ("seed", "string", "entropy of the random numbers, hexadecimal; missing if imported"),
        ("attempt", "Int64", "sampled scenes rejected before this one; missing if imported"),
        ("scene_digest", "string", "SHA-256 of everything that determines the motion"),
        ("contact", "bool", "the label: agent and patient touch at some time of the trial"),
        ("first_frame", "Int64", "first frame in which they touch; missing without contact"),
        ("observed_contact", "bool", "they touch already in the observed part"),
        ("min_distance", "Float64", "smallest gap between cloth and object, m; missing without"),
        ("robust", "Float64", "fraction of jittered simulations with the same outcome"),
        ("recorded_contact", "boolean", "outcome recorded with an imported scene, else missing"),
        ("frames", "int64", "frames of the whole trial"),
        ("observed_frames", "int64", "frames that may be shown to models and participants"),
        ("completed", "bool", "everything came to rest before the time limit"),
        ("physics_seconds", "float64", "duration in the simulated world, s"),
        ("playback_seconds", "float64", "duration of the full movie, s"),
        ("elements", "int64", "bodies and cloths that take part, without the patient"),
        ("distractors", "Int64", "props behind the scene; missing for an imported scene"),
        ("occluders", "Int64", "props between camera and scene; missing for an imported scene"),
        ("agent_share", "float64", "fraction of the first frame's pixels that show the agent"),
        ("patient_share", "float64", "fraction of the first frame's pixels that show the patient"),
        ("look", "string", "redyellow (agent red, patient yellow) or free (scene's own colours)"),
        ("width", "int64", "width of the pictures, pixels"),
        ("height", "int64", "height of the pictures, pixels"),
        ("engine", "string", "physics engine and its version"),
        ("renderer", "string", "renderer and its version"),
        ("package", "string", "package and its version"),
        ("digest", "string", "SHA-256 of the motion"),
    )
}

INDEX_COLUMNS: Mapping[str, IndexColumn] = {
    **_FACTS,
    **{
        f"{file}{suffix}": IndexColumn(dtype, meaning)
        for file, content in FILES.items()
        for suffix, dtype, meaning in (
            ("", "string", f"path of the file with {content}"),
            ("_bytes", "Int64", f"size in bytes of the file named in {file}"),
            ("_sha256", "string", f"SHA-256 of the file named in {file}"),
        )
    },
}
"""All columns. ``trial`` is unique. Paths are relative to the dataset's folder, with forward
slashes; path, size and SHA-256 are missing if the trial has no such file."""
