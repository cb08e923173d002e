"""Print the entry links of a study by scenario: for recruiters, previews and piloting."""

from __future__ import annotations

import json as json_module
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment links``."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    base_url: str = "http://127.0.0.1:8000"
    """Public root URL of the server."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Print the links."""
    from physion.cli.experiment.experiment import require_extra

    require_extra()
    from physion.experiment.study.identity import Secrets
    from physion.experiment.study.recruitment import links
    from physion.experiment.study.study import load_study

    study = load_study(options.study)
    all_links = links(study, Secrets.load(options.study), options.base_url)
    if options.json:
        print(json_module.dumps({"links": [asdict(link) for link in all_links]}, indent=1))
        return 0
    for scenario in study.scenarios:
        print(scenario)
        for link in all_links:
            if link.scenario == scenario:
                print(f"  {link.name}: {link.goes_to}\n    {link.address}")
                if link.lacks:
                    print(f"    study.toml lacks {link.lacks}")
    return 0
