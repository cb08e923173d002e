"""Model card of a trained model: what it is, its data, settings, versions and losses."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from physion.models.checkpoints.checkpoint import WEIGHTS
from physion.models.settings import TrainingSettings
from physion.training.state import TrainingState


def model_card(
    model: Any,
    data: str,
    trials: Sequence[str],
    settings: TrainingSettings,
    seed: int,
    metadata: Mapping[str, Any],
    state: TrainingState,
) -> str:
    """Return the text of a model card, in Markdown.

    Parameters
    ----------
    model
        Trained model.
    data
        Name of the set of trials, such as ``all`` or ``no_drop``.
    trials
        Names of the trials.
    settings, seed
        Of the training.
    metadata
        Metadata of the file of the model: provenance, versions, hash of the config.
    state
        State after the last step.
    """
    provenance = {name: value for name, value in metadata["provenance"].items() if value}
    counts = Counter(trial.partition("_")[0] for trial in trials)
    scenarios = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
    config = getattr(model, "config", None)
    options = dataclasses.asdict(config) if dataclasses.is_dataclass(config) else {}  # type: ignore[arg-type]
    losses = {
        f"training, mean of the last {settings.log_every} steps": state.loss,
        "held-out trials": state.validation,
        "held-out trials, trivial predictor": state.baseline,
    }
    return "\n\n".join(
        [
            f"# {provenance['model']}, trained on {data}",
            "Model trained without labels by `physion train`. Whether it predicts contacts is "
            "measured by `physion evaluate`.",
            "## Model\n" + _table(provenance),
            *(["## Options\n" + _table(options)] if options else []),
            f"## Data\n{len(trials)} trials, by the start of their names: {scenarios}. "
            f"Fraction held out for validation: {settings.held_out:g}.",
            "## Training\n" + _table({**dataclasses.asdict(settings), "seed": seed}),
            "## Losses\n" + _table({k: v for k, v in losses.items() if not math.isnan(v)}),
            "## Versions\n" + _table({**metadata["versions"], "config": metadata["config_hash"]}),
            "## Licence\nThat of the trials and of the initial weights; the code of physion is "
            "under the MIT licence.",
            "## Use\nBuild the model with the same options, then load the weights:\n\n"
            "```python\n"
            "from pathlib import Path\n\n"
            "from physion.models.checkpoints.checkpoint import load_weights\n\n"
            f'load_weights(Path("{WEIGHTS}"), model)\n'
            "```\n",
        ]
    )


def _table(values: Mapping[str, Any]) -> str:
    rows = [f"| {name} | {_text(value)} |" for name, value in values.items()]
    return "\n".join(["| | |", "|---|---|", *rows])


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
