"""Models that encode or simulate trials."""

from physion.models.interface import Clip, Model, Provenance, Spec, build_model, models

__all__ = ["Clip", "Model", "Provenance", "Spec", "build_model", "models"]
