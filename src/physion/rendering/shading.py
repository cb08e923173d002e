"""The colour of a surface under a room's light: textures, shadows, tone.

Light is linear. A surface gets light from all around (``around``: a constant and a slope along
each axis, so that walls differ), and from one soft lamp that throws shadows. Colour is shaded once
for each surface that a pixel shows, at the first sample that shows it, and weighted by the number
of samples. What never moves is shaded once: only the shadows on it change.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import coarse_log2_of, exp_of
from physion.numerics.kernel import kernel
from physion.rendering.rasterizer import SAMPLES

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]

TONES = 16384
POINT = 13
"""Numbers kept of a shaded point, see `_shade_point`."""
BLOCK = 8
MATERIAL = 21
CORNERS = 22
"""Numbers of a triangle: corner normals 0..8, texture coordinates 9..14, tangents 15..20, and the
row of its material."""
SHARPEN = 0.64
"""Share of the area of a pixel over which textures are averaged: below 1 is crisper."""
LN2 = 0.6931471805599453
WHITEST = 4.0
"""Linear light beyond which the tone table is white."""


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
    texels: U8, starts: NDArray[np.int64], row: int, u: float, v: float, level: float
) -> tuple[float, float, float, float, float]:
    """Linear albedo and slopes of a texture between two of its levels."""
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
    t: int,
    x: float,
    y: float,
    edges: F64,
    corners: F32,
    materials: F64,
    texels: U8,
    starts: NDArray[np.int64],
    view: F64,
    light: F64,
    out: F32,
    at: int,
) -> None:
    """Shade triangle ``t`` at pixel coordinates into row ``at`` of ``out`` (P, POINT).

    In order: the world point, the light from around, the lamp's light, how much the surface faces
    up (0..1), which is where things standing near darken it, and the normal without relief.
    """
    a0, a1, a2 = edges[t, 0], edges[t, 3], edges[t, 6]
    b0, b1, b2 = edges[t, 1], edges[t, 4], edges[t, 7]
    e0 = a0 * x + b0 * y + edges[t, 2]
    e1 = a1 * x + b1 * y + edges[t, 5]
    e2 = a2 * x + b2 * y + edges[t, 8]
    w = 1.0 / (e0 + e1 + e2)
    e0, e1, e2 = e0 * w, e1 * w, e2 * w
    vx = view[1, 0] * x + view[1, 1] * y + view[1, 2]
    vy = view[2, 0] * x + view[2, 1] * y + view[2, 2]
    vz = view[3, 0] * x + view[3, 1] * y + view[3, 2]
    px, py, pz = view[0, 0] + w * vx, view[0, 1] + w * vy, view[0, 2] + w * vz
    scale = -1.0 / np.sqrt(vx * vx + vy * vy + vz * vz)
    vx, vy, vz = vx * scale, vy * scale, vz * scale

    m = int(corners[t, MATERIAL])
    u0, u1, u2 = corners[t, 9], corners[t, 11], corners[t, 13]
    v0, v1, v2 = corners[t, 10], corners[t, 12], corners[t, 14]
    u = e0 * u0 + e1 * u1 + e2 * u2
    v = e0 * v0 + e1 * v1 + e2 * v2
    da, db = a0 + a1 + a2, b0 + b1 + b2
    du_dx = a0 * u0 + a1 * u1 + a2 * u2 - u * da
    du_dy = b0 * u0 + b1 * u1 + b2 * u2 - u * db
    dv_dx = a0 * v0 + a1 * v1 + a2 * v2 - v * da
    dv_dy = b0 * v0 + b1 * v1 + b2 * v2 - v * db
    # The square of the mean of both sides' lengths (geometric: between blur and flicker).
    square = np.sqrt((du_dx * du_dx + dv_dx * dv_dx) * (du_dy * du_dy + dv_dy * dv_dy))
    side = 1 << (starts.shape[1] - 1)
    level = 0.5 * coarse_log2_of(max(SHARPEN * side * side * w * w * square, 1.0))
    ar, ag, ab, slope_u, slope_v = _texture(texels, starts, int(materials[m, 3]), u, v, level)
    ar, ag, ab = ar * materials[m, 0], ag * materials[m, 1], ab * materials[m, 2]

    nx = e0 * corners[t, 0] + e1 * corners[t, 3] + e2 * corners[t, 6]
    ny = e0 * corners[t, 1] + e1 * corners[t, 4] + e2 * corners[t, 7]
    nz = e0 * corners[t, 2] + e1 * corners[t, 5] + e2 * corners[t, 8]
    scale = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
    if nx * vx + ny * vy + nz * vz < 0.0:
        scale = -scale
    nx, ny, nz = nx * scale, ny * scale, nz * scale
    out[at, 9] = min(max(2.0 * nz - 1.0, 0.0), 1.0)
    out[at, 10], out[at, 11], out[at, 12] = nx, ny, nz
    if materials[m, 8] > 0.0:
        slope_u, slope_v = slope_u * materials[m, 8], slope_v * materials[m, 8]
        nx -= slope_u * corners[t, 15] + slope_v * corners[t, 18]
        ny -= slope_u * corners[t, 16] + slope_v * corners[t, 19]
        nz -= slope_u * corners[t, 17] + slope_v * corners[t, 20]
        scale = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * scale, ny * scale, nz * scale

    lx, ly, lz = light[0, 0], light[0, 1], light[0, 2]
    direct = max(nx * lx + ny * ly + nz * lz, 0.0)
    toward = max(nx * vx + ny * vy + nz * vz, 0.0)
    shine = 0.0
    if direct > 0.0 and materials[m, 4] > 0.0:
        hx, hy, hz = lx + vx, ly + vy, lz + vz
        half = (nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz)
        if half > 0.5:
            # half ** sharpness, to 3e-4.
            shine = materials[m, 4] * exp_of(LN2 * materials[m, 5] * coarse_log2_of(half))
    metal = materials[m, 7]
    graze = (1.0 - toward) * (1.0 - toward)
    mirror = materials[m, 6] * (1.0 + (3.0 - 2.0 * metal) * graze * graze)
    window, high = 0.0, 0.0
    if mirror > 0.0:
        rx, ry, rz = 2.0 * toward * nx - vx, 2.0 * toward * ny - vy, 2.0 * toward * nz - vz
        window = _window_share(px, py, pz, rx, ry, rz, light)
        high = min(max(2.0 * rz, -1.0), 1.0)
    room = 1.0
    if materials[m, 10] > 0.0:
        room = _room_shade(px, py, pz, nx, ny, nz, light)
    out[at, 0], out[at, 1], out[at, 2] = px, py, pz
    end = 8 if high > 0.0 else 7
    for k in range(3):
        albedo = ar if k == 0 else (ag if k == 1 else ab)
        ambient = light[2, k] + nx * light[3, k] + ny * light[4, k] + nz * light[5, k]
        seen = light[6, k] + abs(high) * (light[end, k] - light[6, k])
        seen += window * (light[11, k] - seen)
        tint = 1.0 + metal * (albedo - 1.0)
        matte = albedo * (1.0 - 0.8 * metal)
        out[at, 3 + k] = room * (matte * ambient + mirror * tint * seen) + materials[m, 9] * albedo
        out[at, 6 + k] = room * light[1, k] * (matte * direct + tint * shine)


@kernel
def _window_share(
    px: float, py: float, pz: float, rx: float, ry: float, rz: float, light: F64
) -> float:
    """How much of the window a rough reflection along (rx, ry, rz) sees, 0..1."""
    gap = light[9, 1] - py
    if gap * ry <= 1e-9:
        return 0.0
    along = gap / ry
    x, z = px + along * rx, pz + along * rz
    blur = 0.25 + 0.12 * along
    u = min(x - light[9, 0], light[10, 0] - x) / blur + 0.5
    v = min(z - light[9, 2], light[10, 2] - z) / blur + 0.5
    u, v = min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
    return float(u * u * (3.0 - 2.0 * u) * v * v * (3.0 - 2.0 * v))


@kernel
def _room_shade(
    px: float, py: float, pz: float, nx: float, ny: float, nz: float, light: F64
) -> float:
    """Light that is left near the edges where walls, floor and ceiling meet, 0..1."""
    left = 1.0
    for k in range(3):
        p = px if k == 0 else (py if k == 1 else pz)
        n = nx if k == 0 else (ny if k == 1 else nz)
        flat = 1.0 - abs(n)
        low, high = max(p - light[12, k], 0.0), max(light[13, k] - p, 0.0)
        left *= 1.0 - 0.22 * flat * exp_of(-low / 0.6)
        left *= 1.0 - 0.22 * flat * exp_of(-high / 0.6)
    return float(left)


@kernel
def _lit(px: float, py: float, pz: float, m: F64, shadow: F32, busy: NDArray[np.bool_]) -> float:
    """Share of the lamp that reaches a world point: a soft-edged look into the shadow map."""
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] - 0.5
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] - 0.5
    height, width = shadow.shape
    if x < 2.0 or y < 2.0 or x >= width - 3.0 or y >= height - 3.0:
        return 1.0
    j, i = int(x), int(y)
    if not busy[i // BLOCK, j // BLOCK]:
        return 1.0
    z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
    ax, ay = x - j, y - i
    total = 0.0
    for row in range(-2, 4):
        line = 0.0
        for column in range(-1, 3):
            if shadow[i + row, j + column] >= z:
                line += 1.0
        if shadow[i + row, j - 2] >= z:
            line += 1.0 - ax
        if shadow[i + row, j + 3] >= z:
            line += ax
        total += line * (1.0 - ay if row == -2 else (ay if row == 3 else 1.0))
    return float(total / 25.0)


@kernel
def _crowded(
    px: float, py: float, pz: float, m: F64, contact: F32, busy: NDArray[np.bool_], reach: float
) -> float:
    """How much of the surroundings of a point is taken by things that stand low over it, 0..1."""
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] - 0.5
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] - 0.5
    height, width = contact.shape
    if x < 3.0 or y < 3.0 or x >= width - 4.0 or y >= height - 4.0:
        return 0.0
    j, i = int(x), int(y)
    if not busy[i // BLOCK, j // BLOCK]:
        return 0.0
    ax, ay = x - j, y - i
    total = 0.0
    for row in range(-3, 5):
        line = 0.0
        for column in range(-3, 5):
            gap = contact[i + row, j + column] - pz
            if -0.004 < gap < reach:
                share = 1.0 - gap / reach
                line += share * (1.0 - ax if column == -3 else (ax if column == 4 else 1.0))
        total += line * (1.0 - ay if row == -3 else (ay if row == 4 else 1.0))
    return float(total / 49.0)


@kernel
def _tone(tones: U8, light: float) -> int:
    """The byte of a linear light; black for what is no number (a normal of no length)."""
    at = light * ((TONES - 1) / WHITEST)
    if not at > 0.0:
        return int(tones[0])
    return int(tones[int(min(at, TONES - 1.0))])


@kernel
def shade(
    ids: I32,
    first: int,
    fill: bool,
    edges: F64,
    corners: F32,
    surface: I32,
    materials: F64,
    texels: U8,
    starts: NDArray[np.int64],
    view: F64,
    light: F64,
    to_shadow: F64,
    shadow: F32,
    shadow_busy: NDArray[np.bool_],
    to_contact: F64,
    contact: F32,
    contact_busy: NDArray[np.bool_],
    settings: F64,
    tones: U8,
    still: F32,
    out: U8,
) -> None:
    """Shade every pixel of ``ids`` (H, W, S) into ``out`` (H, W, 3), sRGB.

    Triangles before ``first`` never move: where the centre of a pixel shows one of them, its
    shading is read from ``still`` (H * W + 1, POINT), the same numbers that shading it again
    gives. With ``fill`` it is the other way round: ``still`` is written at every centre and
    ``out`` is not. The last row of ``still`` is room to work in.

    - ``edges`` (T, 9) as `rasterize` writes; ``corners`` (T, CORNERS) as `pack_corners` gives;
      ``surface`` (T,): triangles of one number are shaded as one.
    - ``materials`` (M, 12): linear colour, texture row, gloss, sharpness, mirror, metal, relief,
      glow, whether the room's edges darken it, unused.
    - ``texels``, ``starts``: an `Atlas`. ``view`` (4, 3): the camera's place; then the rows that
      take (x, y, 1) in pixels to a world vector. ``light`` (15, 3): a `Light`, row by row, then
      the linear colour where nothing is seen.
    - ``to_shadow``, ``shadow``, ``shadow_busy``: the `ShadeMap` of the lamp; ``to_contact``, ...:
      that of what hangs low over the ground.
    - ``settings`` (4,): how far a point is lifted off its surface before it is looked up, share of
      the lamp that shadows take, strength and reach in metres of the darkness under things.
    """
    height, width, samples = ids.shape
    lift, dark, strength, reach = settings[0], settings[1], settings[2], settings[3]
    for row in range(height):
        for column in range(width):
            red, green, blue = 0.0, 0.0, 0.0
            todo = (1 << samples) - 1
            for s in range(samples):
                if not todo >> s & 1:
                    continue
                t = ids[row, column, s]
                count = 1
                for other in range(s + 1, samples):
                    o = ids[row, column, other]
                    if o == t or (o >= 0 and t >= 0 and surface[o] == surface[t]):
                        todo &= ~(1 << other)
                        count += 1
                weight = count / samples
                if t < 0:
                    red += weight * light[14, 0]
                    green += weight * light[14, 1]
                    blue += weight * light[14, 2]
                    continue
                kept = s == 0 and t < first
                p = row * width + column if kept else height * width
                if fill or not kept:
                    x, y = column + 0.5 + SAMPLES[s, 0], row + 0.5 + SAMPLES[s, 1]
                    _shade_point(
                        t, x, y, edges, corners, materials, texels, starts, view, light, still, p
                    )
                if fill:
                    break
                px, py, pz = still[p, 0], still[p, 1], still[p, 2]
                lx, ly, lz = (
                    px + lift * still[p, 10],
                    py + lift * still[p, 11],
                    pz + lift * still[p, 12],
                )
                lit = _lit(lx, ly, lz, to_shadow, shadow, shadow_busy)
                lit = 1.0 - dark * (1.0 - lit)
                if still[p, 9] > 0.0:
                    crowd = _crowded(px, py, pz, to_contact, contact, contact_busy, reach)
                    weight *= 1.0 - still[p, 9] * strength * crowd
                red += weight * (still[p, 3] + lit * still[p, 6])
                green += weight * (still[p, 4] + lit * still[p, 7])
                blue += weight * (still[p, 5] + lit * still[p, 8])
            if not fill:
                out[row, column, 0] = _tone(tones, red)
                out[row, column, 1] = _tone(tones, green)
                out[row, column, 2] = _tone(tones, blue)


def pack_corners(normals: F32, uv: F32, tangents: F32, material: I32) -> F32:
    """What the shading loop reads of each triangle, side by side: (T, CORNERS)."""
    return np.concatenate([normals, uv, tangents, material[:, None].astype(np.float32)], axis=1)
