"""Options of ``physion run``."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from physion.data.official import PACKAGED


@dataclass(frozen=True)
class Options:
    """Options of ``physion run``."""

    scenes: Path = Path(PACKAGED)
    """Official scenes: those of the package (official), a folder made by physion import, or one
    with command logs."""
    humans: Path | None = None
    """Answers of people to these scenes: official, or a folder with human_accuracy-*.csv. Default:
    official with the scenes of the package, else none."""
    sampled: bool = False
    """Sample scenes of Dominoes, Collide and Drop instead; nobody has seen them."""
    models: tuple[str, ...] = ()
    """Models, separated by spaces or commas (physion ls models)."""
    out: Path | None = None
    """Folder for trials, predictions and the report; default: runs/official or runs/sampled."""
    limit: int | None = None
    """Testing trials per scenario, 10 by default, and as many for the readout (twice as many of
    sampled ones); 0 takes all official ones."""
    size: int = 128
    """Pixels per side of the movies."""
    encoder: str = "resnet18"
    """Image encoder of frozen-encoder, any timm name."""
    weights: str = "random"
    """Weights of this encoder: imagenet (downloaded by timm), package:NAME, a file, or random."""
    dynamics: str = "mlp"
    """Dynamics of frozen-encoder that predict the next feature: mlp or lstm."""
    steps: int = 300
    """Training steps of models that learn."""
    encoder_batch: int = 4
    """Clips that a network encodes at a time; lower it when memory runs out."""
    samples: int = 20
    """Simulations per trial of noisy-simulation."""
    engine: str = "physion"
    """Engine of the trials and of noisy-simulation (physion ls engines); mujoco has no cloth."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""
    trial_pages: bool = False
    """Also write a page for each stimulus, to trials/ in the folder of the report."""
    json: bool = False
    """Print one JSON object instead of lines."""
