"""Models in a user's Python file, named as ``FILE.py:Class``, without an installation."""

from __future__ import annotations

import importlib.util
import sys
from importlib.abc import ExecutionLoader
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.seeds import stable_hash

_loaded: dict[str, tuple[Path, str]] = {}
"""Path and text of the files that were loaded, by name of the module."""


class FileLoader(ExecutionLoader):
    """Loader of a module from a text, which was read from ``path`` and may differ from it now."""

    def __init__(self, path: Path, text: str) -> None:
        self.path, self.text = path, text

    def get_filename(self, fullname: str) -> str:
        """Return the path, for tracebacks and ``__file__``."""
        return str(self.path)

    def get_source(self, fullname: str) -> str:
        """Return the text."""
        return self.text


class LoadedFiles:
    """The files that were loaded; whatever process unpickles this object loads them, too.

    Pickled before a model, it makes the classes of the model known where it is unpickled.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return _load_again, (dict(_loaded),)


def _load_again(files: dict[str, tuple[Path, str]]) -> LoadedFiles:
    for known, (path, text) in files.items():
        if known not in sys.modules:
            _run(known, path, text)
    return LoadedFiles()


def is_file_name(name: str) -> bool:
    """Return whether a model's name is of the form ``FILE.py:Class``."""
    return Path(name.partition(":")[0]).suffix == ".py"


def load_from_file(name: str) -> Any:
    """Import a Python file and return the class or function after the colon.

    The file is run as it stands, as any program that the user starts. It may import modules next to
    it. Raises `BadInputError` if it is missing or fails, with the line that failed, and
    `UnknownNameError` if it does not define the name.
    """
    text, _, attribute = name.partition(":")
    path = Path(text).resolve()
    if not path.is_file():
        raise BadInputError(f"model {name!r}: there is no file {text}")
    if not attribute:
        raise BadInputError(f"model {name!r} names only a file; write {text}:NameOfTheClass")
    module = _import(path, name)
    if not hasattr(module, attribute):
        public = [key for key in vars(module) if not key.startswith("_")]
        raise UnknownNameError(f"name in {text}", attribute, public)
    return getattr(module, attribute)


def _import(path: Path, name: str) -> Any:
    # A name of its own, so that a user's file called torch.py or physion.py hides nothing. It
    # depends on the text: a file that was edited, while a session lasts, is another module.
    try:
        text = importlib.util.decode_source(path.read_bytes())
    except (OSError, SyntaxError, UnicodeDecodeError) as error:
        raise BadInputError(f"model {name!r}: {path} cannot be read: {error}") from error
    known = f"physion_model_{path.stem}_{stable_hash(str(path), text) % 2**32:08x}"
    if known in sys.modules:
        return sys.modules[known]
    try:
        return _run(known, path, text)
    except ModuleNotFoundError as error:
        raise BadInputError(
            f"model {name!r} needs the library {error.name!r}, which is not installed"
        ) from error
    except Exception as error:
        where = _line_in(error, path)
        what = error.msg if isinstance(error, SyntaxError) else error
        raise BadInputError(
            f"model {name!r}: {path.name}{where} raised {type(error).__name__}: {what}"
        ) from error


def _run(known: str, path: Path, text: str) -> Any:
    """Run the text of a file as the module ``known``; leave no module behind if it fails."""
    loader = FileLoader(path, text)
    spec = importlib.util.spec_from_loader(known, loader)
    assert spec is not None, "there is a loader"
    module = importlib.util.module_from_spec(spec)
    sys.modules[known] = module
    sys.path.insert(0, str(path.parent))
    try:
        loader.exec_module(module)
    except BaseException:
        del sys.modules[known]
        raise
    finally:
        sys.path.remove(str(path.parent))
    _loaded[known] = path, text
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
