"""Reflection of light at a point of a surface: diffuse, specular, the mirrored room, its corners.

References
----------
Blinn, J. (1977). Models of light reflection for computer synthesized pictures. SIGGRAPH.
Schlick, C. (1994). An inexpensive BRDF model for physically-based rendering. Computer Graphics
    Forum 13(3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import coarse_log2_of, exp_of
from physion.numerics.kernel import kernel

F64 = NDArray[np.float64]
Vector = tuple[float, float, float]

LN2 = 0.6931471805599453
HIGHLIGHT_CUTOFF = 0.5
"""Cosine between normal and half vector up to which the highlight is taken as 0."""
GRAZING_GAIN = 3.0
"""A dielectric seen edge-on reflects (1 + this) times what it reflects seen straight on."""
GRAZING_GAIN_LOST = 2.0
"""How much smaller the gain is for a metal, which reflects much from every side."""
WINDOW_BLUR = 0.25
"""Width in metres of the window's soft edge in a reflection right next to it."""
WINDOW_BLUR_GROWTH = 0.12
"""Metres by which that width grows for each metre between surface and window."""
PARALLEL = 1e-9
"""Distance times slope up to which a reflected ray is taken never to reach the window."""
CORNER_OCCLUSION = 0.22
"""Fraction of the light that a surface loses in the edge between it and one wall."""
CORNER_RANGE = 0.6
"""Metres from that edge at which the loss has fallen to 1/e."""


@kernel
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def scaled(a: Vector, factor: float) -> Vector:
    """Return ``factor`` times a vector."""
    return a[0] * factor, a[1] * factor, a[2] * factor


@kernel
def lambert(normal: Vector, to_light: Vector) -> float:
    """Return Lambert's cosine, max(n . l, 0): what a matte surface receives by its tilt."""
    return max(dot(normal, to_light), 0.0)


@kernel
def highlight(normal: Vector, to_light: Vector, to_eye: Vector, exponent: float) -> float:
    """Return the specular highlight (n . h)^exponent, h = (l + v) / |l + v| (Blinn 1977).

    It is 1 where the normal is the half vector h. The power is computed as
    2^(exponent log2(n . h)) with a logarithm that is exact to 2e-5.
    """
    half = to_light[0] + to_eye[0], to_light[1] + to_eye[1], to_light[2] + to_eye[2]
    cosine = dot(normal, half) / np.sqrt(dot(half, half))
    if cosine > HIGHLIGHT_CUTOFF:
        return exp_of(LN2 * exponent * coarse_log2_of(cosine))
    return 0.0


@kernel
def fresnel(reflectance: float, metalness: float, cosine: float) -> float:
    """Return the fraction of the environment that a surface reflects at an angle to its normal.

    F = F0 (1 + g (1 - cos)^4), with the gain g = 3 for dielectrics and 1 for metals. It has the
    form of Schlick's (1994) approximation F0 + (1 - F0) (1 - cos)^5, but stays proportional to
    F0, so that rough surfaces do not turn into mirrors when seen edge-on.
    """
    grazing = (1.0 - cosine) * (1.0 - cosine)
    return reflectance * (1.0 + (GRAZING_GAIN - GRAZING_GAIN_LOST * metalness) * grazing * grazing)


@kernel
def mirrored(normal: Vector, to_eye: Vector, cosine: float) -> Vector:
    """Return the mirrored viewing ray r = 2 (n . v) n - v; ``cosine`` is n . v."""
    twice = 2.0 * cosine
    return (
        twice * normal[0] - to_eye[0],
        twice * normal[1] - to_eye[1],
        twice * normal[2] - to_eye[2],
    )


@kernel
def window_fraction(position: Vector, ray: Vector, low: F64, high: F64) -> float:
    """Return how much of the window a rough reflection along ``ray`` shows, 0..1.

    The ray meets the window's plane y = low[1] at a distance d. Along x and z, the distance to the
    nearer edge divided by a blur that grows with d goes through a smooth step 3 s^2 - 2 s^3.
    """
    gap = low[1] - position[1]
    if gap * ray[1] <= PARALLEL:
        return 0.0
    along = gap / ray[1]
    x, z = position[0] + along * ray[0], position[2] + along * ray[2]
    blur = WINDOW_BLUR + WINDOW_BLUR_GROWTH * along
    u = min(x - low[0], high[0] - x) / blur + 0.5
    v = min(z - low[2], high[2] - z) / blur + 0.5
    u, v = min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
    return float(u * u * (3.0 - 2.0 * u) * v * v * (3.0 - 2.0 * v))


@kernel
def corner_occlusion(position: Vector, normal: Vector, low: F64, high: F64) -> float:
    """Return the fraction of light left near the edges where walls, floor and ceiling meet.

    Each of the room's six planes takes c (1 - |n_k|) exp(-d / r) of the light of a surface at
    distance d from it: the factor 1 - |n_k| leaves out the plane that the surface lies in.
    """
    left = 1.0
    for k in range(3):
        p = position[0] if k == 0 else (position[1] if k == 1 else position[2])
        n = normal[0] if k == 0 else (normal[1] if k == 1 else normal[2])
        across = 1.0 - abs(n)
        to_low, to_high = max(p - low[k], 0.0), max(high[k] - p, 0.0)
        left *= 1.0 - CORNER_OCCLUSION * across * exp_of(-to_low / CORNER_RANGE)
        left *= 1.0 - CORNER_OCCLUSION * across * exp_of(-to_high / CORNER_RANGE)
    return float(left)
