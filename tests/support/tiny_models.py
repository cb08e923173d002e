"""Every registered model in its smallest configuration."""

from __future__ import annotations

from typing import Any

from physion.models.build import build_model

TINY: dict[str, Any] = {
    "encoder": "test_vit", "image_size": 64, "weights": "random", "hidden": 16,
}  # fmt: skip
FROZEN = [
    "frozen-encoder", "pVGG-mlp", "pVGG-lstm", "pDeIT-mlp", "pDeIT-lstm", "pEffNetLite0-mlp",
    "pDINO-mlp", "pDINO-lstm", "pDINOv2-mlp", "pDINOv2-lstm", "pDINOv3-mlp", "pDINOv3-lstm",
    "pEffNetLite0-lstm", "pHEDVGG16-mlp", "pHEDVGG16-lstm",
]  # fmt: skip
VIDEO: dict[str, Any] = {
    "weights": "random", "image_size": 32, "patch": 8, "frames": 4, "width": 24, "depth": 2,
    "heads": 2,
}  # fmt: skip
UNTRAINED: dict[str, Any] = {"weights": "random"}
OPTIONS: dict[str, dict[str, Any]] = {
    **dict.fromkeys(FROZEN, TINY),
    **dict.fromkeys(("VideoMAE", "VideoMAEv2", "V-JEPA2", "V-JEPA2.1"), VIDEO),
    **dict.fromkeys(("svg", "op3", "cswm", "rpin", "gns", "gns-ransac", "dpi"), UNTRAINED),
    **dict.fromkeys(("intuition-states", "intuition-masks", "intuition-pixels"), UNTRAINED),
    "noisy-simulation": {"samples": 3},
    "seeing-simulation": {"samples": 3, "image_size": 96},
    "noisy-simulation-outcomes": {"samples": 3},
    "noisy-simulation-people": {"samples": 3},
}
"""Options by name of the model; other models have none."""


def tiny(name: str) -> Any:
    """Build a model in its smallest configuration."""
    return build_model(name, **OPTIONS.get(name, {}))
