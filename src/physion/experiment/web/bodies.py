"""Parse untrusted request bodies into messages of `physion.experiment.protocol.messages`.

Besides what the types of the messages say, a body must be plain JSON: one value a key, no NaN, no
number beyond what JSON readers agree on, no NUL and no half character (no database takes them), not
nested more than `MAX_DEPTH` deep.
"""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn, TypeVar

from pydantic import ValidationError
from starlette.requests import Request

from physion.errors import BadInputError
from physion.experiment.protocol.messages import Message
from physion.experiment.web.refusals import explain

MAX_DEPTH = 8
EXACT = 2**53
"""Whole numbers up to here are the same in every reader of JSON."""
M = TypeVar("M", bound=Message)


class BadBodyError(BadInputError):
    """A body that is no such message; the text says why without repeating it."""


async def read_message(request: Request, message: type[M]) -> M:
    """The body of a request as a message.

    Raises:
        BadBodyError: it is not JSON, or not this message.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise BadBodyError("the body must be application/json")
    return parse_message(await request.body(), message)


def parse_message(body: bytes, message: type[M]) -> M:
    """As `read_message`, from the bytes."""
    try:
        _check(json.loads(body, object_pairs_hook=_once, parse_constant=_no_constant), 0)
    except BadBodyError:
        raise
    except (ValueError, RecursionError) as error:
        raise BadBodyError("the body is not valid JSON") from error
    try:
        return message.model_validate_json(body, strict=True)
    except ValidationError as error:
        raise BadBodyError(explain(error)) from error


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise BadBodyError("the body has the same key twice")
    return found


def _no_constant(word: str) -> NoReturn:
    raise BadBodyError("the body has a number that is not finite")


def _check(value: Any, depth: int) -> None:
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
            raise BadBodyError("the body is nested too deep")
        if kind is dict:
            for key in value:
                _check_text(key)
        for inner in value.values() if kind is dict else value:
            _check(inner, depth + 1)


def _check_text(text: str) -> None:
    if "\x00" in text:
        raise BadBodyError("the body has a character that no text has")
    if not text.isascii():
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise BadBodyError("the body has half a character") from error
