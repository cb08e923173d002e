"""Put trained models into the package, each with its card and SHA-256.

    python benchmarks/models/ship_weights.py TRAINED  # weights of `physion train`
    python benchmarks/models/ship_weights.py TRAINED --only svg-small rpin-small
    python benchmarks/models/ship_weights.py TRAINED --scores

TRAINED is the output folder of the trainings. Particle models were trained on the states of
``python benchmarks/models/particles.py data FOLDER``:

    physion train dpi FOLDER/all --out TRAINED --option steps=16000
    physion train gns FOLDER/all --out TRAINED --option steps=7000

GNS-RANSAC has the weights of GNS. Particle models need ``--particles FOLDER`` too: the distances of
the decision *touch* are fitted on contacts of its training trials, for the rollouts of each. Vision
models were trained on movies of 64 px:

    physion generate MOVIES --split training --count 200 --name small --width 64 --height 64 \
        --jitters 0
    physion train svg,cswm,rpin MOVIES --out TRAINED
    physion train op3 MOVIES --out TRAINED --option steps=1500

The weights of SVG are stored as float16. With --scores only the cards are written again, with the
digests of the weights and the tables of ``results/particles.md`` and ``vision_models.md``.
``train_intuition.py`` writes the weights and cards of intuition.
"""

from __future__ import annotations

import argparse
import dataclasses
import re
from pathlib import Path
from typing import Any

import torch

from physion import Dataset
from physion.clips.clips import whole_source
from physion.compute.tasks import processor
from physion.models.build import build_untrained
from physion.models.checkpoint import (
    BUILT_AS,
    load_tensors,
    read_checkpoint,
    shipped_digests,
    tensors_of,
    write_checkpoint,
)
from physion.models.particles.simulator import ParticleSimulator
from physion.training.train import calibrate

SHIPPED = Path(__file__).parents[2] / "src/physion/data/weights"
RESULTS = Path(__file__).parents[1] / "results"
TRIALS = {
    "states": "`python benchmarks/models/particles.py data FOLDER`",
    "clips": "`physion generate MOVIES --split training --count 200 --name small --width 64 "
    "--height 64 --jitters 0`",
}
"""Command that made the trials of a training, by what the model learns from."""
SOURCES = {
    "dpi-small": "dpi-small",
    "gns-small": "gns-small",
    "gns-ransac-small": "gns-small",
    "svg-small": "svg-small",
    "op3-small": "op3-small",
    "cswm-small": "cswm-small",
    "rpin-small": "rpin-small",
}
"""Training whose weights a shipped model has."""
HALF = ("svg-small",)
"""Models whose weights are stored as float16, since they would take more than 3 MB."""


def find(trained: Path, name: str) -> Path:
    """Return the folder of a finished training on all scenarios."""
    (folder,) = (path.parent for path in trained.glob(f"training/{name}-all-*/model.safetensors"))
    return folder


def ship(trained: Path, name: str, particles: Path | None) -> None:
    """Write the weights and the card of a model."""
    folder = find(trained, SOURCES[name])
    tensors, metadata = read_checkpoint(folder / "model.safetensors")
    card = (folder / "model_card.md").read_text()
    model: Any = build_untrained(name.removesuffix("-small"))
    load_tensors(folder, tensors, model)
    if isinstance(model, ParticleSimulator):
        if particles is None:
            raise SystemExit(f"{name} needs --particles FOLDER")
        fit_distances(model, Dataset(particles / "all"), metadata["config"])
    if name != SOURCES[name]:
        card = card.replace("gns-small", name).replace("| model | gns |", "| model | gns-ransac |")
    use = f"`physion evaluate {name.removesuffix('-small')} TRIALS`"
    card = card.split("## Use")[0] + f"## Use\n{use}\n"
    if isinstance(model, ParticleSimulator):
        touch = ", ".join(f"{value:.3f}" for value in model.touch.tolist())
        card += (
            "\n## Contact\nThe default decision has a fixed distance at the end, "
            f"{model.contact_distance:.3f} m.\nDistances of the decision touch, bodies and cloth, "
            f"m: {touch}\nThey are fitted on contacts of training trials, for its own rollouts.\n"
        )
    if name != SOURCES[name]:
        card += f"The weights are those of {SOURCES[name]}.\n"
    card += f"\n## Hardware\n{processor()}, one thread\n"
    card += f"\n## Trials\nMade by {TRIALS[model.learns_from]}.\n"
    stored = tensors_of(model)
    if name in HALF:
        stored = {k: v.half() if v.dtype == torch.float32 else v for k, v in stored.items()}
        card += "\nThe weights are rounded to float16.\n"
    SHIPPED.mkdir(exist_ok=True)
    metadata = {**metadata, BUILT_AS: model.built_as()}
    write_checkpoint(SHIPPED / f"{name}.safetensors", stored, metadata, kept=True)
    (SHIPPED / f"{name}.md").write_text(card)
    print(name, (SHIPPED / f"{name}.safetensors").stat().st_size, "bytes")


def fit_distances(model: ParticleSimulator, dataset: Dataset, training: Any) -> None:
    """Fit the distances of the decision *touch*, as a training with ``calibrated=true`` does."""
    model.settings = dataclasses.replace(model.settings, calibrated=True)
    source = whole_source(dataset, model.spec)
    calibrate(model, source, dataset.trials("training"), int(training["seed"]))


def write_scores() -> None:
    """Append the digest and the tables of every shipped model to its card, in place of earlier."""
    digests = shipped_digests()
    tables = [
        *tables_of((RESULTS / "particles.md").read_text(), "| model | scenario |"),
        *tables_of((RESULTS / "vision_models.md").read_text(), "| model | metric |"),
    ]
    for name in SOURCES:
        text = ["## Weights", f"SHA-256 of {name}.safetensors: {digests[name]}", "", "## Scores"]
        for title, head, rows in tables:
            own = [row for row in rows if row.startswith(f"| {name} |")]
            if own:
                text += ["", title, "", head, "|---" * (head.count("|") - 1) + "|", *own]
        path = SHIPPED / f"{name}.md"
        card, *_ = re.split(r"^## (?:Weights|Scores)$", path.read_text(), flags=re.MULTILINE)
        path.write_text(card.rstrip() + "\n\n" + "\n".join(text) + "\n")


def tables_of(text: str, head: str) -> list[tuple[str, str, list[str]]]:
    """Return title, head and rows of the tables that begin with ``head``.

    The title is the last line in bold, or the last heading, before the table.
    """
    tables: list[tuple[str, str, list[str]]] = []
    title, inside = "", False
    for line in text.splitlines():
        if line.startswith(("**", "## ")):
            title = line if line.startswith("**") else f"**{line.removeprefix('## ')}**"
        if line.startswith(head):
            tables.append((title, line, []))
            inside = True
        elif inside and line.startswith("|"):
            tables[-1][2].append(line)
        else:
            inside = False
    return tables


def main() -> None:
    """Ship the models, or some of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("trained", type=Path)
    parser.add_argument("--particles", type=Path)
    parser.add_argument("--scores", action="store_true")
    parser.add_argument("--only", nargs="*", choices=SOURCES, default=list(SOURCES))
    chosen = parser.parse_args()
    if not chosen.scores:
        for name in chosen.only:
            ship(chosen.trained, name, chosen.particles)
    write_scores()


if __name__ == "__main__":
    main()
