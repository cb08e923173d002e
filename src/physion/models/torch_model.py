"""Base class that saves typing: provenance and digest of a torch model.

A model needs no base class. This one writes what most networks would write alike.
"""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from physion.models.batch import Provenance, Spec


class TorchModel(nn.Module):
    """Torch ``Module`` with `provenance` and `digest`; subclasses set ``spec``.

    ``init`` says where the weights come from; it stands in every row of the predictions.
    """

    spec: Spec
    init: str = "random"

    def provenance(self) -> Provenance:
        """Return the name of the class, its initial weights and torch's version."""
        return Provenance(type(self).__name__, self.init, versions=f"torch {torch.__version__}")

    def digest(self) -> str:
        """Return the SHA-256 of the source of the class, its spec, and its weights as they are."""
        return digest_of(
            [source_of(type(self)), repr(self.spec), torch.__version__], self.state_dict().items()
        )

    @property
    def device(self) -> torch.device:
        """Device of the first weight; the CPU for a model without weights."""
        weight = next(self.parameters(), None)
        return torch.device("cpu") if weight is None else weight.device


def digest_of(settings: Any, weights: Iterable[tuple[str, Tensor]] = ()) -> str:
    """Return the hexadecimal SHA-256 of JSON settings and of named weights."""
    sha = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode())
    for name, value in weights:
        array = value.detach().cpu().contiguous()
        sha.update(f"{name} {array.dtype} {tuple(array.shape)}".encode())
        sha.update(array.reshape(-1).view(torch.uint8).numpy().tobytes())
    return sha.hexdigest()


def source_of(kind: type) -> str:
    """Return the source text of the module of a class; its name where there is no file."""
    module = inspect.getmodule(kind)
    try:
        return inspect.getsource(module) if module is not None else kind.__qualname__
    except (OSError, TypeError):
        return kind.__qualname__
