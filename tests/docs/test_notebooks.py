"""The example notebooks run from top to bottom, and are stored without outputs."""

from __future__ import annotations

import json
import os
from importlib.util import find_spec
from pathlib import Path

import pytest

from support.paths import ROOT
from support.programs import absent

NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))


def test_there_are_three() -> None:
    names = {path.stem for path in NOTEBOOKS}
    assert names == {"make_and_look_at_scenes", "evaluate_your_own_model", "analyse_a_study"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_stripped(path: Path) -> None:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert cells and not any(cell["outputs"] or cell["execution_count"] for cell in cells)
    assert not any(cell["metadata"] for cell in notebook["cells"])


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_cell_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if find_spec("nbclient") is None or find_spec("ipykernel") is None:
        absent("nbclient or ipykernel is absent: pip install -e '.[dev]'")
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT / "src")]))
    monkeypatch.setenv("MPLBACKEND", "agg")
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    folder = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources=folder).execute()
    printed = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert printed and any(tmp_path.iterdir())
    # A command of the shell that fails does not stop a notebook.
    texts = "".join(output.get("text", "") for output in printed)
    assert "physion: " not in texts and "Traceback" not in texts
