"""Readouts: predictions of contact from the features or the simulations of a model."""

from physion.readout.evaluate import Evaluation, evaluate, evaluate_model
from physion.readout.protocols import Readout
from physion.readout.settings import EvaluationConfig

__all__ = ["Evaluation", "EvaluationConfig", "Readout", "evaluate_model"]
