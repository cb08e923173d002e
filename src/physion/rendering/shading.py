"""Colour pass: textures, light, shadows and tone curve for every pixel of a visibility buffer.

Light is linear until the tone curve. Each surface that a pixel shows is shaded once, at the first
sample that shows it, and weighted by its number of samples. The light that a surface point sends
to the camera is

    room (ambient + environment) + emission + lit room (Lambert + specular)

with the terms of `_shade_point`, whose equations stand below; ``lit`` is the fraction of the
directional light that shadows leave, and ``room`` the ambient occlusion near the room's walls.
Everything but ``lit`` and the occlusion under objects depends on the point only, and is kept for
surfaces that never move. Where a pixel shows nothing else, and no moving body is near the parts of
the depth maps that it reads, its colour is kept too.

References
----------
Holbert, D. (2011). Saying "goodbye" to shadow acne. Game Developers Conference, poster.
Heckbert, P. (1989). Fundamentals of texture mapping and image warping. MSc thesis, UC Berkeley.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import coarse_log2_of, exp_of
from physion.numerics.kernel import in_place_kernel
from physion.rendering.rasterizer import (
    OCCLUSION_RADIUS,
    POINT,
    SAMPLES,
    SHADOW_RADIUS,
    LightMaps,
    Records,
    ShadingInputs,
    VisibilityBuffer,
    barycentric,
    block_index,
    lit_fraction,
    occluded_fraction,
)
from physion.rendering.textures.atlas import mip_level, sample_texture

Bools = NDArray[np.bool_]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]


# Reflection of light at a point of a surface: diffuse, specular, the mirrored room, its corners.
#
# References
# ----------
# Blinn, J. (1977). Models of light reflection for computer synthesized pictures. SIGGRAPH.
# Schlick, C. (1994). An inexpensive BRDF model for physically-based rendering. Computer Graphics
#     Forum 13(3).

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


@in_place_kernel
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@in_place_kernel
def scaled(a: Vector, factor: float) -> Vector:
    """Return ``factor`` times a vector."""
    return a[0] * factor, a[1] * factor, a[2] * factor


@in_place_kernel
def lambert(normal: Vector, to_light: Vector) -> float:
    """Return Lambert's cosine, max(n . l, 0): what a matte surface receives by its tilt."""
    return max(dot(normal, to_light), 0.0)


@in_place_kernel
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


@in_place_kernel
def fresnel(reflectance: float, metalness: float, cosine: float) -> float:
    """Return the fraction of the environment that a surface reflects at an angle to its normal.

    F = F0 (1 + g (1 - cos)^4), with the gain g = 3 for dielectrics and 1 for metals. It has the
    form of Schlick's (1994) approximation F0 + (1 - F0) (1 - cos)^5, but stays proportional to
    F0, so that rough surfaces do not turn into mirrors when seen edge-on.
    """
    grazing = (1.0 - cosine) * (1.0 - cosine)
    return reflectance * (1.0 + (GRAZING_GAIN - GRAZING_GAIN_LOST * metalness) * grazing * grazing)


@in_place_kernel
def mirrored(normal: Vector, to_eye: Vector, cosine: float) -> Vector:
    """Return the mirrored viewing ray r = 2 (n . v) n - v; ``cosine`` is n . v."""
    twice = 2.0 * cosine
    return (
        twice * normal[0] - to_eye[0],
        twice * normal[1] - to_eye[1],
        twice * normal[2] - to_eye[2],
    )


@in_place_kernel
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


@in_place_kernel
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


TONES = 16384
"""Entries of the tone table."""
WHITEST = 4.0
"""Linear light of the last entry of the tone table; brighter light has the same tone."""
FOOTPRINT = 0.64
"""Fraction of a pixel's area over which textures are averaged: below 1 is sharper."""
METAL_DIFFUSE_LOST = 0.8
"""Fraction of the diffuse reflection that a metal lacks."""
ENVIRONMENT_SLOPE = 2.0
"""Reflections with a vertical component of 1 / this or more show the ceiling or the floor alone."""
SIDES, BELOW, ABOVE = 0, 1, 2
"""Rows of the environment in `physion.rendering.rasterizer.LIGHT`."""
SHADOW_OFFSET = 0.03
"""Metres along the normal from a point to where it is looked up in the shadow map, so that the
texels of the map do not shadow their own surface (normal offset, Holbert 2011)."""
LEVEL_COSINE = 0.5
"""Vertical component of the normal up to which objects near a surface do not occlude it."""


