"""Official scenes and answers of people for the verbs: those of the package, or of a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from physion.data.official import MANIFEST, PACKAGED, official

if TYPE_CHECKING:
    from physion.data import OfficialData
    from physion.scenes.tdw.read_logs import TrialSet


def read_trials(folder: Path, scenario: str | None = None, limit: int | None = None) -> TrialSet:
    """Return the official trials of the package, of a converted folder, or of command logs.

    ``official`` means the package, unless there is a folder of that name.
    """
    from physion.core.errors import UnknownNameError
    from physion.scenes.tdw.read_logs import SCENARIOS, read_scenes

    data = official_data(folder)
    if data is None:
        return read_scenes(folder, scenario, limit)
    if scenario is not None and scenario not in SCENARIOS.values():
        raise UnknownNameError("scenario", scenario, SCENARIOS.values())
    return data.trial_set(scenario, limit)


def humans_folder(folder: Path) -> Path:
    """Return the folder with ``human_accuracy-*.csv`` that ``folder`` stands for."""
    data = official_data(folder)
    return folder if data is None else data.humans


def study_folder(folder: Path) -> Path:
    """Return the folder with ``humans/`` and ``results/`` that ``folder`` stands for."""
    data = official_data(folder)
    return folder if data is None else data.results.parent


def official_data(folder: Path) -> OfficialData | None:
    """Return the official data of the package or of a folder that `import-official` made."""
    if (folder / MANIFEST).is_file():
        return official(folder)
    if folder == Path(PACKAGED) and not folder.exists():
        return official()
    return None
