"""Types of scenario parameters with unit and limits, functions that read them and draw from them.

Every field of a scenario's parameters has one of the types below, so that a preset file can be
checked before any scene is sampled. In a file a range may be a single number (which is then the
value), and a size or a rotation may be a number, a range, or one of either for each axis.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError, BadSceneError, UnknownNameError
from physion.core.registry import plugin_names
from physion.core.settings import check_keys, field_types
from physion.numerics.rotations import axis_angle_quaternion, multiply_quaternions
from physion.scenes.scene import FLOORS, Ending, Quat, Vec3

Range: TypeAlias = tuple[float, float]
"""Smallest and largest value of a uniform random draw."""
Axes: TypeAlias = Range | tuple[Range, Range, Range]
"""One range for all axes, or a range for each of x, y and z."""


@dataclass(frozen=True)
class Quantity:
    """Unit of a parameter and the smallest and largest value allowed."""

    unit: str
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()


@dataclass(frozen=True)
class NamesOf:
    """Kind of name that a parameter holds: shape, material (or family), prop, or room.

    ``names`` are the allowed names if they are particular to one scenario.
    """

    kind: str
    names: tuple[str, ...] = ()


Length = Annotated[float, Quantity("m", 0.0, 50.0)]
Lengths = Annotated[Range, Quantity("m", 0.0, 50.0)]
SMALLEST_SIDE = 0.005
"""Smallest side of a body, metres."""
Sides = Annotated[Range, Quantity("m", SMALLEST_SIDE, 50.0)]
"""Range of the length of a side."""
Distances = Annotated[Range, Quantity("m", 0.1, 50.0)]
"""Range of a distance that must not be zero."""
Offsets = Annotated[Range, Quantity("m", -50.0, 50.0)]
FloorPosition = Annotated[tuple[float, float], Quantity("m as [x, y]", -50.0, 50.0)]
Sizes = Annotated[Axes, Quantity("m", SMALLEST_SIDE, 200.0)]
"""Scale of a shape whose unit size is about one metre."""
Slope = Annotated[float, Quantity("m", -1.0, 1.0)]
LEAST_MASS = 0.001
"""Smallest mass of a body, kg."""
Masses = Annotated[Range, Quantity("kg", LEAST_MASS, 10000.0)]
Angles = Annotated[Range, Quantity("degrees", -360.0, 360.0)]
Angle = Annotated[float, Quantity("degrees", -360.0, 360.0)]
Rotations = Annotated[Axes, Quantity("degrees", -360.0, 360.0)]
"""Rotation about z, or about x, y and z (Unity's x, z and y)."""
Fraction = Annotated[float, Quantity("", 0.0, 1.0)]
Fractions = Annotated[Range, Quantity("", 0.0, 1.0)]
Multiples = Annotated[Range, Quantity("times", 0.0, 100.0)]
SizeFactors = Annotated[Range, Quantity("times", 0.01, 100.0)]
"""Range of a factor of a size, above zero."""
Multiple = Annotated[float, Quantity("times", -100.0, 100.0)]
Speeds = Annotated[Range, Quantity("m/s", 0.0, 100.0)]
Frictions = Annotated[Range, Quantity("", 0.0, 10.0)]
EarlyFrames = Annotated[Range, Quantity("frames", 0.0, Ending().min_frames - 1.0)]
"""Range of frames that every trial has: none ends earlier, even if all bodies are at rest."""
Count = Annotated[int, Quantity("", 0, 50)]
Counts = Annotated[tuple[int, int], Quantity("", 0, 50)]
"""Smallest and largest count, both included."""
CountsFromOne = Annotated[tuple[int, int], Quantity("", 1, 50)]
"""`Counts` of at least one."""
Shapes = Annotated[tuple[str, ...], NamesOf("shape")]
"""Names of which one is drawn, all equally likely; the same for materials and props."""
Materials = Annotated[tuple[str, ...], NamesOf("material")]
Props = Annotated[tuple[str, ...], NamesOf("prop")]
Room = Annotated[str, NamesOf("room")]


def uniform(rng: np.random.Generator, interval: Range) -> float:
    """Draw uniformly from ``interval``; always takes one number from ``rng``."""
    low, high = interval
    # Not `Generator.uniform`: on some processors its product and sum are fused and differ in bits.
    return low + (high - low) * rng.random()


def draw_count(rng: np.random.Generator, counts: tuple[int, int]) -> int:
    """Draw a whole number of the range, both ends included."""
    return int(rng.integers(counts[0], counts[1] + 1))


def draw_frame(rng: np.random.Generator, frames: Range) -> int:
    """Draw a frame of the range, rounded down, so that the last is never drawn (as officially)."""
    return int(uniform(rng, frames))


def pick(rng: np.random.Generator, names: Sequence[str]) -> str:
    """Draw one of ``names``, all equally likely."""
    return names[int(rng.integers(len(names)))]


def draw_axes(rng: np.random.Generator, axes: Axes) -> Vec3:
    """Draw three values: one draw used for all axes, or one for each axis."""
    if is_range(axes):
        value = uniform(rng, typing.cast("Range", axes))
        return (value, value, value)
    x, y, z = (uniform(rng, interval) for interval in typing.cast("tuple[Range, ...]", axes))
    return (x, y, z)


def is_range(axes: Axes) -> bool:
    """Return whether ``axes`` is a single range, used for all axes."""
    return not isinstance(axes[0], tuple)


def draw_rotation(rng: np.random.Generator, angles_deg: Axes) -> Quat:
    """Draw a rotation about z, or one about three axes (see `euler_rotation`); in degrees."""
    if is_range(angles_deg):
        return yaw(math.radians(uniform(rng, typing.cast("Range", angles_deg))))
    return euler_rotation(*draw_axes(rng, angles_deg))


def euler_rotation(x_deg: float, y_deg: float, z_deg: float) -> Quat:
    """Return the rotation by these angles about y, then x, then z, the order that Unity uses.

    Unity calls our y axis z (and reversely), and its rotations have the opposite sense.
    """
    about_x, about_y, about_z = (
        axis_angle_quaternion(axis, math.radians(angle))
        for axis, angle in zip(np.eye(3), (x_deg, y_deg, z_deg), strict=True)
    )
    tilted = multiply_quaternions(about_x, about_y)
    return as_quaternion(multiply_quaternions(about_z, tilted))


def yaw(angle: float) -> Quat:
    """Return the rotation by ``angle`` radians about z."""
    return as_quaternion(axis_angle_quaternion((0.0, 0.0, 1.0), angle))


def as_quaternion(values: NDArray[np.float64]) -> Quat:
    """Convert an array (4,) to the tuple of floats that a scene holds and JSON can store."""
    w, x, y, z = values.tolist()
    return (w, x, y, z)


def read_params(kind: type[Any], table: Mapping[str, Any], where: str, base: Any = None) -> Any:
    """Return ``base`` with the values that a table gives in place of its own.

    Parameters
    ----------
    kind
        Dataclass of the parameters.
    table
        New values by key; a nested table changes some values of a nested dataclass.
    where
        File and preset, for errors.
    base
        Parameters to change, by default ``kind()``.

    Raises
    ------
    BadInputError
        With ``where``, the key and what is allowed.
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
    """Raise `BadInputError` if a value of ``params`` would be refused in a preset file."""
    _check_each(params, where)
    check_together(params, where)


def _check_each(params: Any, where: str) -> None:
    for key, hint in field_types(type(params)).items():
        value = getattr(params, key)
        if not dataclasses.is_dataclass(hint):
            _read(hint, value, f"{where}: {key}", value)
        elif isinstance(value, kind := typing.cast("type[Any]", hint)):
            _check_each(value, f"{where}: {key}")
        else:
            given = type(value).__name__
            raise BadInputError(f"{where}: {key} must be a {kind.__name__}, not a {given}")


def check_together(params: Any, where: str) -> None:
    """Raise `BadInputError` if values contradict each other, in ``params`` or in nested parameters.

    Parameters may have a method ``check_values`` for this, which returns None, or what is wrong,
    beginning with the key.
    """
    for key, hint in field_types(type(params)).items():
        if dataclasses.is_dataclass(hint):
            check_together(getattr(params, key), f"{where}: {key}")
    check = getattr(params, "check_values", None)
    problem = None if check is None else check()
    if problem is not None:
        raise BadInputError(f"{where}: {problem}")


def describe_limits(params: Any) -> dict[str, str]:
    """Return as text what each key of the parameters allows; nested keys are joined by dots."""
    allowed: dict[str, str] = {}
    for key, hint in field_types(type(params)).items():
        value = getattr(params, key)
        if dataclasses.is_dataclass(value):
            allowed |= {f"{key}.{name}": text for name, text in describe_limits(value).items()}
        else:
            allowed[key] = _allowed_text(hint)
    return allowed


def _as_written(value: Any) -> str:
    """Return a value, also one of numpy, as it would be written in a preset file."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_as_written, value))}]"
    return repr(value.item() if isinstance(value, np.generic) else value)


def _annotation(hint: Any) -> Quantity | NamesOf | None:
    """Return the unit and limits, or the kind of names, in the annotation of a type."""
    return next(iter(getattr(hint, "__metadata__", ())), None)


def _allowed_text(hint: Any) -> str:
    annotation = _annotation(hint)
    if isinstance(annotation, Quantity):
        return str(annotation)
    if isinstance(annotation, NamesOf):
        return f"names of {annotation.kind}s"
    return {bool: "true or false"}.get(hint, "a name")


def _read(hint: Any, value: Any, where: str, base: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise BadInputError(f"{where} must be a table of {', '.join(field_types(hint))}")
        return read_params(hint, value, where, base)  # type: ignore[arg-type]
    annotation = _annotation(hint)
    if isinstance(annotation, Quantity):
        return _read_quantity(typing.get_args(hint)[0], value, where, annotation)
    if isinstance(annotation, NamesOf):
        return _read_names(typing.get_args(hint)[0] is str, value, where, annotation)
    if type(value) is not hint:
        raise BadInputError(f"{where} must be {_allowed_text(hint)}, not {_as_written(value)}")
    return value


def _read_names(single: bool, value: Any, where: str, annotation: NamesOf) -> Any:
    kind = annotation.kind
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not names or (single and len(names) > 1):
        raise BadInputError(f"{where} must name a {kind}, not {_as_written(value)}")
    known = annotation.names or _known_names(kind)
    for name in names:
        if not isinstance(name, str) or name not in known:
            raise BadInputError(f"{where}: {UnknownNameError(kind, str(name), known)}")
    return names[0] if single else tuple(names)


def _known_names(kind: str) -> frozenset[str]:
    from physion.scenes.looks import MATERIALS, TEXTURES
    from physion.scenes.shapes.primitives import PROP_CATEGORIES, PROPS, shapes

    return frozenset(
        {
            "shape": shapes.names(),
            "material": (*MATERIALS, *TEXTURES),
            "prop": (*PROPS, *PROP_CATEGORIES),
            "room": (*FLOORS, *plugin_names("room")),
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
    if quantity == _annotation(FloorPosition):
        if not isinstance(value, list | tuple) or len(value) != 2:
            raise BadInputError(f"{where} must be a position [x, y] in m, not {_as_written(value)}")
        return tuple(_number(float, part, where, quantity) for part in value)
    return _range(value, where, quantity)


def _range(value: Any, where: str, quantity: Quantity) -> Range:
    if not isinstance(value, list | tuple):
        number = _number(float, value, where, quantity)
        return (number, number)
    if len(value) != 2:
        raise BadInputError(
            f"{where} must be a number or [smallest, largest], not {_as_written(value)}"
        )
    low, high = (_number(float, part, where, quantity) for part in value)
    if low > high:
        raise BadInputError(f"{where} must go from smaller to larger, not [{low:g}, {high:g}]")
    return (low, high)


def _number(kind: type[Any], value: Any, where: str, quantity: Quantity) -> Any:
    unit = f" in {quantity.unit}" if quantity.unit else ""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInputError(
            f"{where} must be a number{unit} ({quantity}), not {_as_written(value)}"
        )
    if kind is int and isinstance(value, float) and not value.is_integer():
        raise BadInputError(
            f"{where} must be a whole number ({quantity}), not {_as_written(value)}"
        )
    if not quantity.low <= value <= quantity.high:  # false for NaN too
        # A whole number may be too large for a float.
        shown = f"{value:g}" if isinstance(value, float) else f"{value!s:.20}"
        raise BadInputError(f"{where} is {shown}, allowed is {quantity}")
    return kind(value)


def retry(tries: int, what: str, attempt: typing.Callable[[], str | None]) -> None:
    """Call ``attempt`` until it returns None (success), at most ``tries`` times.

    On failure ``attempt`` returns the reason, a constant text without drawn numbers, so that equal
    reasons can be counted. After the last try `BadSceneError` gives the most frequent reason;
    ``what`` names what was to be placed.
    """
    reasons: dict[str, int] = {}
    for _ in range(tries):
        reason = attempt()
        if reason is None:
            return
        reasons[reason] = reasons.get(reason, 0) + 1
    reason = max(reasons, key=lambda one: reasons[one])
    raise BadSceneError(
        f"{what} could not be placed in {tries} tries: {reason}; change sizes or distances"
    )
