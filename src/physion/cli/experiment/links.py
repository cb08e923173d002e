"""Print the entry links of a study by scenario: for recruiters, previews and piloting.

With --ids, print a link for each person instead, signed for the id: it opens the study where only
signed links are allowed, and continues a session that began in another browser.
"""

from __future__ import annotations

import json as json_module
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from physion.experiment.study.study import Study


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment links``."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    base_url: str = "http://127.0.0.1:8000"
    """Public root URL of the server."""
    ids: Path | None = None
    """Text file with one id per line; prints a signed link for each."""
    source: Literal["link", "prolific", "sona", "mturk"] = "link"
    """Recruiter of these ids."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Print the links."""
    from physion.experiment.study.identity import Secrets
    from physion.experiment.study.recruitment import links
    from physion.experiment.study.study import load_study

    study = load_study(options.study)
    if options.ids is not None:
        return _print_personal(options, study)
    all_links = links(study, Secrets.load(options.study), options.base_url)
    if options.json:
        print(json_module.dumps({"links": [asdict(link) for link in all_links]}, indent=1))
        return 0
    for scenario in study.scenarios:
        print(scenario)
        for link in all_links:
            if link.scenario == scenario:
                fixed = f", condition {link.condition}" if link.condition else ""
                print(f"  {link.name}{fixed}: {link.goes_to}\n    {link.address}")
                if link.lacks:
                    print(f"    study.toml lacks {link.lacks}")
    return 0


def _print_personal(options: Options, study: Study) -> int:
    """Print the signed links of the ids in a file: scenario, id and URL, separated by tabs."""
    from physion.core.files import read_ids
    from physion.experiment.study.identity import Secrets
    from physion.experiment.study.recruitment import signed_links

    assert options.ids is not None
    ids = sorted(read_ids(options.ids))
    secrets = Secrets.load(options.study)
    found = signed_links(study, secrets, options.base_url, options.source, ids)
    if options.json:
        keys = ("scenario", "id", "address")
        rows = [dict(zip(keys, row, strict=True)) for row in found]
        print(json_module.dumps({"links": rows}, indent=1))
        return 0
    for row in found:
        print("\t".join(row))
    return 0
