"""Base class that saves typing: provenance and digest of a torch model.

A model needs no base class. This one writes what most networks would write alike.
"""

from __future__ import annotations

import inspect
import marshal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from physion.clips.batch import Provenance, Spec
from physion.core.files import json_digest
from physion.core.seeds import stable_hash
from physion.models.interface import Model
from physion.models.user_files import FileLoader

_KNOWN_PACKAGES = {"abc", "builtins", "physion", "torch", "typing"}
"""Packages whose versions, not sources, belong to the digest of a model."""
_sources: dict[type, str] = {}
"""What `source_of` has read, by class."""


class TorchModel(nn.Module, Model):
    """Torch ``Module`` with `provenance` and `digest`; subclasses set ``spec``.

    ``init`` says where the weights come from; it stands in every row of the predictions.
    """

    spec: Spec
    init: str = "random"

    def provenance(self) -> Provenance:
        """Return the name of the class, its initial weights and torch's version."""
        return Provenance(type(self).__name__, self.init, versions=f"torch {torch.__version__}")

    def digest(self) -> str:
        """Return the SHA-256 of the source of the class, spec, settings, and weights as they are.

        Add to it what else determines the results, such as code in other files.
        """
        parts = [source_of(type(self)), repr(self.spec), repr(self.settings), torch.__version__]
        return weights_digest(parts, self.state_dict().items())

    @property
    def device(self) -> torch.device:
        """Device of the first weight; the CPU for a model without weights."""
        weight = next(self.parameters(), None)
        return torch.device("cpu") if weight is None else weight.device


@contextmanager
def initial_weights(*key: str | int) -> Iterator[None]:
    """Let a key, such as a name and a seed, determine the weights that are made in this block.

    Torch's generator is afterwards as it was.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(stable_hash(*key) % 2**63)
        yield


def weights_digest(settings: Any, weights: Iterable[tuple[str, Tensor]] = ()) -> str:
    """Return the hexadecimal SHA-256 of JSON settings and of named weights."""

    def parts() -> Iterator[bytes]:
        for name, value in weights:
            array = value.detach().cpu().contiguous()
            yield f"{name} {array.dtype} {tuple(array.shape)}".encode()
            yield array.reshape(-1).view(torch.uint8).numpy().tobytes()

    return json_digest(settings, parts())


def source_of(kind: type) -> str:
    """Return the source text of the modules of a class and of those that it is derived from.

    Modules of torch and of this package do not count, except the module of the class itself. For a
    class without a file, as in a notebook, it is the compiled code. The text is read once: a file
    may be edited while its classes, as they were, are at work.
    """
    if kind in _sources:
        return _sources[kind]
    texts = {}
    for part in kind.__mro__:
        package = part.__module__.partition(".")[0]
        if part is not kind and package in _KNOWN_PACKAGES:
            continue
        module = inspect.getmodule(part)
        loader = getattr(module, "__loader__", None)
        try:
            if isinstance(loader, FileLoader):
                text = loader.text
            else:
                text = inspect.getsource(module) if module else _code_of(part)
            texts[part.__module__] = text
        except (OSError, TypeError):
            texts[f"{part.__module__}.{part.__qualname__}"] = _code_of(part)
    _sources[kind] = "\n".join(texts.values())
    return _sources[kind]


def _code_of(kind: type) -> str:
    """Return a text that differs if the functions that a class defines were compiled otherwise."""
    codes = {name: getattr(value, "__code__", None) for name, value in vars(kind).items()}
    parts = [f"{name} {marshal.dumps(code).hex()}" for name, code in codes.items() if code]
    return "\n".join([kind.__qualname__, *parts])
