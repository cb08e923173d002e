"""Pictures of a batch as the input of a network."""

from __future__ import annotations

from torch import Tensor

from physion.errors import BadInputError
from physion.models.batch import Batch, Spec


def normalized_pictures(batch: Batch, spec: Spec, model: str) -> Tensor:
    """Return the pictures (B, T, 3, H, W) of a batch, minus ``spec.mean``, divided by ``spec.std``.

    Parameters
    ----------
    batch
        Clips with ``rgb`` (B, T, H, W, 3), uint8, on the device of the network.
    spec
        What the model asks for; its statistics are those of the channels in 0..1.
    model
        Name of the model, for the message.

    Raises
    ------
    BadInputError
        If the batch has no pictures, or pictures of another size.
    """
    frames, size = batch.rgb, spec.image_size
    if frames is None or tuple(frames.shape[2:]) != (size, size, 3):
        found = "none" if frames is None else tuple(frames.shape)
        raise BadInputError(
            f"{model}: pictures must be uint8 (batch, time, {size}, {size}, 3), not {found}"
        )
    scaled: Tensor = frames.permute(0, 1, 4, 2, 3).float() / 255
    mean, std = (scaled.new_tensor(value).view(3, 1, 1) for value in (spec.mean, spec.std))
    return (scaled - mean) / std