@in_place_kernel
def _pixel_ray(camera: Any, x: float, y: float) -> Vector:
    """Return the world vector from a camera record to depth 1 at a pixel."""
    rays = camera.rays
    return (
        rays[0, 0] * x + rays[0, 1] * y + rays[0, 2],
        rays[1, 0] * x + rays[1, 1] * y + rays[1, 2],
        rays[2, 0] * x + rays[2, 1] * y + rays[2, 2],
    )


@in_place_kernel
def texture_footprint(
    edges: F64, surfaces: Records, t: int, weights: Vector, depth: float
) -> tuple[float, float, float]:
    """Return u, v, and the area that a pixel covers in the texture, as a fraction of it.

    Parameters
    ----------
    edges, surfaces, t
        The triangles as in `ShadingInputs`, and the index of one.
    weights, depth
        Barycentric coordinates and depth of the point, see `barycentric`.

    Notes
    -----
    With Ek = ak x + bk y + ck the edge functions and w = 1 / sum Ek the depth,
    u = w sum Ek uk and du/dx = w (sum ak uk - u sum ak); likewise for v and y. The area is the
    product of the lengths of (du, dv)/dx and (du, dv)/dy. The area, rather than the longer side
    (Williams 1983), makes surfaces seen edge-on sharper: a compromise between blur and flicker
    (Heckbert 1989).
    """
    uv = surfaces[t].uv
    a0, a1, a2 = edges[t, 0, 0], edges[t, 1, 0], edges[t, 2, 0]
    b0, b1, b2 = edges[t, 0, 1], edges[t, 1, 1], edges[t, 2, 1]
    u0, u1, u2 = uv[0, 0], uv[1, 0], uv[2, 0]
    v0, v1, v2 = uv[0, 1], uv[1, 1], uv[2, 1]
    u = weights[0] * u0 + weights[1] * u1 + weights[2] * u2
    v = weights[0] * v0 + weights[1] * v1 + weights[2] * v2
    da, db = a0 + a1 + a2, b0 + b1 + b2
    du_dx = a0 * u0 + a1 * u1 + a2 * u2 - u * da
    du_dy = b0 * u0 + b1 * u1 + b2 * u2 - u * db
    dv_dx = a0 * v0 + a1 * v1 + a2 * v2 - v * da
    dv_dy = b0 * v0 + b1 * v1 + b2 * v2 - v * db
    area = np.sqrt((du_dx * du_dx + dv_dx * dv_dx) * (du_dy * du_dy + dv_dy * dv_dy))
    return u, v, FOOTPRINT * depth * depth * area


@in_place_kernel
def _smooth_normal(surfaces: Records, t: int, weights: Vector, to_eye: Vector) -> Vector:
    """Return the interpolated unit normal of triangle ``t``, on the side that the camera sees."""
    normals = surfaces[t].normals
    b0, b1, b2 = weights
    nx = b0 * normals[0, 0] + b1 * normals[1, 0] + b2 * normals[2, 0]
    ny = b0 * normals[0, 1] + b1 * normals[1, 1] + b2 * normals[2, 1]
    nz = b0 * normals[0, 2] + b1 * normals[1, 2] + b2 * normals[2, 2]
    scale = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
    if dot((nx, ny, nz), to_eye) < 0.0:
        scale = -scale
    return nx * scale, ny * scale, nz * scale


