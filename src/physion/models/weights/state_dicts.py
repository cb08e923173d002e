"""Files of tensors by name: reading without executing anything, and whether they fit a network."""

from __future__ import annotations

import pickle
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from physion.digests import file_sha256
from physion.errors import BadInputError

_WRAPPERS = ("state_dict", "model", "model_state_dict")
"""Keys of the state dict in the checkpoints of common training scripts."""


def read_state_dict(path: Path) -> dict[str, Tensor]:
    """Read tensors by name from ``.safetensors`` or a torch file of plain tensors.

    Torch files are read with ``weights_only``, so that no code in the file is executed. Raises
    `BadInputError` for any other content.
    """
    _check_exists(path)
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        # The error of torch advises to switch off `weights_only`, which would execute the file.
        raise BadInputError(
            f"{path} is refused: it holds more than plain tensors, or is no file of torch; save "
            "the state dict alone, best as .safetensors"
        ) from error
    except SafetensorError as error:
        raise BadInputError(
            f"{path} is refused: it is not a file of plain tensors ({first_line(error)})"
        ) from error
    except Exception as error:
        # A damaged pickle raises whatever its instructions lead to: IndexError, TypeError, ...
        raise BadInputError(f"{path} cannot be read as weights: {first_line(error)}") from error
    while isinstance(content, dict) and (inner := _wrapped(content)) is not None:
        content = inner
    if not isinstance(content, dict) or not all(isinstance(v, Tensor) for v in content.values()):
        raise BadInputError(f"{path} holds no state dict of tensors by name")
    return content


def load_fitting(
    network: nn.Module,
    state: Mapping[str, Tensor],
    *,
    unused: Collection[str] = (),
    where: str,
    name: str,
) -> None:
    """Load ``state`` into ``network``; its tensors must be those of the network.

    Counters of batches, which only training uses, may be missing.

    Parameters
    ----------
    network
        Network that receives the weights, called ``name`` in errors.
    state
        Tensors by name, called ``where`` in errors.
    unused
        Names that ``state`` may hold although the network lacks them, such as a classifier's.

    Raises
    ------
    BadInputError
        If tensors are missing, unexpected, or of another shape. Some of each are named.
    """
    expected = network.state_dict()
    missing = [key for key in expected.keys() - state.keys() if not _counts_batches(key)]
    other = [key for key in expected if key in state and state[key].shape != expected[key].shape]
    unexpected = [key for key in state if key not in expected and key not in unused]
    order = {key: index for index, key in enumerate(expected)}
    differences = [
        _some("missing", [repr(key) for key in sorted(missing, key=order.__getitem__)]),
        _some("unexpected", [repr(key) for key in unexpected]),
        _some(
            "of another shape",
            [f"{k!r} {tuple(state[k].shape)} for {tuple(expected[k].shape)}" for k in other],
        ),
    ]
    if any(differences):
        raise BadInputError(
            f"{where} does not fit encoder {name!r}: its tensors differ, "
            f"{', '.join(text for text in differences if text)}; "
            "is it the state dict of another network?"
        )
    kept = {key: value for key, value in state.items() if key in expected}
    try:
        network.load_state_dict(kept, strict=False)
    except RuntimeError as error:
        raise BadInputError(f"{where} does not fit encoder {name!r}: {error}") from error


def weights_sha256(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file of weights; `BadInputError` if there is none."""
    _check_exists(path)
    return file_sha256(path)


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message."""
    return (str(error).strip().splitlines() or ["no message"])[0]


def _check_exists(path: Path) -> None:
    if not path.is_file():
        raise BadInputError(
            f"weights {str(path)!r}: no such file; choose imagenet, random, package:<name>, or a "
            "state dict"
        )


def _wrapped(content: dict[str, Any]) -> dict[str, Any] | None:
    return next((content[k] for k in _WRAPPERS if isinstance(content.get(k), dict)), None)


def _counts_batches(key: str) -> bool:
    return key.endswith("num_batches_tracked")


def _some(what: str, names: Sequence[str]) -> str:
    """Return the number of names and the first three, or nothing if there are none."""
    if not names:
        return ""
    more = ", ..." if len(names) > 3 else ""
    return f"{len(names)} {what} ({', '.join(names[:3])}{more})"
