"""Models of a plan on the command line: a list with commas, and options of all or of one."""

from __future__ import annotations

from physion.cli.model_options import parse_options
from physion.readout.plans.selection import ModelChoice, split_names


def choose_models(names: str, pairs: tuple[str, ...], **common: str | None) -> list[ModelChoice]:
    """Return the models in a list with commas, each with its options.

    Parameters
    ----------
    names
        Names of models.
    pairs
        Options: ``NAME=VALUE`` of every model, or ``MODEL:NAME=VALUE`` of one of them.
    **common
        Options of every model that have an argument of their own, if they are not None or empty.

    Raises
    ------
    BadInputError
        If an option is no pair or is given twice.
    """
    models = split_names(names, "model")
    own: dict[str, list[str]] = {name: [] for name in models}
    for pair in pairs:
        named = [name for name in models if pair.startswith(f"{name}:")]
        for name in named or models:
            own[name].append(pair.removeprefix(f"{name}:"))
    given = {name: value for name, value in common.items() if value}
    return [ModelChoice(name, parse_options(tuple(own[name]), given)) for name in models]
