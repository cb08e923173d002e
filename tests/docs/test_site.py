"""The site of the documentation builds in strict mode and loads nothing from other hosts."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path

import pytest

from support.paths import ROOT
from support.programs import absent

LOADING = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}
"""Elements for which a browser loads a file, and the attribute that names it."""


class Loaded(HTMLParser):
    """Collects the addresses that a page loads, and those that it links to."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        address = values.get(LOADING.get(tag, ""))
        if address and values.get("rel") not in ("canonical", "prev", "next"):
            self.loaded.append(address)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if find_spec("material") is None:
        absent("mkdocs-material is absent: pip install -e '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    # An address that refuses connections in place of the network.
    nowhere = dict.fromkeys(("http_proxy", "https_proxy", "ALL_PROXY"), "http://127.0.0.1:9")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env=os.environ | nowhere | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_every_page_is_built_and_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    names = {path.relative_to(site).as_posix() for path in pages}
    sources = {path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")}
    assert {path.with_suffix(".html").as_posix() for path in sources} <= names
    assert {
        "index.html",
        "verbs.html",
        "metrics.html",
        "results/models.html",
        "reference/api.html",
    } <= names
    for path in pages:
        page = Loaded()
        page.feed(path.read_text(encoding="utf-8"))
        assert page.loaded
        assert not [a for a in page.loaded if re.match(r"(https?:)?//", a)], path
    styles = "".join(path.read_text(encoding="utf-8") for path in site.rglob("*.css"))
    assert not re.findall(r"(?:url\(|@import )[\"']?(?:https?:)?//[^)]*", styles)


@pytest.mark.slow
def test_generated_pages_say_what_the_package_says(site: Path) -> None:
    verbs = (site / "verbs.html").read_text(encoding="utf-8")
    assert "physion experiment forget" in verbs and "--tyro" not in verbs
    assert "number of cores" in verbs and "\x1b" not in verbs
    metrics = (site / "metrics.html").read_text(encoding="utf-8")
    assert "partial" in metrics and "official outcome" in metrics
    assert "gns-small" in (site / "model-cards.html").read_text(encoding="utf-8")
    assert "Generation of trials" in (site / "results/trials.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_broken_link_is_an_error(tmp_path: Path) -> None:
    if find_spec("material") is None:
        absent("mkdocs-material is absent: pip install -e '.[docs]'")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("[gone](gone.md)\n", encoding="utf-8")
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    text = re.sub(r"^hooks: .*\n", "", text.partition("nav:")[0], flags=re.M)
    (tmp_path / "mkdocs.yml").write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode != 0 and "gone.md" in done.stderr
