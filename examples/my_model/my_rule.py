"""A model of your own without torch and without a readout: it answers P(contact) itself."""

import hashlib
from pathlib import Path

import numpy as np

from physion.models import Batch, Provenance, Spec


class MyRule:
    """The nearer agent and patient are in the last observed picture, the likelier is a contact."""

    answers = "observed"  # the readout under which it answers
    spec = Spec(inputs=("boxes",), image_size=64, context=1, future=0, context_at="end", objects=2)

    def __init__(self, scale: float = 0.2) -> None:
        self.scale = scale

    def provenance(self) -> Provenance:
        """Return what the table of predictions says of the model."""
        return Provenance(model="my rule", init="none")

    def digest(self) -> str:
        """Return a hash of all that determines the answers: results are stored under it."""
        return hashlib.sha256(Path(__file__).read_bytes() + str(self.scale).encode()).hexdigest()

    def predict(self, batch: Batch) -> np.ndarray:
        """Return P(contact) (B,) from boxes (B, T, 2, 4): left, top, right, bottom, in 0..1."""
        agent, patient = batch.boxes[:, -1, 0], batch.boxes[:, -1, 1]
        apart = np.maximum(agent[:, :2] - patient[:, 2:], patient[:, :2] - agent[:, 2:])
        gap = np.linalg.norm(np.maximum(apart, 0), axis=1)
        return np.nan_to_num(np.exp(-gap / self.scale), nan=0.5)  # NaN: one is not seen
