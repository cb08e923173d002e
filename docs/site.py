"""Pages of the site that are made of other files, and links that lead out of the folder ``docs``.

mkdocs calls the functions ``on_...`` (``hooks`` in mkdocs.yml). The overview comes from the README,
the verbs from their help texts, the metrics from their registry, the model cards from
the shipped weights, so that each fact stands in one place.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import textwrap
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
CARDS = ROOT / "src" / "physion" / "data" / "weights"
OTHERS = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "CITATION.cff": "files/CITATION.cff",
}
"""Files of the repository by their path, and where the site has them."""
LINK = re.compile(r"(\]\s?)\(([^()\s]+)\)")


def on_files(files: Files, *, config: Any) -> Files:
    """Add the generated pages and the files that pages link to."""
    for name, text in pages().items():
        files.append(File.generated(config, name, content=text))
    for path in sorted(linked()):
        files.append(File.generated(config, place(path), content=(ROOT / path).read_bytes()))
    return files


def linked() -> set[str]:
    """Return the files outside of ``docs``, and not among the pages, that pages link to."""
    sources = [*(ROOT / "docs").rglob("*.md"), *(ROOT / n for n in OTHERS if n.endswith(".md"))]
    found = {
        first_file(os.path.normpath(page.parent.relative_to(ROOT) / match[2].partition("#")[0]))
        for page in sources
        for match in LINK.finditer(page.read_text(encoding="utf-8"))
        if "://" not in match[2]
    }
    return {p for p in found if place(p).startswith("files/") and (ROOT / p).is_file()}


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Lead links to files outside of ``docs`` to their place in the site."""
    here = PurePosixPath("docs", page.file.src_uri).parent
    return relink(markdown, here, PurePosixPath(page.file.src_uri).parent)


def relink(markdown: str, here: PurePosixPath, there: PurePosixPath) -> str:
    """Return the text with the links of a file in folder ``here`` of the repository.

    ``there``: folder of the site that the page is in.
    """

    def lead(match: re.Match[str]) -> str:
        target, hash_, anchor = match[2].partition("#")
        if not target or "://" in target or target.startswith("mailto:"):
            return match[0]
        path = os.path.normpath(here / target)
        return f"{match[1]}({os.path.relpath(place(path), there)}{hash_}{anchor})"

    return LINK.sub(lead, markdown)


def place(path: str) -> str:
    """Return where the site has a file of the repository."""
    if path in OTHERS:
        return OTHERS[path]
    path = first_file(path)
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    # As text, so that a browser shows it and mkdocs makes no page of it.
    return f"files/{path}.txt" if path.endswith(".md") else f"files/{path}"


def first_file(path: str) -> str:
    """Return a path in the repository, of a folder the path of its first file."""
    if not (ROOT / path).is_dir():
        return path
    files = sorted(member for member in (ROOT / path).iterdir() if member.is_file())
    return files[0].relative_to(ROOT).as_posix() if files else path


def pages() -> dict[str, str]:
    """Return the text of every page that is made of other files, by its path in the site."""
    made = {
        "verbs.md": verbs_page(),
        "metrics.md": metrics_page(),
        "model-cards.md": cards_page(),
    }
    for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        made[OTHERS[name]] = relink(text, PurePosixPath(), PurePosixPath())
    return made


def verbs_page() -> str:
    """Return the help texts of all verbs and sub-verbs."""
    from physion.cli.help import VERBS, module_of

    parts = ["# Verbs\nThe texts that `physion VERB --help` prints.\n"]
    for verb, summary in VERBS.items():
        subverbs = getattr(module_of(verb), "SUBVERBS", {})
        parts.append(f"## {verb}\n{summary[0].upper()}{summary[1:]}.\n\n{help_text(verb)}")
        parts += [f"### {verb} {word}\n{help_text(verb, word)}" for word in subverbs]
    return "\n".join(parts)


def help_text(*words: str) -> str:
    """Return what ``physion WORDS --help`` prints, as a block of text."""
    from physion.cli.main import main

    out = io.StringIO()
    # The width of the help text is the terminal's.
    before, os.environ["COLUMNS"] = os.environ.get("COLUMNS"), "96"
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            main([*words, "--help"])
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before
    text = re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue()).rstrip()
    text = "\n".join(
        textwrap.fill(line, 96) if len(line) > 96 else line for line in text.splitlines()
    )
    # Defaults that differ from machine to machine.
    workers = r"(--workers INTEGER\s.*?default: )\d+"
    text = re.sub(workers, r"\g<1>number of cores", text, flags=re.S)
    return f"```text\n{text}\n```\n"


def metrics_page() -> str:
    """Return a table of all metrics with their definitions."""
    from physion.analysis.metrics import all_metrics

    needs = {
        "outcome": "outcomes of the trials",
        "people": "average answers of people",
        "participants": "answers of single participants",
    }
    better = {"higher": "higher", "lower": "lower", "zero": "nearest to 0", "": "-"}
    rows = [
        f"| `{metric.name}` | {metric.definition} | {needs[metric.needs]} | "
        f"{better[metric.better]} |"
        for metric in all_metrics()
    ]
    head = (
        "# Meaning of the metrics\nEvery metric is computed for each model and readout, on the "
        "stimuli of one scenario and on all together. An undefined value is left empty, with its "
        "reason. [What the analysis computes](docs/reference/analysis.md) describes averages and "
        "intervals, [adding a metric](docs/how-to/add-a-metric.md) how to extend this list.\n\n"
        "| column | definition | needs | better |\n|---|---|---|---|\n"
    )
    return relink(head, PurePosixPath(), PurePosixPath()) + "\n".join(rows) + "\n"


def cards_page() -> str:
    """Return the cards of the models whose weights come with the package."""
    parts = [
        "# Model cards\n`physion train` writes a card next to the weights of every training. These "
        "are the cards of the weights that come with the package, the default of these models.\n"
    ]
    cards = [path.read_text(encoding="utf-8") for path in sorted(CARDS.glob("*.md"))]
    # One level lower, below the heading of the page.
    return "\n".join([*parts, *(re.sub(r"^#", "##", card, flags=re.M) for card in cards)])
