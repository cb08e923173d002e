"""The numbers that a scenario draws from: their units, what is allowed, and how they are drawn.

Every field of a scenario's parameters has one of the types below, so that a preset file can be
checked before anything is made. In a file a range may be a single number (always that one), and a
size or a turn a single number, a range, or one of either for each axis.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from physion.dataclass_json import check_keys, field_types
from physion.errors import BadInputError, BadSceneError, UnknownNameError
from physion.numerics.rotations import axis_angle_quaternion, multiply_quaternions
from physion.scenes.scene import Ending, Quat, Vec3

ROOMS = ("box", "bright", "empty")

Range: TypeAlias = tuple[float, float]
"""Smallest and largest value of an even random draw."""
Axes: TypeAlias = Range | tuple[Range, Range, Range]
"""One draw for all axes, or a draw for each of x, y, z."""


@dataclass(frozen=True)
class Quantity:
    """Unit of a parameter, and the smallest and largest value that makes sense for it."""

    unit: str
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()


@dataclass(frozen=True)
class NamesOf:
    """What the names in a parameter name: shapes, materials (or their families), props, rooms.

    ``names`` are those to choose from where they belong to one scenario.
    """

    kind: str
    names: tuple[str, ...] = ()


Length = Annotated[float, Quantity("m", 0.0, 50.0)]
Lengths = Annotated[Range, Quantity("m", 0.0, 50.0)]
SMALLEST_SIDE = 0.005
"""Metres: no body is thinner, so that none vanishes."""
Sides = Annotated[Range, Quantity("m", SMALLEST_SIDE, 50.0)]
"""Lengths of a thing's sides."""
Distances = Annotated[Range, Quantity("m", 0.1, 50.0)]
"""Lengths between things that may not be at the same place."""
Offsets = Annotated[Range, Quantity("m", -50.0, 50.0)]
FloorPosition = Annotated[tuple[float, float], Quantity("m as [x, y]", -50.0, 50.0)]
Sizes = Annotated[Axes, Quantity("m", SMALLEST_SIDE, 200.0)]
"""Scale of a shape whose unit size is about a metre."""
Slope = Annotated[float, Quantity("m", -1.0, 1.0)]
LEAST_MASS = 0.001
"""Kilogrammes: no body is lighter."""
Masses = Annotated[Range, Quantity("kg", LEAST_MASS, 10000.0)]
Angles = Annotated[Range, Quantity("degrees", -360.0, 360.0)]
Angle = Annotated[float, Quantity("degrees", -360.0, 360.0)]
Rotations = Annotated[Axes, Quantity("degrees", -360.0, 360.0)]
"""A turn about the upright, or about x, y and z (of Unity's x, z and y)."""
Fraction = Annotated[float, Quantity("", 0.0, 1.0)]
Fractions = Annotated[Range, Quantity("", 0.0, 1.0)]
Multiples = Annotated[Range, Quantity("times", 0.0, 100.0)]
SizeFactors = Annotated[Range, Quantity("times", 0.01, 100.0)]
"""Multiples of a size, which leave something of it."""
Multiple = Annotated[float, Quantity("times", -100.0, 100.0)]
Speeds = Annotated[Range, Quantity("m/s", 0.0, 100.0)]
Frictions = Annotated[Range, Quantity("", 0.0, 10.0)]
EarlyFrames = Annotated[Range, Quantity("frames", 0.0, Ending().min_frames - 1.0)]
"""Frames that every trial has: one whose bodies are all at rest ends after them."""
Count = Annotated[int, Quantity("", 0, 50)]
Counts = Annotated[tuple[int, int], Quantity("", 0, 50)]
"""Fewest and most, both possible."""
CountsFromOne = Annotated[tuple[int, int], Quantity("", 1, 50)]
"""`Counts` of what there must be at least one of."""
Shapes = Annotated[tuple[str, ...], NamesOf("shape")]
"""One of these is chosen, each as likely; so with materials and props."""
Materials = Annotated[tuple[str, ...], NamesOf("material")]
Props = Annotated[tuple[str, ...], NamesOf("prop")]
Room = Annotated[str, NamesOf("room")]


def uniform(rng: np.random.Generator, interval: Range) -> float:
    """An even draw from ``interval``; always one number of the stream, also if it is a point."""
    low, high = interval
    # Not `Generator.uniform`: compilers for some processors fuse its product and sum.
    return low + (high - low) * rng.random()


def draw_count(rng: np.random.Generator, counts: tuple[int, int]) -> int:
    """A whole number of the range, both ends possible."""
    return int(rng.integers(counts[0], counts[1] + 1))


