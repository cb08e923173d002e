"""Parse untrusted request bodies into messages of `physion.experiment.protocol.messages`.

Apart from the types of the message, a body must be plain JSON: unique keys, no NaN or infinity, no
integer beyond 2**53, no NUL and no unpaired surrogate (databases cannot store them), and at most
`MAX_DEPTH` levels of nesting.
"""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn, TypeVar

from pydantic import ValidationError
from starlette.requests import Request

from physion.core.errors import BadInputError
from physion.experiment.protocol.messages import Message
from physion.experiment.web.refusals import describe_faults

MAX_DEPTH = 8
EXACT = 2**53
"""Integers up to here are exact in every JSON parser."""
M = TypeVar("M", bound=Message)


class BadBodyError(BadInputError):
    """Error for an invalid body; the message gives the reason without repeating the value."""


async def read_message(request: Request, message: type[M]) -> M:
    """Read and validate the body of a request.

    Raises
    ------
    BadBodyError
        The body is not JSON, or not this message.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise BadBodyError("the body must be application/json")
    return parse_message(await request.body(), message)


def parse_message(body: bytes, message: type[M]) -> M:
    """Validate the bytes of a body, as `read_message` does."""
    try:
        _check(json.loads(body, object_pairs_hook=_unique_keys, parse_constant=_no_constant), 0)
    except BadBodyError:
        raise
    except (ValueError, RecursionError) as error:
        raise BadBodyError("the body is not valid JSON") from error
    try:
        return message.model_validate_json(body, strict=True)
    except ValidationError as error:
        raise BadBodyError(describe_faults(error)) from error


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the object of JSON pairs; raise `BadBodyError` if a key is repeated."""
    unique = dict(pairs)
    if len(unique) != len(pairs):
        raise BadBodyError("the body has the same key twice")
    return unique


def _no_constant(word: str) -> NoReturn:
    """Refuse the constants NaN and Infinity."""
    raise BadBodyError("the body has a number that is not finite")


def _check(value: Any, depth: int) -> None:
    """Check a JSON value and all values in it."""
    kind = type(value)
    if kind is str:
        _check_text(value)
    elif kind is float:
        if not math.isfinite(value):
            raise BadBodyError("the body has a number that is not finite")
    elif kind is int:
        if not -EXACT <= value <= EXACT:
            raise BadBodyError("the body has a number that is too large")
    elif kind is dict or kind is list:
        if depth >= MAX_DEPTH:
            raise BadBodyError("the body is nested too deeply")
        if kind is dict:
            for key in value:
                _check_text(key)
        for inner in value.values() if kind is dict else value:
            _check(inner, depth + 1)


def _check_text(text: str) -> None:
    """Refuse a text with NUL or unpaired surrogates."""
    if "\x00" in text:
        raise BadBodyError("the body has a NUL character")
    if not text.isascii():
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise BadBodyError("the body has an unpaired surrogate") from error
