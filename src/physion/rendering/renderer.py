"""Frames of a trial: colour, depth, normals, ids and flow from its scene and trajectory.

A frame depends on the scene and on one instant of the trajectory (two for the flow), never on the
frames that were rendered before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError, UnknownNameError
from physion.numerics.linear_algebra import apply
from physion.physics.trajectory import Trajectory
from physion.rendering.camera import View
from physion.rendering.light import ShadeMap, StillMap, pack_light, still_maps, tone_table
from physion.rendering.rasterizer import (
    NOTHING,
    SAMPLES,
    measure,
    rasterize,
    rasterize_depth,
)
from physion.rendering.rooms import Room, rooms
from physion.rendering.shading import POINT, pack_corners, shade
from physion.rendering.triangles import assemble, place
from physion.scenes.scene import Scene

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

VERSION = 2
"""Raised whenever a frame may look different, together with the golden digests."""
PASSES = ("color", "depth", "normals", "ids", "flow")


@dataclass(frozen=True)
class Frame:
    """One rendered instant; None for passes that were not asked for. H rows, W columns.

    Colour is anti-aliased; the other passes are one exact sample at each pixel centre.

    - ``color`` (H, W, 3) uint8: sRGB.
    - ``depth`` (H, W) float32: metres along the optical axis (planar z, not along the ray);
      infinity where nothing is seen.
    - ``normals`` (H, W, 3) float32: unit, world axes, of the smooth surface without relief;
      towards the camera on cloth; zero where nothing is seen.
    - ``ids`` (H, W) int16: 0 is the room, i + 1 is the i-th of `Scene.names`.
    - ``flow`` (H, W, 2) float32: forward, in pixels (x right, y down): the surface point at the
      centre of a pixel in this frame is, in the next one, at that centre plus the flow, whether or
      not it can be seen there. Zero in the last frame and for the room. NaN for a point that
      passes behind the camera.
    """

    color: NDArray[np.uint8] | None = None
    depth: F32 | None = None
    normals: F32 | None = None
    ids: NDArray[np.int16] | None = None
    flow: F32 | None = None


@dataclass(frozen=True)
class Settings:
    """``still_layer``: draw and shade what never moves once, not in every frame. The frames are
    the same either way, to the byte."""

    still_layer: bool = True


class Renderer:
    """Renders any frame of one trial at ``width`` x ``height`` pixels.

    It keeps arrays to work in: use one renderer for each thread.
    """

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        width: int = 256,
        height: int = 256,
        settings: Settings = Settings(),
    ) -> None:
        if width < 1 or height < 1:
            raise BadInputError(f"a picture of {width} x {height} pixels cannot be rendered")
        self.scene, self.trajectory = scene, trajectory
        self.width, self.height = width, height
        self._check()
        self.room: Room = rooms.get(scene.room)
        view = View(scene.camera, width, height)
        self._projection = view.to_pixels
        self._assembly = assembly = assemble(scene, self.room)
        self._first = assembly.first_triangle if settings.still_layer else 0
        self._tones = tone_table(self.room.exposure)
        self._sight, self._light, self._settings = pack_light(self.room, view)
        self._still_vertices, self._still_normals = place(assembly, scene, trajectory, 0, False)
        self._corners = pack_corners(
            self._still_normals, assembly.uv, assembly.tangents, assembly.material
        )
        self._edges = np.zeros((len(assembly.faces), 9))
        self._shadow, self._contact = self._still_maps()
        self._ids, self._inverse, self._points = self._still_picture()
        self._still_shading: F32 | None = None
        self._still_passes: tuple[F32, F32, NDArray[np.int16], F32] | None = None

    @property
    def triangles(self) -> int:
        """How many triangles there are, the room's among them."""
        return len(self._assembly.faces)

    def _check(self) -> None:
        scene, trajectory = self.scene, self.trajectory
        cloth = sum(c.resolution**2 for c in scene.cloths)
        bodies = trajectory.positions.shape[1]
        if bodies != len(scene.bodies) or trajectory.cloth_vertices.shape[1] != cloth:
            raise BadInputError(
                f"trajectory of {bodies} bodies and {trajectory.cloth_vertices.shape[1]} cloth "
                f"vertices is not one of scene {scene.name!r} with {len(scene.bodies)} bodies and "
                f"{cloth} cloth vertices"
            )

    def _still_maps(self) -> tuple[StillMap, StillMap]:
        """Shadow and contact map with what never moves."""
        maps = still_maps(self.scene, self.room)
        for still in maps:
            self._draw_map(still.depth, still.matrix, self._still_vertices, False)
        return maps

    def _draw_map(self, depth: F32, matrix: F64, vertices: F64, moving: bool) -> None:
        """Add the moving bodies, or the others without the room, to a depth map."""
        assembly = self._assembly
        points = apply(matrix[:, :3], vertices) + matrix[:, 3]
        first, last = assembly.room_triangles, assembly.first_triangle
        if moving:
            first, last = assembly.first_triangle, len(assembly.faces)
        rasterize_depth(points, assembly.faces, first, last, depth)

    def _still_picture(self) -> tuple[I32, F32, F64]:
        """What never moves, drawn: triangle ids, inverse depths, homogeneous pixels."""
        assembly = self._assembly
        ids = np.full((self.height, self.width, len(SAMPLES)), NOTHING, np.int32)
        inverse = np.zeros(ids.shape, np.float32)
        points = self._to_pixels(self._still_vertices)
        still = assembly.faces[: assembly.first_triangle]
        self._draw(points, still, 0, ids, inverse)
        return ids, inverse, points

    def _to_pixels(self, vertices: F64) -> F64:
        return apply(self._projection[:, :3], vertices) + self._projection[:, 3]

    def _draw(self, points: F64, faces: I32, first: int, ids: I32, inverse: F32) -> None:
        camera, two_sided = self.scene.camera, self._assembly.two_sided
        rasterize(
            points, faces, two_sided, first, camera.near, camera.far, self._edges, ids, inverse
        )

    def render(self, frame: int, passes: Sequence[str] = ("color",)) -> Frame:
        """Render the passes named, of `PASSES`, of frame ``frame`` (-1 is the last)."""
        for name in passes:
            if name not in PASSES:
                raise UnknownNameError("pass", name, PASSES)
        count = len(self.trajectory)
        if not -count <= frame < count:
            raise BadInputError(f"frame {frame} of a trajectory of {count} frames does not exist")
        frame %= count
        assembly = self._assembly
        vertices, normals = place(assembly, self.scene, self.trajectory, frame, True)
        vertices += self._still_vertices
        normals += self._still_normals
        points = self._points.copy()
        first = assembly.first_vertex
        points[first:] = self._to_pixels(vertices[first:])
        ids, inverse = self._ids.copy(), self._inverse.copy()
        self._draw(points, assembly.faces, assembly.first_triangle, ids, inverse)
        color = self._color(ids, vertices, normals) if "color" in passes else None
        if not set(passes) - {"color"}:
            return Frame(color=color)
        depth, normal, identity, flow = self._measure(ids, points, normals, frame, "flow" in passes)
        return Frame(
            color=color,
            depth=depth if "depth" in passes else None,
            normals=normal if "normals" in passes else None,
            ids=identity if "ids" in passes else None,
            flow=flow if "flow" in passes else None,
        )

    def frames(self, passes: Sequence[str] = ("color",)) -> Iterator[Frame]:
        """Render all frames, one after the other."""
        for frame in range(len(self.trajectory)):
            yield self.render(frame, passes)

    def _color(self, ids: I32, vertices: F64, normals: F32) -> NDArray[np.uint8]:
        assembly, first = self._assembly, self._assembly.first_triangle
        corners = self._corners
        corners[first:, :9] = normals[first:]
        surfaces = (self._edges, corners, assembly.surface, assembly.materials)
        light = (self._sight, self._light, *self._map(self._shadow, vertices))
        rest = (*self._map(self._contact, vertices), self._settings, self._tones)
        out = np.empty((self.height, self.width, 3), np.uint8)
        arrays = (*surfaces, *assembly.atlas, *light, *rest)
        if self._still_shading is None:
            still = np.zeros((self.height * self.width + 1, POINT), np.float32)
            if self._first:
                shade(self._ids, self._first, True, *arrays, still, out)
            self._still_shading = still
        shade(ids, self._first, False, *arrays, self._still_shading, out)
        return out

    def _map(self, still: StillMap, vertices: F64) -> ShadeMap:
        """The map of one instant: what never moves, and the moving bodies on top."""
        depth = still.depth.copy()
        self._draw_map(depth, still.matrix, vertices, True)
        return still.with_moving(depth)

    def _measure(
        self, ids: I32, points: F64, normals: F32, frame: int, flow: bool
    ) -> tuple[F32, F32, NDArray[np.int16], F32]:
        if self._still_passes is None:
            blank = (
                np.full((self.height, self.width), np.inf, np.float32),
                np.zeros((self.height, self.width, 3), np.float32),
                np.zeros((self.height, self.width), np.int16),
                np.zeros((self.height, self.width, 2), np.float32),
            )
            self._measure_into(self._ids, normals, points, 0, blank)
            blank[3][...] = 0.0
            self._still_passes = blank
        later = points
        following = frame + 1
        if flow and following < len(self.trajectory):
            later = points.copy()
            vertices, _ = place(self._assembly, self.scene, self.trajectory, following, True)
            first = self._assembly.first_vertex
            later[first:] = self._to_pixels(vertices[first:])
        out = (
            self._still_passes[0].copy(),
            self._still_passes[1].copy(),
            self._still_passes[2].copy(),
            self._still_passes[3].copy(),
        )
        self._measure_into(ids, normals, later, self._assembly.first_triangle, out)
        if later is points:
            out[3][...] = 0.0
        return out

    def _measure_into(
        self,
        ids: I32,
        normals: F32,
        later: F64,
        first: int,
        out: tuple[F32, F32, NDArray[np.int16], F32],
    ) -> None:
        a = self._assembly
        measure(ids, self._edges, a.faces, a.objects, normals, a.two_sided, later, first, *out)


def render_frames(
    scene: Scene,
    trajectory: Trajectory,
    *,
    width: int = 256,
    height: int = 256,
    passes: Sequence[str] = ("color",),
) -> Iterator[Frame]:
    """Render all frames of a trial, lazily."""
    return Renderer(scene, trajectory, width, height).frames(passes)


def role_map(ids: NDArray[np.integer], scene: Scene) -> NDArray[np.uint8]:
    """Picture (H, W, 4) that points out the agent in red and the patient in yellow, from ids.

    Everything else is transparent: alpha is 0.
    """
    colors = np.zeros((len(scene.names()) + 1, 4), np.uint8)
    colors[scene.index(scene.roles.agent) + 1] = (255, 0, 0, 255)
    colors[scene.index(scene.roles.patient) + 1] = (255, 255, 0, 255)
    return np.asarray(colors[ids])
