"""Readouts: predictions of contact from the features or the simulations of a model."""

from physion.readout.evaluate import Evaluation, EvaluationConfig, evaluate, evaluate_model
from physion.readout.protocols import Readout

__all__ = ["Evaluation", "EvaluationConfig", "Readout", "evaluate", "evaluate_model"]
