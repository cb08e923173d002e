"""The export of ``physion experiment export``, packed as one zip file."""

from __future__ import annotations

import zipfile
from pathlib import Path

from sqlalchemy import Engine

from physion.experiment.study.study import Study


def export_archive(study: Study, engine: Engine, folder: Path, simulated: bool) -> Path:
    """Export the study into the private folder ``folder``; return the path of a zip file of it.

    ``simulated``: whether to include simulated participants, which are marked as such.
    """
    from physion.experiment.export.export_study import export_study

    written = folder / file_name(study)
    export_study(engine, study, written, simulated=simulated)
    packed = folder / "export.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for path in sorted(written.rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder))
    return packed


def file_name(study: Study) -> str:
    """Return name and version of the study as a file name of letters, digits, dots and dashes."""
    name = f"{study.name}-{study.version}"
    kept = "".join(c if c.isascii() and (c.isalnum() or c in "-.") else "-" for c in name)
    return kept.strip("-.")[:80] or "study"