@in_place_kernel
def _mapped_normal(
    normal: Vector, surfaces: Records, t: int, slope_u: float, slope_v: float
) -> Vector:
    """Tilt a normal by the slopes of a normal map: n' = n - su tu - sv tv, scaled to length 1.

    That is the normal of the height field h(u, v) with slopes su = dh/du and sv = dh/dv.
    """
    tangents = surfaces[t].tangents
    nx = normal[0] - (slope_u * tangents[0, 0] + slope_v * tangents[1, 0])
    ny = normal[1] - (slope_u * tangents[0, 1] + slope_v * tangents[1, 1])
    nz = normal[2] - (slope_u * tangents[0, 2] + slope_v * tangents[1, 2])
    return scaled((nx, ny, nz), 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz))


@in_place_kernel
def _shade_point(
    t: int, x: float, y: float, inputs: ShadingInputs, points: Records, row: int
) -> None:
    """Shade triangle ``t`` at a point of the picture.

    Parameters
    ----------
    t
        Index of the triangle.
    x, y
        Point of the picture in pixels.
    inputs
        The scene.
    points, row
        Where the result is written.

    Notes
    -----
    With albedo a, metalness m, tint = 1 + m (a - 1), diffuse colour d = a (1 - 0.8 m), normal n
    and reflected ray r:

        ambient light   room (d (A + n . slopes) + F tint environment(r)) + emission a
        direct light    room color (d max(n . l, 0) + tint specular (n . h)^exponent)
    """
    edges, surfaces = inputs.edges, inputs.surfaces
    camera, light = inputs.camera[0], inputs.lights[0]
    material, point = inputs.materials[surfaces[t].material], points[row]
    # The point: camera + depth * ray, and the direction back to the camera.
    depth, b0, b1, b2 = barycentric(edges, t, x, y)
    weights = (b0, b1, b2)
    ray, eye = _pixel_ray(camera, x, y), camera.position
    position = (eye[0] + depth * ray[0], eye[1] + depth * ray[1], eye[2] + depth * ray[2])
    to_eye = scaled(ray, -1.0 / np.sqrt(dot(ray, ray)))

    # Albedo: colour times texture at the level of the pixel's footprint.
    u, v, footprint = texture_footprint(edges, surfaces, t, weights, depth)
    atlas = inputs.atlas
    level = mip_level(footprint, 1 << (atlas.starts.shape[1] - 1))
    scale = material.normal_scale
    red, green, blue, slope_u, slope_v = sample_texture(
        atlas, material.texture, u, v, level, scale > 0.0
    )
    color = material.color
    albedo = (red * color[0], green * color[1], blue * color[2])

    # Normals: the smooth one for shadows and occlusion, the mapped one for light.
    normal = _smooth_normal(surfaces, t, weights, to_eye)
    for k in range(3):
        point.position[k] = position[k]
        point.normal[k] = normal[k]
    levelness = (normal[2] - LEVEL_COSINE) / (1.0 - LEVEL_COSINE)
    point.levelness = min(max(levelness, 0.0), 1.0)
    if scale > 0.0:
        normal = _mapped_normal(normal, surfaces, t, slope_u * scale, slope_v * scale)

    # Directional light: Lambert and Blinn-Phong.
    to_light = (light.direction[0], light.direction[1], light.direction[2])
    diffuse = lambert(normal, to_light)
    specular = 0.0
    if diffuse > 0.0 and material.specular > 0.0:
        specular = material.specular * highlight(normal, to_light, to_eye, material.exponent)

    # Environment: what the mirrored ray meets, as far as Fresnel reflects it.
    metal = material.metalness
    cosine = max(dot(normal, to_eye), 0.0)
    mirror = fresnel(material.reflectance, metal, cosine)
    window, height = 0.0, 0.0
    if mirror > 0.0:
        ray = mirrored(normal, to_eye, cosine)
        window = window_fraction(position, ray, light.window_low, light.window_high)
        height = min(max(ENVIRONMENT_SLOPE * ray[2], -1.0), 1.0)
    room = 1.0
    if material.occluded:
        room = corner_occlusion(position, normal, light.room_low, light.room_high)

    # Sum of the terms, for red, green and blue.
    pole = ABOVE if height > 0.0 else BELOW
    slopes, environment = light.ambient_slopes, light.environment
    for k in range(3):
        a = albedo[0] if k == 0 else (albedo[1] if k == 1 else albedo[2])
        ambient = light.ambient[k] + normal[0] * slopes[0, k]
        ambient = ambient + normal[1] * slopes[1, k] + normal[2] * slopes[2, k]
        seen = environment[SIDES, k] + abs(height) * (environment[pole, k] - environment[SIDES, k])
        seen += window * (light.window_color[k] - seen)
        tint = 1.0 + metal * (a - 1.0)
        matte = a * (1.0 - METAL_DIFFUSE_LOST * metal)
        sent = room * (matte * ambient + mirror * tint * seen)
        point.ambient[k] = sent + material.emission * a
        point.direct[k] = room * light.color[k] * (matte * diffuse + tint * specular)


