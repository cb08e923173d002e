"""Models that encode, imagine or predict trials."""

from physion.clips.batch import Batch, Motion, Provenance, Rollout, Spec
from physion.models.interface import Model

__all__ = ["Batch", "Model", "Motion", "Provenance", "Rollout", "Spec"]
