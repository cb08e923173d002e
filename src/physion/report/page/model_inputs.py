"""Sentences on what each model was given of a trial, and on the weights that it started from."""

from __future__ import annotations

from physion.report.inputs import ReportInputs
from physion.report.words import listed

WITHOUT = "none"
"""Value of the column *Init* of models without weights."""
INPUT_WORDS = {
    "rgb": "the pixels of the movie",
    "ids": "which object every pixel belongs to",
    "depth": "the distance of every pixel",
    "boxes": "a box around every object",
    "camera": "the camera",
    "state": "the true state of the scene: shapes, motion and, for models that use them, masses",
    "outcomes": "the outcome itself",
    "answers of people": "the answers of people",
    "base rate": "nothing of the trial but how often contact occurs",
}
"""Words for the values of the column *Inputs* of the predictions."""


def inputs_sentence(inputs: ReportInputs) -> str:
    """Return what each model was given, the models of equal inputs together; "" if none says so."""
    groups: dict[str, list[str]] = {}
    for model in dict.fromkeys(inputs.comparison.stimuli["model"].astype(str)):
        groups.setdefault(inputs.model_inputs.get(model, ""), []).append(model)
    unknown = groups.pop("", [])
    if not groups:
        return ""
    parts = [f"{listed(models)}: {_describe(given)}" for given, models in groups.items()]
    if unknown:
        parts.append(f"{listed(unknown)}: not stated")
    people = "People saw the movie. " if inputs.comparison.has_people else ""
    return f"{people}What each model was given: {'; '.join(parts)}."


def weights_sentence(inputs: ReportInputs) -> str:
    """Return the initial weights of each model that has any; "" if there is none."""
    groups: dict[str, list[str]] = {}
    for model in dict.fromkeys(inputs.comparison.stimuli["model"].astype(str)):
        groups.setdefault(inputs.model_weights.get(model, WITHOUT), []).append(model)
    groups.pop(WITHOUT, None)
    if not groups:
        return ""
    parts = [f"{listed(models)}: {weights}" for weights, models in groups.items()]
    return f"Weights that each network started from: {'; '.join(parts)}."


def _describe(given: str) -> str:
    names = [name.strip() for name in given.split(",")]
    return listed([INPUT_WORDS.get(name, name) for name in names])
