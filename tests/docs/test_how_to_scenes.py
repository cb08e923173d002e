"""The code blocks of the how-to pages about scenarios and shapes run as they are printed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from physion.scenes.sampling.sample import parse_presets
from support.paths import ROOT


@pytest.mark.parametrize("page", ["add-a-scenario", "add-a-shape"])
def test_code_blocks_run(page: str, tmp_path: Path) -> None:
    """Blocks that begin with a file name become that file; the others run after one another."""
    text = (ROOT / "docs" / "how-to" / f"{page}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    files = {match[1]: block for block in blocks if (match := re.match(r"# (\w+\.py)\n", block))}
    assert len(files) == 1 and len(blocks) == 3
    for name, block in files.items():
        (tmp_path / name).write_text(block, encoding="utf-8")
    script = "\n".join(block for block in blocks if block not in files.values())
    # A process of its own, so that the example is registered nowhere else.
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", ["how-to/add-a-scenario", "how-to/add-a-shape", "scenes"])
def test_paths_on_the_pages_exist(page: str) -> None:
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    paths = {path for path in re.findall(r"`(src/physion/[\w/.*]+)`", text) if "NAME" not in path}
    assert all(list(ROOT.glob(path)) for path in paths), paths


def test_preset_file_of_the_scenes_page_is_read() -> None:
    text = (ROOT / "docs" / "scenes.md").read_text(encoding="utf-8")
    (toml,) = re.findall(r"```toml\n(.*?)```", text, re.S)
    presets = parse_presets(toml, "my.toml")
    assert presets["heavy_ball_slope"].params.probe.mass == (8.0, 8.0)
