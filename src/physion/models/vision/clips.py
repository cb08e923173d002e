"""Pictures of clips that must have a certain length."""

from __future__ import annotations

from torch import Tensor

from physion.errors import BadInputError
from physion.models.batch import Batch, Spec
from physion.models.vision.pictures import normalized_pictures


def window_pictures(batch: Batch, spec: Spec, model: str, frames: int) -> Tensor:
    """Return the pictures (B, T, 3, H, W) of training clips, T = ``frames``.

    Raises `BadInputError` for pictures of another size, or clips of another length.
    """
    pictures = normalized_pictures(batch, spec, model)
    if pictures.shape[1] != frames:
        raise BadInputError(
            f"{model} is trained on clips of {frames} frames, not {pictures.shape[1]}"
        )
    return pictures


def context_pictures(batch: Batch, spec: Spec, model: str) -> Tensor:
    """Return the pictures (B, T, 3, H, W) of the context of clips.

    Raises
    ------
    BadInputError
        If there are no pictures, pictures of another size, or more or fewer frames than the
        context has; or if a movie ends within the context.
    """
    pictures = normalized_pictures(batch, spec, model)
    if pictures.shape[1] != spec.context:
        raise BadInputError(
            f"{model} imagines from a context of {spec.context} frames, not {pictures.shape[1]}"
        )
    for trial, valid in zip(batch.trials, batch.valid, strict=True):
        if not bool(valid.all()):
            raise BadInputError(
                f"{model}, trial {trial!r}: the movie has not all frames of the context, up to "
                f"frame {spec.context_frames()[-1]}; leave the trial out, or make its movie again"
            )
    return pictures
