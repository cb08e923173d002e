"""Print a script that completes verbs and options in bash, zsh or fish.

The script needs a Python interpreter called python3 or python, but not this package, so that it
answers at once. Write it again after an update.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal, Union

import tyro

from physion.cli.help.verbs import VERBS, module_of


@dataclass(frozen=True)
class Options:
    """Options of ``physion completion``."""

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]
    """Shell that reads the script."""


def main(options: Options) -> int:
    """Print the script."""
    verbs = _union({verb: module_of(verb) for verb in VERBS})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "completion"
        # tyro exits when the script is written.
        with contextlib.suppress(SystemExit):
            tyro.cli(
                verbs,
                prog="physion",
                args=["--tyro-write-completion", options.shell, str(path)],
            )
        script = path.read_text(encoding="utf-8")
    # The script prints one line for each completion, but descriptions may have several.
    print(re.sub(r"(?m)^COMPLETION_SPEC = .*$", lambda spec: spec[0].replace("\\n", " "), script))
    return 0


def _union(modules: Mapping[str, ModuleType]) -> Any:
    """Return a union of the options of verbs, which tyro reads as sub-commands."""
    kinds = []
    for name, module in modules.items():
        kind = module.Options
        if subverbs := getattr(module, "SUBVERBS", None):
            fields = [
                ("own", Annotated[kind, tyro.conf.arg(name="")]),
                ("subverb", _union({word: import_module(path) for word, path in subverbs.items()})),
            ]
            kind = dataclasses.make_dataclass(f"{name.title()}Options", fields)
        kinds.append(Annotated[kind, tyro.conf.subcommand(name=name, prefix_name=False)])
    return Union[tuple(kinds)]  # noqa: UP007 - the members are known at run time alone