@in_place_kernel
def _tone(tones: U8, light: float) -> int:
    """Return the byte of a linear light; black for NaN (from a normal without length)."""
    index = light * ((TONES - 1) / WHITEST)
    if not index > 0.0:
        return int(tones[0])
    return int(tones[int(min(index, TONES - 1.0))])


UNKNOWN, NEAR = 1, 2
"""Bits of `KeptPixels.state`."""


class KeptPixels(NamedTuple):
    """What `shade` keeps from frame to frame of pixels that show only what never moves.

    All of it depends on the scene only, and it is filled in whatever frame needs it first.

    - ``points`` (H * W + 1,) of `physion.rendering.rasterizer.POINT`: the surface at the centre of
      pixel i * W + j, in row i and column j. The last one is overwritten.
    - ``shaded`` (H * W,) bool: whether it is there.
    - ``linked`` (H * W,) bool: whether the lookups of the pixel are in the lists below.
    - ``shadow_first``, ``occlusion_first`` (blocks,) int32, ``shadow_next``, ``occlusion_next``
      (H * W * S,) int32: for each block of the two depth maps, a linked list of the lookups with
      this `block_index`. Lookup p * S + k is of pixel p. Lists end with -1.
    - ``colors`` (H, W, 3) uint8: the colour while no moving body is near the blocks.
    - ``state`` (H * W,) uint8: `UNKNOWN` as long as the colour is not there, otherwise 0. Within
      `shade`, plus `NEAR` where a moving body is near.
    """

    points: Records
    shaded: Bools
    linked: Bools
    shadow_first: I32
    shadow_next: I32
    occlusion_first: I32
    occlusion_next: I32
    colors: U8
    state: U8


def keep_nothing(height: int, width: int, maps: LightMaps) -> KeptPixels:
    """Return a `KeptPixels` in which nothing is known yet, for depth maps of these sizes."""
    pixels = height * width
    return KeptPixels(
        points=np.zeros(pixels + 1, POINT),
        shaded=np.zeros(pixels, np.bool_),
        linked=np.zeros(pixels, np.bool_),
        shadow_first=np.full(maps.shadow.moved.size, -1, np.int32),
        shadow_next=np.empty(pixels * len(SAMPLES), np.int32),
        occlusion_first=np.full(maps.occlusion.moved.size, -1, np.int32),
        occlusion_next=np.empty(pixels * len(SAMPLES), np.int32),
        colors=np.zeros((height, width, 3), np.uint8),
        state=np.full(pixels, UNKNOWN, np.uint8),
    )


