"""Put trained particle models into the package, each with its card and SHA-256.

    python benchmarks/ship_weights.py FOLDER TRAINED        # weights of `physion train`
    python benchmarks/ship_weights.py FOLDER TRAINED --only gns-small gns-ransac-small
    python benchmarks/ship_weights.py FOLDER TRAINED --scores

FOLDER holds the trials of ``benchmarks/particles.py data``. TRAINED is the output folder of

    physion train dpi FOLDER/all --out TRAINED --steps 16000
    physion train gns FOLDER/all --out TRAINED --steps 7000

GNS-RANSAC has the weights of GNS and thresholds that are fitted on its own rollouts. With --scores
only the cards are written again, with the tables of ``results/particles.md``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import platform
from pathlib import Path

from physion import Dataset, build_model
from physion.models.checkpoints.checkpoint import (
    load_tensors,
    read_checkpoint,
    tensors_of,
    write_checkpoint,
)
from physion.models.checkpoints.trained import BUILT_AS, DIGESTS, FOLDER
from physion.models.particles.simulator import ParticleSimulator
from physion.training.sources.open_source import whole_source
from physion.training.train import calibrate

SHIPPED = Path(__file__).parent.parent / "src/physion/models/checkpoints" / FOLDER
RESULTS = Path(__file__).parent / "results" / "particles.md"
SOURCES = {"dpi-small": "dpi-small", "gns-small": "gns-small", "gns-ransac-small": "gns-small"}
"""Training whose weights a shipped model has."""


def find(trained: Path, name: str) -> Path:
    """Return the folder of a finished training on all scenarios."""
    (folder,) = (path.parent for path in trained.glob(f"training/{name}-all-*/model.safetensors"))
    return folder


def ship(dataset: Dataset, trained: Path, name: str) -> None:
    """Write the weights and the card of a model."""
    folder = find(trained, SOURCES[name])
    tensors, metadata = read_checkpoint(folder / "model.safetensors")
    card = (folder / "model_card.md").read_text()
    model = build_model(name.removesuffix("-small"))
    assert isinstance(model, ParticleSimulator)
    load_tensors(folder, tensors, model)
    if name != SOURCES[name]:
        source = whole_source(dataset, model.spec)
        calibrate(model, source, dataset.trials("training"), metadata_seed(metadata))
        card = card.replace("gns-small", name).replace("| rigid | fit |", "| rigid | robust |") + (
            "\nThe weights are those of gns-small; the distances that count as contact are fitted "
            "on the rollouts of this model.\n"
        )
    card = card.split("## Use")[0] + "## Use\n`physion evaluate TRIALS "
    card += f"{name.removesuffix('-small')} --weights shipped`\n"
    touch = ", ".join(f"{value:.3f}" for value in model.touch.tolist())
    card += f"\n## Contact\nDistance that counts as contact, bodies and cloth, m: {touch}\n"
    card += f"\n## Hardware\n{platform.processor() or platform.machine()}, one thread\n"
    card += "\n## Trials\nMade by `python benchmarks/particles.py data FOLDER`.\n"
    SHIPPED.mkdir(exist_ok=True)
    metadata = {**metadata, BUILT_AS: model.built_as()}
    write_checkpoint(SHIPPED / f"{name}.safetensors", tensors_of(model), metadata)
    (SHIPPED / f"{name}.md").write_text(card)
    print(name, (SHIPPED / f"{name}.safetensors").stat().st_size, "bytes", touch)


def metadata_seed(metadata: dict[str, object]) -> int:
    """Return the seed of a training."""
    config = metadata["config"]
    assert isinstance(config, dict)
    return int(config["seed"])


def write_scores() -> None:
    """Append the tables of every shipped model to its card, in place of earlier ones."""
    lines = RESULTS.read_text().splitlines()
    for name in sorted(path.stem for path in SHIPPED.glob("*.safetensors")):
        text = ["## Scores"]
        for line in lines:
            if line.startswith("**") or line.startswith("| model |"):
                text += ["", line] if line.startswith("**") else ["", line, "|---" * 7 + "|"]
            elif line.startswith(f"| {name} |"):
                text.append(line)
        path = SHIPPED / f"{name}.md"
        card = path.read_text().split("## Scores")[0].rstrip()
        path.write_text(card + "\n\n" + "\n".join(text) + "\n")


def main() -> None:
    """Ship the models, or some of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("trained", type=Path)
    parser.add_argument("--scores", action="store_true")
    parser.add_argument("--only", nargs="*", choices=SOURCES, default=list(SOURCES))
    chosen = parser.parse_args()
    if not chosen.scores:
        for name in chosen.only:
            ship(Dataset(chosen.folder / "all"), chosen.trained, name)
        digests = {
            path.stem: hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(SHIPPED.glob("*.safetensors"))
        }
        (SHIPPED / DIGESTS).write_text(json.dumps(digests, indent=2) + "\n")
    if RESULTS.is_file():
        write_scores()


if __name__ == "__main__":
    main()