def draw_frame(rng: np.random.Generator, frames: Range) -> int:
    """A frame of the range, its last one left out as officially (int of an even draw)."""
    return int(uniform(rng, frames))


def pick(rng: np.random.Generator, names: Sequence[str]) -> str:
    """One of ``names``, each as likely."""
    return names[int(rng.integers(len(names)))]


def draw_axes(rng: np.random.Generator, axes: Axes) -> Vec3:
    """Three values: the same draw for all axes, or one draw each."""
    if is_range(axes):
        value = uniform(rng, typing.cast(Range, axes))
        return (value, value, value)
    x, y, z = (uniform(rng, interval) for interval in typing.cast(tuple[Range, ...], axes))
    return (x, y, z)


def is_range(axes: Axes) -> bool:
    """Whether one draw serves all axes."""
    return not isinstance(axes[0], tuple)


def draw_rotation(rng: np.random.Generator, angles_deg: Axes) -> Quat:
    """A rotation: by one angle about z, or as Unity turns by three (about z, then x, then y).

    The three angles are about our x, y, z; Unity calls our y its z, and turns the other way.
    """
    if is_range(angles_deg):
        return yaw(math.radians(uniform(rng, typing.cast(Range, angles_deg))))
    return euler_rotation(*draw_axes(rng, angles_deg))


def euler_rotation(x_deg: float, y_deg: float, z_deg: float) -> Quat:
    """The rotation by degrees about y, then about x, then about z: Unity's order."""
    about_x, about_y, about_z = (
        axis_angle_quaternion(axis, math.radians(angle))
        for axis, angle in zip(np.eye(3), (x_deg, y_deg, z_deg), strict=True)
    )
    tilted = multiply_quaternions(about_x, about_y)
    return as_quaternion(multiply_quaternions(about_z, tilted))


def yaw(angle: float) -> Quat:
    """The rotation by ``angle`` radians about z."""
    return as_quaternion(axis_angle_quaternion((0.0, 0.0, 1.0), angle))


def as_quaternion(values: NDArray[np.float64]) -> Quat:
    """Turn an array (4,) into the tuple of floats that scenes hold and JSON can keep."""
    w, x, y, z = values.tolist()
    return (w, x, y, z)


def read_params(kind: type[Any], table: Mapping[str, Any], where: str, base: Any = None) -> Any:
    """The parameters ``kind`` with the values of ``table`` in place of those of ``base``.

    Nested tables change the nested parameters that they name and leave the others. ``base`` is by
    default ``kind()``. `BadInputError` names the key, ``where`` it stands, and what is allowed.
    """
    base = kind() if base is None else base
    hints = field_types(kind)
    check_keys(table, hints, where)
    values = {
        key: _read(hints[key], value, f"{where}: {key}", getattr(base, key))
        for key, value in table.items()
    }
    return dataclasses.replace(base, **values)


def check_params(params: Any, where: str) -> None:
    """Raise `BadInputError` where a value of ``params`` is not one that a file could give."""
    _check_each(params, where)
    check_together(params, where)


def _check_each(params: Any, where: str) -> None:
    for key, hint in field_types(type(params)).items():
        value = getattr(params, key)
        if not dataclasses.is_dataclass(hint):
            _read(hint, value, f"{where}: {key}", value)
        elif isinstance(value, kind := typing.cast(type[Any], hint)):
            _check_each(value, f"{where}: {key}")
        else:
            given = type(value).__name__
            raise BadInputError(f"{where}: {key} must be a {kind.__name__}, not a {given}")


def check_together(params: Any, where: str) -> None:
    """Raise `BadInputError` where values are good one by one, but not with one another.

    Parameters, and those nested in them, say so by a method ``check_values``: it returns what is
    wrong, beginning with the key, or None.
    """
    for key, hint in field_types(type(params)).items():
        if dataclasses.is_dataclass(hint):
            check_together(getattr(params, key), f"{where}: {key}")
    check = getattr(params, "check_values", None)
    wrong = None if check is None else check()
    if wrong is not None:
        raise BadInputError(f"{where}: {wrong}")


def drawn_limits(params: Any) -> dict[str, str]:
    """What each key of the parameters allows, in words, nested keys joined by dots."""
    allowed: dict[str, str] = {}
    for key, hint in field_types(type(params)).items():
        value = getattr(params, key)
        if dataclasses.is_dataclass(value):
            allowed |= {f"{key}.{name}": text for name, text in drawn_limits(value).items()}
        else:
            allowed[key] = _word(hint)
    return allowed


def _told(value: Any) -> str:
    """A value as a file would have it, also if it is one of numpy's."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_told, value))}]"
    return repr(value.item() if isinstance(value, np.generic) else value)


def _note(hint: Any) -> Quantity | NamesOf | None:
    """What the annotation of a parameter's type says of its values."""
    return next(iter(getattr(hint, "__metadata__", ())), None)


