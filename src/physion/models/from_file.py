"""Models in a user's Python file, named as ``FILE.py:Class``, without an installation."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

from physion.errors import BadInputError, UnknownNameError
from physion.seeds import stable_hash


def is_file_name(name: str) -> bool:
    """Return whether a model's name is of the form ``FILE.py:Class``."""
    return Path(name.partition(":")[0]).suffix == ".py"


def load_from_file(name: str) -> Any:
    """Import a Python file and return the class or function after the colon.

    The file is run as it stands, as any program that the user starts. It may import modules beside
    it. Raises `BadInputError` if it is missing or fails, with the line that failed, and
    `UnknownNameError` if it does not define the name.
    """
    text, _, attribute = name.partition(":")
    path = Path(text).resolve()
    if not path.is_file():
        raise BadInputError(f"model {name!r}: there is no file {text}")
    if not attribute:
        raise BadInputError(f"model {name!r} names a file alone; write {text}:NameOfTheClass")
    module = _import(path, name)
    if not hasattr(module, attribute):
        public = [key for key in vars(module) if not key.startswith("_")]
        raise UnknownNameError(f"name in {text}", attribute, public)
    return getattr(module, attribute)


def _import(path: Path, name: str) -> Any:
    # A name of its own, so that a user's file called torch.py or physion.py hides nothing. The same
    # file keeps it, so that objects of its classes can be sent to other processes; a file that was
    # edited, in a notebook for instance, has another one.
    content = path.read_bytes().decode(errors="replace")
    known = f"physion_model_{path.stem}_{stable_hash(str(path), content) % 2**32:08x}"
    if known in sys.modules:
        return sys.modules[known]
    spec = importlib.util.spec_from_file_location(known, path)
    if spec is None or spec.loader is None:
        raise BadInputError(f"model {name!r}: {path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[known] = module
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    except ModuleNotFoundError as error:
        del sys.modules[known]
        raise BadInputError(
            f"model {name!r} needs the library {error.name!r}, which is not installed"
        ) from error
    except Exception as error:
        del sys.modules[known]
        where = _line_in(error, path)
        raise BadInputError(
            f"model {name!r}: {path.name}{where} raised {type(error).__name__}: {error}"
        ) from error
    finally:
        sys.path.remove(str(path.parent))
    return module


def _line_in(error: BaseException, path: Path) -> str:
    """Return ``", line N"`` of the last line of ``path`` in the traceback of an error."""
    if isinstance(error, SyntaxError):
        return f", line {error.lineno}"
    line, trace = None, error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == str(path):
            line = trace.tb_lineno
        trace = trace.tb_next
    return "" if line is None else f", line {line}"
