"""What ``physion experiment export`` writes, as one zip file."""

from __future__ import annotations

import zipfile
from pathlib import Path

from sqlalchemy import Engine

from physion.experiment.study.study import Study


def export_archive(study: Study, engine: Engine, folder: Path, simulated: bool) -> Path:
    """Exports into a new folder below ``folder``, which must be private, and packs it.

    ``simulated``: with simulated participants, who are marked as such.
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
    """Name of the study for a file: letters, digits, points and dashes alone."""
    words = f"{study.name}-{study.version}"
    kept = "".join(c if c.isascii() and (c.isalnum() or c in "-.") else "-" for c in words)
    return kept.strip("-.")[:80] or "study"