def _word(hint: Any) -> str:
    note = _note(hint)
    if isinstance(note, Quantity):
        return str(note)
    if isinstance(note, NamesOf):
        return f"names of {note.kind}s"
    return {bool: "true or false"}.get(hint, "a name")


def _read(hint: Any, value: Any, where: str, base: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise BadInputError(f"{where} must be a table of {', '.join(field_types(hint))}")
        return read_params(hint, value, where, base)  # type: ignore[arg-type]
    note = _note(hint)
    if isinstance(note, Quantity):
        return _read_quantity(typing.get_args(hint)[0], value, where, note)
    if isinstance(note, NamesOf):
        return _read_names(typing.get_args(hint)[0] is str, value, where, note)
    if type(value) is not hint:
        raise BadInputError(f"{where} must be {_word(hint)}, not {_told(value)}")
    return value


def _read_names(single: bool, value: Any, where: str, note: NamesOf) -> Any:
    kind = note.kind
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not names or (single and len(names) > 1):
        raise BadInputError(f"{where} must name a {kind}, not {_told(value)}")
    known = note.names or _known_names(kind)
    for name in names:
        if not isinstance(name, str) or name not in known:
            raise BadInputError(f"{where}: {UnknownNameError(kind, str(name), known)}")
    return names[0] if single else tuple(names)


@functools.cache
def _known_names(kind: str) -> frozenset[str]:
    from physion.scenes.looks import MATERIALS, TEXTURES
    from physion.scenes.shapes.primitives import shapes
    from physion.scenes.shapes.prop_names import PROP_CATEGORIES, PROPS

    return frozenset(
        {
            "shape": shapes.names(),
            "material": (*MATERIALS, *TEXTURES),
            "prop": (*PROPS, *PROP_CATEGORIES),
            "room": ROOMS,
        }[kind]
    )


def _read_quantity(kind: Any, value: Any, where: str, quantity: Quantity) -> Any:
    if kind in (int, float):
        return _number(kind, value, where, quantity)
    if kind == Axes:
        if isinstance(value, list | tuple) and len(value) == 3:
            return tuple(_range(part, f"{where}[{i}]", quantity) for i, part in enumerate(value))
        return _range(value, where, quantity)
    if kind == tuple[int, int]:
        low, high = _range(value, where, quantity)
        return (_number(int, low, where, quantity), _number(int, high, where, quantity))
    if quantity == _note(FloorPosition):
        if not isinstance(value, list | tuple) or len(value) != 2:
            raise BadInputError(f"{where} must be a place [x, y] in m, not {_told(value)}")
        return tuple(_number(float, part, where, quantity) for part in value)
    return _range(value, where, quantity)


def _range(value: Any, where: str, quantity: Quantity) -> Range:
    if not isinstance(value, list | tuple):
        number = _number(float, value, where, quantity)
        return (number, number)
    if len(value) != 2:
        raise BadInputError(f"{where} must be a number or [smallest, largest], not {_told(value)}")
    low, high = (_number(float, part, where, quantity) for part in value)
    if low > high:
        raise BadInputError(f"{where} must go from smaller to larger, not [{low:g}, {high:g}]")
    return (low, high)


def _number(kind: type[Any], value: Any, where: str, quantity: Quantity) -> Any:
    unit = f" in {quantity.unit}" if quantity.unit else ""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInputError(f"{where} must be a number{unit} ({quantity}), not {_told(value)}")
    if kind is int and isinstance(value, float) and not value.is_integer():
        raise BadInputError(f"{where} must be a whole number ({quantity}), not {_told(value)}")
    if not quantity.low <= value <= quantity.high:  # false for NaN too
        # A whole number may be too large for a float.
        shown = f"{value:g}" if isinstance(value, float) else f"{value!s:.20}"
        raise BadInputError(f"{where} is {shown}, allowed is {quantity}")
    return kind(value)


def retry(tries: int, what: str, attempt: typing.Callable[[], str | None]) -> None:
    """Call ``attempt`` until it returns None, at most ``tries`` times.

    It returns what stands in the way otherwise; `BadSceneError` says what did so most often. That
    is to be free of what was drawn, so that draws which fail for the same reason can be counted.
    """
    reasons: dict[str, int] = {}
    for _ in range(tries):
        reason = attempt()
        if reason is None:
            return
        reasons[reason] = reasons.get(reason, 0) + 1
    raise BadSceneError(
        f"{what} could not be placed in {tries} tries: {max(reasons, key=lambda one: reasons[one])}"
    )
