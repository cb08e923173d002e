"""The colour of a surface under a room's light: textures, shadows, tone.

Light is linear. A surface gets light from all around (``around``: a constant and a slope along
each axis, so that walls differ), and from one soft lamp that throws shadows. Colour is shaded once
for each surface that a pixel shows, at the first sample that shows it, and weighted by the number
of samples. What never moves is shaded once: only the shadows on it change.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.rendering.kernel import kernel
from physion.rendering.rasterizer import SAMPLES

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]

TONES = 16384
POINT = 13
"""Numbers kept of a shaded point, see `_shade_point`."""
WHITEST = 4.0
"""Linear light beyond which the tone table is white."""


class Surfaces(NamedTuple):
    """What the shading loop knows about triangles (T) and materials (M).

    ``edges`` (T, 9) as `rasterize` writes; ``normals`` (T, 9), ``uv`` (T, 6), ``tangents`` (T, 6)
    as in `Part`, in the world; ``surface`` and ``material`` (T,); ``materials`` (M, 12): linear
    colour, texture row, gloss, sharpness, mirror, metal, relief, glow, room, unused.
    """

    edges: F64
    normals: F32
    uv: F32
    tangents: F32
    surface: I32
    material: I32
    materials: F64
    texels: U8
    starts: NDArray[np.int64]


class Light(NamedTuple):
    """A room's light, and the maps of what stands in its way.

    - ``eye`` (3,), ``rays`` (3, 3): where the camera is; (x, y, 1) in pixels to a world vector.
    - ``lamp`` (2, 3): unit vector to the lamp, its linear colour.
    - ``around`` (4, 3): linear light from all sides: constant, and slopes along x, y and z.
    - ``mirrored`` (3, 3): what glossy things reflect: from below, from the sides, from above.
    - ``window`` (3, 3): lowest and highest corner of a bright rectangle in a plane of one y, and
      its linear colour: glossy things reflect it with soft edges.
    - ``bounds`` (2, 3): lowest and highest corner of the room, darker near its edges.
    - ``to_shadow`` (3, 4): world to texel x, texel y, distance in metres from the lamp's side.
    - ``to_contact`` (3, 4): world to texel x, texel y, height in metres.
    - ``shadow``, ``contact``: the depth maps: what is nearest to the lamp; what is lowest.
    - ``settings`` (4,): how far a point is lifted off its surface before it is looked up, share of the lamp that shadows take, strength of the
      darkness under things, reach of that darkness in metres.
    """

    eye: F64
    rays: F64
    lamp: F64
    around: F64
    mirrored: F64
    window: F64
    bounds: F64
    to_shadow: F64
    to_contact: F64
    shadow: F32
    contact: F32
    settings: F64


@kernel
def _texel(
    texels: U8, start: int, side: int, u: float, v: float
) -> tuple[float, float, float, float, float]:
    """One level of a texture between its four nearest texels, repeating."""
    x, y = u * side - 0.5, v * side - 0.5
    fx, fy = np.floor(x), np.floor(y)
    ax, ay = x - fx, y - fy
    mask = side - 1
    x0, y0 = int(fx) & mask, int(fy) & mask
    x1, y1 = (x0 + 1) & mask, (y0 + 1) & mask
    i, j = start + y0 * side + x0, start + y0 * side + x1
    k, m = start + y1 * side + x0, start + y1 * side + x1
    wi, wj, wk, wm = (1 - ax) * (1 - ay), ax * (1 - ay), (1 - ax) * ay, ax * ay
    r = wi * texels[i, 0] + wj * texels[j, 0] + wk * texels[k, 0] + wm * texels[m, 0]
    g = wi * texels[i, 1] + wj * texels[j, 1] + wk * texels[k, 1] + wm * texels[m, 1]
    b = wi * texels[i, 2] + wj * texels[j, 2] + wk * texels[k, 2] + wm * texels[m, 2]
    p = wi * texels[i, 3] + wj * texels[j, 3] + wk * texels[k, 3] + wm * texels[m, 3]
    q = wi * texels[i, 4] + wj * texels[j, 4] + wk * texels[k, 4] + wm * texels[m, 4]
    return r, g, b, p, q


@kernel
def _texture(
    texels: U8, starts: NDArray[np.int64], row: int, u: float, v: float, footprint: float
) -> tuple[float, float, float, float, float]:
    """Linear albedo and slopes of a texture where a pixel covers ``footprint`` texels across."""
    level = np.log2(max(footprint, 1.0))
    low = min(int(level), starts.shape[1] - 1)
    share = level - low
    side = 1 << (starts.shape[1] - 1)
    r, g, b, p, q = _texel(texels, starts[row, low], side >> low, u, v)
    if share > 0.02 and low + 1 < starts.shape[1]:
        r1, g1, b1, p1, q1 = _texel(texels, starts[row, low + 1], side >> (low + 1), u, v)
        r, g, b = r + share * (r1 - r), g + share * (g1 - g), b + share * (b1 - b)
        p, q = p + share * (p1 - p), q + share * (q1 - q)
    unit = 1.0 / (255.0 * 255.0)
    return r * r * unit, g * g * unit, b * b * unit, (p - 128.0) / 64.0, (q - 128.0) / 64.0


@kernel
def _shade_point(
    t: int, x: float, y: float, surfaces: Surfaces, light: Light, out: F32
) -> None:
    """Shade triangle ``t`` at pixel coordinates into ``out`` (POINT,).

    In order: the world point, the light from around, the lamp's light, how much the surface faces
    up (0..1), which is where things standing near darken it, and the normal without relief.
    """
    edges = surfaces.edges
    e0 = edges[t, 0] * x + edges[t, 1] * y + edges[t, 2]
    e1 = edges[t, 3] * x + edges[t, 4] * y + edges[t, 5]
    e2 = edges[t, 6] * x + edges[t, 7] * y + edges[t, 8]
    w = 1.0 / (e0 + e1 + e2)
    b0, b1, b2 = e0 * w, e1 * w, e2 * w
    rays = light.rays
    vx = rays[0, 0] * x + rays[0, 1] * y + rays[0, 2]
    vy = rays[1, 0] * x + rays[1, 1] * y + rays[1, 2]
    vz = rays[2, 0] * x + rays[2, 1] * y + rays[2, 2]
    px, py, pz = light.eye[0] + w * vx, light.eye[1] + w * vy, light.eye[2] + w * vz
    scale = -1.0 / np.sqrt(vx * vx + vy * vy + vz * vz)
    vx, vy, vz = vx * scale, vy * scale, vz * scale

    material = surfaces.materials[surfaces.material[t]]
    uv = surfaces.uv[t]
    u = b0 * uv[0] + b1 * uv[2] + b2 * uv[4]
    v = b0 * uv[1] + b1 * uv[3] + b2 * uv[5]
    da = edges[t, 0] + edges[t, 3] + edges[t, 6]
    db = edges[t, 1] + edges[t, 4] + edges[t, 7]
    ux = w * (edges[t, 0] * uv[0] + edges[t, 3] * uv[2] + edges[t, 6] * uv[4] - u * da)
    uy = w * (edges[t, 1] * uv[0] + edges[t, 4] * uv[2] + edges[t, 7] * uv[4] - u * db)
    vx_ = w * (edges[t, 0] * uv[1] + edges[t, 3] * uv[3] + edges[t, 6] * uv[5] - v * da)
    vy_ = w * (edges[t, 1] * uv[1] + edges[t, 4] * uv[3] + edges[t, 7] * uv[5] - v * db)
    long, short = ux * ux + vx_ * vx_, uy * uy + vy_ * vy_
    if long < short:
        long, short = short, long
    # Between the blur of the longer side and the flicker of the shorter one.
    side = 1 << (surfaces.starts.shape[1] - 1)
    footprint = side * 0.8 * np.sqrt(np.sqrt(long * short))
    tr, tg, tb, slope_u, slope_v = _texture(
        surfaces.texels, surfaces.starts, int(material[3]), u, v, footprint
    )
    ar, ag, ab = tr * material[0], tg * material[1], tb * material[2]

    n = surfaces.normals[t]
    nx = b0 * n[0] + b1 * n[3] + b2 * n[6]
    ny = b0 * n[1] + b1 * n[4] + b2 * n[7]
    nz = b0 * n[2] + b1 * n[5] + b2 * n[8]
    scale = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
    if nx * vx + ny * vy + nz * vz < 0.0:
        scale = -scale
    nx, ny, nz = nx * scale, ny * scale, nz * scale
    out[9] = min(max(2.0 * nz - 1.0, 0.0), 1.0)
    out[10], out[11], out[12] = nx, ny, nz
    if material[8] > 0.0:
        tangent = surfaces.tangents[t]
        slope_u, slope_v = slope_u * material[8], slope_v * material[8]
        nx -= slope_u * tangent[0] + slope_v * tangent[3]
        ny -= slope_u * tangent[1] + slope_v * tangent[4]
        nz -= slope_u * tangent[2] + slope_v * tangent[5]
        scale = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * scale, ny * scale, nz * scale

    lamp, around = light.lamp, light.around
    facing = nx * lamp[0, 0] + ny * lamp[0, 1] + nz * lamp[0, 2]
    direct = max(facing, 0.0)
    hx, hy, hz = lamp[0, 0] + vx, lamp[0, 1] + vy, lamp[0, 2] + vz
    half = max((nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz), 0.0)
    shine = material[4] * half ** material[5] if facing > 0.0 else 0.0
    toward = max(nx * vx + ny * vy + nz * vz, 0.0)
    graze = (1.0 - toward) ** 4
    mirror = material[6] * (1.0 + (3.0 - 2.0 * material[7]) * graze)
    rx, ry, rz = 2.0 * toward * nx - vx, 2.0 * toward * ny - vy, 2.0 * toward * nz - vz
    window = 0.0
    if mirror > 0.0:
        window = _window_share(px, py, pz, rx, ry, rz, light.window)
    room = 1.0
    if material[10] > 0.0:
        room = _room_shade(px, py, pz, nx, ny, nz, light.bounds)
    out[0], out[1], out[2] = px, py, pz
    metal = material[7]
    for k in range(3):
        albedo = ar if k == 0 else (ag if k == 1 else ab)
        ambient = around[0, k] + nx * around[1, k] + ny * around[2, k] + nz * around[3, k]
        if rz > 0.0:
            seen = light.mirrored[1, k] + min(1.0, 1.4 * rz) * (
                light.mirrored[2, k] - light.mirrored[1, k]
            )
        else:
            seen = light.mirrored[1, k] + min(1.0, -2.5 * rz) * (
                light.mirrored[0, k] - light.mirrored[1, k]
            )
        seen += window * (light.window[2, k] - seen)
        tint = 1.0 + metal * (albedo - 1.0)
        matte = albedo * (1.0 - 0.8 * metal)
        out[3 + k] = room * (matte * ambient + mirror * tint * seen) + material[9] * albedo
        out[6 + k] = room * lamp[1, k] * (matte * direct + tint * shine)


@kernel
def _window_share(
    px: float, py: float, pz: float, rx: float, ry: float, rz: float, window: F64
) -> float:
    """How much of the window a rough reflection along (rx, ry, rz) sees, 0..1."""
    gap = window[0, 1] - py
    if gap * ry <= 1e-9:
        return 0.0
    along = gap / ry
    x, z = px + along * rx, pz + along * rz
    blur = 0.25 + 0.12 * along
    u = min(x - window[0, 0], window[1, 0] - x) / blur + 0.5
    v = min(z - window[0, 2], window[1, 2] - z) / blur + 0.5
    u, v = min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
    return float(u * u * (3.0 - 2.0 * u) * v * v * (3.0 - 2.0 * v))


@kernel
def _room_shade(
    px: float, py: float, pz: float, nx: float, ny: float, nz: float, bounds: F64
) -> float:
    """Light that is left near the edges where walls, floor and ceiling meet, 0..1."""
    left = 1.0
    for k in range(3):
        p = px if k == 0 else (py if k == 1 else pz)
        n = nx if k == 0 else (ny if k == 1 else nz)
        flat = 1.0 - abs(n)
        low, high = max(p - bounds[0, k], 0.0), max(bounds[1, k] - p, 0.0)
        left *= 1.0 - 0.22 * flat * np.exp(-low / 0.6)
        left *= 1.0 - 0.22 * flat * np.exp(-high / 0.6)
    return float(left)


@kernel
def _lit(point: F32, light: Light) -> float:
    """Share of the lamp that reaches a world point: a soft-edged look into the shadow map."""
    m, lift = light.to_shadow, light.settings[0]
    px = point[0] + lift * point[10]
    py = point[1] + lift * point[11]
    pz = point[2] + lift * point[12]
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] - 0.5
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] - 0.5
    z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3] - 0.5 * lift
    height, width = light.shadow.shape
    fx, fy = np.floor(x), np.floor(y)
    j, i = int(fx), int(fy)
    if j < 2 or i < 2 or j >= width - 3 or i >= height - 3:
        return 1.0
    ax, ay = x - fx, y - fy
    total = 0.0
    for row in range(-2, 4):
        wy = 1.0 - ay if row == -2 else (ay if row == 3 else 1.0)
        line = 0.0
        for column in range(-2, 4):
            if light.shadow[i + row, j + column] >= z:
                line += 1.0 - ax if column == -2 else (ax if column == 3 else 1.0)
        total += wy * line
    return float(1.0 - light.settings[1] * (1.0 - total / 25.0))


@kernel
def _open(point: F32, light: Light) -> float:
    """Share of the light from around that reaches a point beside or under things, 0..1."""
    m = light.to_contact
    x = m[0, 0] * point[0] + m[0, 1] * point[1] + m[0, 2] * point[2] + m[0, 3] - 0.5
    y = m[1, 0] * point[0] + m[1, 1] * point[1] + m[1, 2] * point[2] + m[1, 3] - 0.5
    height, width = light.contact.shape
    fx, fy = np.floor(x), np.floor(y)
    j, i = int(fx), int(fy)
    if j < 3 or i < 3 or j >= width - 4 or i >= height - 4:
        return 1.0
    ax, ay = x - fx, y - fy
    total = 0.0
    reach = light.settings[3]
    for row in range(-3, 5):
        wy = 1.0 - ay if row == -3 else (ay if row == 4 else 1.0)
        line = 0.0
        for column in range(-3, 5):
            gap = light.contact[i + row, j + column] - point[2]
            if -0.004 < gap < reach:
                line += (1.0 - gap / reach) * (
                    1.0 - ax if column == -3 else (ax if column == 4 else 1.0)
                )
        total += wy * line
    return float(1.0 - light.settings[2] * total / 49.0)


@kernel
def _add_lit(point: F32, light: Light, weight: float, total: F64) -> None:
    """Add a shaded point, darkened by what stands around it, to ``total`` (3,)."""
    lit = _lit(point, light)
    opened = 1.0
    if point[9] > 0.0:
        opened = 1.0 - point[9] * (1.0 - _open(point, light))
    for k in range(3):
        total[k] += weight * opened * (point[3 + k] + lit * point[6 + k])


@kernel
def shade(
    ids: I32,
    first: int,
    surfaces: Surfaces,
    light: Light,
    fill: bool,
    still: F32,
    background: F64,
    tones: U8,
    out: U8,
) -> None:
    """Shade every pixel into ``out`` (H, W, 3), sRGB.

    Triangles before ``first`` never move: where the centre of a pixel shows one of them, its
    shading is read from ``still`` (H, W, POINT), the same numbers that shading it again gives.
    With ``fill`` it is the other way round: ``still`` is written at every centre, ``out`` is not.
    """
    height, width, samples = ids.shape
    point = np.empty(POINT, np.float32)
    total = np.empty(3, np.float64)
    scale = (TONES - 1) / WHITEST
    for row in range(height):
        for column in range(width):
            for k in range(3):
                total[k] = 0.0
            done = 0
            for s in range(1 if fill else samples):
                if done >> s & 1:
                    continue
                t = ids[row, column, s]
                surface = surfaces.surface[t] if t >= 0 else -1
                count = 0
                for other in range(s, samples):
                    o = ids[row, column, other]
                    if (surfaces.surface[o] if o >= 0 else -1) == surface:
                        done |= 1 << other
                        count += 1
                weight = count / samples
                if t < 0:
                    for k in range(3):
                        total[k] += weight * background[k]
                    continue
                if s == 0 and t < first and not fill:
                    for k in range(POINT):
                        point[k] = still[row, column, k]
                else:
                    x, y = column + 0.5 + SAMPLES[s, 0], row + 0.5 + SAMPLES[s, 1]
                    _shade_point(t, x, y, surfaces, light, point)
                if fill:
                    for k in range(POINT):
                        still[row, column, k] = point[k]
                else:
                    _add_lit(point, light, weight, total)
            if not fill:
                for k in range(3):
                    tone = min(total[k] * scale, TONES - 1.0)
                    out[row, column, k] = tones[int(tone)]


def tone_table(exposure: float) -> U8:
    """Bytes of the picture for linear light 0..WHITEST: filmic shoulder, then the sRGB curve."""
    x = np.linspace(0.0, WHITEST, TONES) * exposure
    # Straight below the knee, then bending towards white without ever reaching it.
    knee = 0.55
    bent = knee + (1.0 - knee) * (1.0 - np.exp(-(x - knee) / (1.0 - knee)))
    y = np.where(x < knee, x, bent)
    curve = np.where(y <= 0.0031308, 12.92 * y, 1.055 * np.maximum(y, 1e-9) ** (1 / 2.4) - 0.055)
    return np.clip(np.round(255.0 * curve), 0, 255).astype(np.uint8)


def to_linear(color: tuple[float, float, float]) -> F64:
    """Linear light of an sRGB colour in 0..1, (3,)."""
    value = np.asarray(color, np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