@in_place_kernel
def _mark_near(first: I32, following: I32, moved: Bools, state: U8) -> None:
    """Mark the pixels with a lookup in one of the blocks that are true in ``moved`` (blocks,)."""
    for block in range(len(first)):
        if moved[block]:
            lookup = first[block]
            while lookup >= 0:
                state[lookup // len(SAMPLES)] |= NEAR
                lookup = following[lookup]


@in_place_kernel
def shade(
    buffer: VisibilityBuffer,
    static: int,
    inputs: ShadingInputs,
    maps: LightMaps,
    kept: KeptPixels,
    colors: U8,
) -> None:
    """Shade every pixel of a visibility buffer.

    Parameters
    ----------
    buffer
        What each pixel shows.
    static
        Triangles before this index never move. What depends on them only is read from ``kept``
        where it is there, and kept where it is not; that gives the same bytes as shading again.
        With 0 nothing is kept.
    inputs, maps
        The scene, and its depth maps in this frame.
    kept
        Read and filled in.
    colors
        (H, W, 3) uint8, sRGB: a copy of ``kept.colors`` in which all other pixels are written.
    """
    triangle_ids = buffer.triangle_ids
    height, width, samples = triangle_ids.shape
    light, groups, tones = inputs.lights[0], inputs.groups, inputs.tones
    shadow, occlusion = maps.shadow, maps.occlusion
    points, state, drawn = kept.points, kept.state, buffer.drawn
    if static > 0:
        _mark_near(kept.shadow_first, kept.shadow_next, shadow.moved, state)
        _mark_near(kept.occlusion_first, kept.occlusion_next, occlusion.moved, state)
    for row in range(height):
        for column in range(width):
            pixel = row * width + column
            if state[pixel] == 0 and not drawn[row, column]:
                continue
            still = static > 0 and not drawn[row, column]
            moved = state[pixel] & NEAR != 0
            state[pixel] &= UNKNOWN
            new = still and not kept.linked[pixel]
            surfaces = 0
            red, green, blue = 0.0, 0.0, 0.0
            todo = (1 << samples) - 1  # bit mask of the samples not yet shaded
            for s in range(samples):
                if not todo >> s & 1:
                    continue
                t = triangle_ids[row, column, s]
                count = 1
                for other in range(s + 1, samples):
                    o = triangle_ids[row, column, other]
                    if o == t or (o >= 0 and t >= 0 and groups[o] == groups[t]):
                        todo &= ~(1 << other)
                        count += 1
                weight = count / samples
                if t < 0:
                    red += weight * light.background[0]
                    green += weight * light.background[1]
                    blue += weight * light.background[2]
                    continue
                p = pixel
                if s > 0 or t >= static:
                    p = height * width
                if p == height * width or not kept.shaded[p]:
                    x, y = column + 0.5 + SAMPLES[s, 0], row + 0.5 + SAMPLES[s, 1]
                    _shade_point(t, x, y, inputs, points, p)
                    if p < height * width:
                        kept.shaded[p] = True
                point = points[p]
                px, py, pz = point.position[0], point.position[1], point.position[2]
                sx = px + SHADOW_OFFSET * point.normal[0]
                sy = py + SHADOW_OFFSET * point.normal[1]
                sz = pz + SHADOW_OFFSET * point.normal[2]
                direct = point.direct
                turned_away = direct[0] == 0.0 and direct[1] == 0.0 and direct[2] == 0.0
                lit = 1.0  # of no light
                if not turned_away:
                    lit = lit_fraction(shadow, sx, sy, sz)
                    lit = 1.0 - light.shadow_strength * (1.0 - lit)
                levelness = point.levelness
                if levelness > 0.0:
                    occluded = occluded_fraction(occlusion, px, py, pz)
                    weight *= 1.0 - levelness * light.occlusion_strength * occluded
                red += weight * (point.ambient[0] + lit * point.direct[0])
                green += weight * (point.ambient[1] + lit * point.direct[1])
                blue += weight * (point.ambient[2] + lit * point.direct[2])
                if new:
                    lookup = pixel * samples + surfaces
                    if not turned_away:
                        block = block_index(shadow, sx, sy, sz, SHADOW_RADIUS)
                        if block >= 0:
                            kept.shadow_next[lookup] = kept.shadow_first[block]
                            kept.shadow_first[block] = lookup
                            moved = moved or shadow.moved[block]
                    if levelness > 0.0:
                        block = block_index(occlusion, px, py, pz, OCCLUSION_RADIUS)
                        if block >= 0:
                            kept.occlusion_next[lookup] = kept.occlusion_first[block]
                            kept.occlusion_first[block] = lookup
                            moved = moved or occlusion.moved[block]
                    surfaces += 1
            colors[row, column, 0] = _tone(tones, red)
            colors[row, column, 1] = _tone(tones, green)
            colors[row, column, 2] = _tone(tones, blue)
            if new:
                kept.linked[pixel] = True
            if still and not moved:
                state[pixel] = 0
                for k in range(3):
                    kept.colors[row, column, k] = colors[row, column, k]
