"""Renderer of a trial: colour, depth, normals, ids and optical flow from scene and trajectory.

A frame depends on the scene and on one instant of the trajectory (two for the flow), never on the
frames that were rendered before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError, UnknownNameError
from physion.physics.trajectory import Trajectory
from physion.rendering.camera import View
from physion.rendering.light import StaticDepthMap, empty_maps, pack_light, tone_table
from physion.rendering.rasterizer import (
    CAMERA,
    NOTHING,
    SAMPLES,
    SURFACE,
    DepthRange,
    GeometryBuffers,
    LightMaps,
    Records,
    ShadingInputs,
    SurfaceMotion,
    Triangles,
    VisibilityBuffer,
    fill_geometry_buffers,
    rasterize,
    restore_pixels,
    transform,
)
from physion.rendering.rooms import Room, rooms
from physion.rendering.shading import KeptPixels, keep_nothing, shade
from physion.rendering.textures.atlas import build_atlas
from physion.rendering.triangles import Assembly, assemble, hide_absent, pose_meshes
from physion.scenes.scene import Scene

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]

VERSION = 2
"""Raised whenever a frame may look different, together with the golden digests."""
PASSES = ("color", "depth", "normals", "ids", "flow")
AGENT_COLOR, PATIENT_COLOR = (255, 0, 0, 255), (255, 255, 0, 255)
"""Colours of `role_map`: red, green, blue, alpha."""


@dataclass(frozen=True)
class Frame:
    """One rendered instant; None for passes that were not asked for. H rows, W columns.

    Colour is anti-aliased; the other passes are one exact sample at each pixel centre.

    - ``color`` (H, W, 3) uint8: sRGB.
    - ``depth`` (H, W) float32: metres along the optical axis (planar depth, not along the ray);
      infinity where nothing is seen.
    - ``normals`` (H, W, 3) float32: unit vectors in the world, interpolated, without normal
      mapping; towards the camera on cloth; zero where nothing is seen.
    - ``ids`` (H, W) int16: 0 is the room, i + 1 is the i-th of `Scene.names`.
    - ``flow`` (H, W, 2) float32: forward optical flow in pixels (x right, y down). The surface
      point at the centre of a pixel is, in the next frame, at that centre plus the flow, whether
      or not it is visible there. Zero in the last frame and for the room. NaN for a point that
      passes behind the camera.
    """

    color: U8 | None = None
    depth: F32 | None = None
    normals: F32 | None = None
    ids: NDArray[np.int16] | None = None
    flow: F32 | None = None


@dataclass(frozen=True)
class RenderSettings:
    """Settings of a `Renderer`.

    ``keep_static``: shade what never moves once, not in every frame. The frames are the same
    either way, to the byte.
    """

    keep_static: bool = True


class Renderer:
    """Renderer of the frames of one trial.

    It keeps working arrays: use one renderer for each thread.

    Parameters
    ----------
    scene, trajectory
        What is rendered: any frame of the motion, from the scene's camera.
    width, height
        Size of the pictures in pixels.
    settings
        What is kept between frames; the pictures are the same either way.

    Raises
    ------
    BadInputError
        If the size is below one pixel, or the trajectory is not one of the scene.

    Examples
    --------
    >>> from physion import sample_scene, simulate
    >>> scene = sample_scene("collide", 3)
    >>> frame = Renderer(scene, simulate(scene), 64, 64).render(30, ("color", "depth"))
    >>> frame.color.shape, frame.depth.dtype
    ((64, 64, 3), dtype('float32'))
    """

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        width: int = 256,
        height: int = 256,
        settings: RenderSettings = RenderSettings(),
    ) -> None:
        if width < 1 or height < 1:
            raise BadInputError(f"a picture of {width} x {height} pixels cannot be rendered")
        self.scene, self.trajectory = scene, trajectory
        self.width, self.height = width, height
        self._check_trajectory()
        self.room: Room = rooms.get(scene.room)
        view = View(scene.camera, width, height)
        self._view, self._projection = view, view.to_pixels
        self._assembly = a = assemble(scene, self.room)
        self._kept_triangles = a.first_triangle if settings.keep_static else 0
        # Of vertices and normals, all those that never move are written here and stay.
        self._vertices = np.zeros((a.vertex_count, 3))
        self._normals = np.zeros((len(a.faces), 3, 3), np.float32)
        pose_meshes(a, scene, trajectory, 0, False, self._vertices, self._normals)
        self._triangles = Triangles(a.faces, a.two_sided, np.zeros((len(a.faces), 3, 3)))
        self._static_points = self._to_pixels(self._vertices)
        self._static_buffer = self._draw_static()
        ids, nearness, drawn = self._static_buffer
        self._buffer = VisibilityBuffer(ids.copy(), nearness.copy(), drawn.copy())
        self._kept_pixels: KeptPixels | None = None
        self._static_geometry: GeometryBuffers | None = None

    @property
    def triangles(self) -> int:
        """Number of triangles, including the room."""
        return len(self._assembly.faces)

    def _check_trajectory(self) -> None:
        """Raise `BadInputError` if the trajectory is not one of the scene."""
        scene, trajectory = self.scene, self.trajectory
        cloth = sum(c.resolution**2 for c in scene.cloths)
        bodies = trajectory.positions.shape[1]
        if bodies != len(scene.bodies) or trajectory.cloth_vertices.shape[1] != cloth:
            raise BadInputError(
                f"the trajectory of {bodies} bodies and {trajectory.cloth_vertices.shape[1]} cloth "
                f"vertices does not belong to scene {scene.name!r}, which has "
                f"{len(scene.bodies)} bodies and {cloth} cloth vertices"
            )

    @cached_property
    def _inputs(self) -> ShadingInputs:
        """What shading reads; only the colour pass needs it, and its textures take time."""
        assembly = self._assembly
        return ShadingInputs(
            camera=_pack_camera(self._view),
            edges=self._triangles.edges,
            surfaces=_pack_surfaces(assembly, self._normals),
            groups=assembly.groups,
            materials=assembly.materials,
            atlas=build_atlas(assembly.textures),
            lights=pack_light(self.room),
            tones=tone_table(self.room.exposure),
        )

    @cached_property
    def _static_maps(self) -> tuple[StaticDepthMap, StaticDepthMap]:
        """Shadow and occlusion map with what never moves, without the room."""
        maps, assembly = empty_maps(self.scene, self.room), self._assembly
        first, last = assembly.room_triangles, assembly.first_triangle
        for static in maps:
            static.draw_static(self._vertices, assembly.faces, first, last)
        return maps

    def _draw_static(self) -> VisibilityBuffer:
        """Return the visibility buffer of what never moves."""
        shape = (self.height, self.width, len(SAMPLES))
        triangle_ids = np.full(shape, NOTHING, np.int32)
        drawn = np.zeros(shape[:2], np.bool_)
        buffer = VisibilityBuffer(triangle_ids, np.zeros(shape, np.float32), drawn)
        last = self._assembly.first_triangle
        static = self._triangles._replace(faces=self._triangles.faces[:last])
        rasterize(self._static_points, static, 0, self._depths, buffer)
        drawn[...] = False
        return buffer

    @property
    def _depths(self) -> DepthRange:
        return DepthRange(self.scene.camera.near, self.scene.camera.far)

    def _to_pixels(self, vertices: F64) -> F64:
        """Return the homogeneous pixels (V, 3) of world points (V, 3)."""
        points = np.empty_like(vertices)
        transform(self._projection, vertices, 0, points)
        return points

    def _moved_points(self, vertices: F64) -> F64:
        """Return the homogeneous pixels of all vertices, of which only the moving ones moved."""
        points = self._static_points.copy()
        transform(self._projection, vertices, self._assembly.first_vertex, points)
        return points

    def render(self, frame: int, passes: Sequence[str] = ("color",)) -> Frame:
        """Render some passes of one frame.

        Parameters
        ----------
        frame
            Index of the frame; negative ones count from the end.
        passes
            Names of `PASSES`.
        """
        for name in passes:
            if name not in PASSES:
                raise UnknownNameError("pass", name, PASSES)
        count = len(self.trajectory)
        if not -count <= frame < count:
            raise BadInputError(f"frame {frame} of a trajectory of {count} frames does not exist")
        frame %= count
        assembly = self._assembly
        vertices, normals = self._vertices, self._normals
        pose_meshes(assembly, self.scene, self.trajectory, frame, True, vertices, normals)
        hide_absent(assembly, self.scene, frame, vertices)
        points = self._moved_points(vertices)
        buffer = self._buffer
        restore_pixels(self._static_buffer, buffer)
        rasterize(points, self._triangles, assembly.first_triangle, self._depths, buffer)
        color = self._shade(vertices, normals) if "color" in passes else None
        if not set(passes) - {"color"}:
            return Frame(color=color)
        geometry = self._fill_geometry(
            buffer.triangle_ids, points, normals, frame, "flow" in passes
        )
        return Frame(
            color=color,
            depth=geometry.depth if "depth" in passes else None,
            normals=geometry.normals if "normals" in passes else None,
            ids=geometry.object_ids if "ids" in passes else None,
            flow=geometry.flow if "flow" in passes else None,
        )

    def frames(self, passes: Sequence[str] = ("color",)) -> Iterator[Frame]:
        """Render all frames, one after the other."""
        for frame in range(len(self.trajectory)):
            yield self.render(frame, passes)

    def _shade(self, vertices: F64, normals: F32) -> U8:
        """Return the colour pass (H, W, 3) of the frame that was drawn last."""
        assembly, inputs = self._assembly, self._inputs
        faces, first = assembly.faces, assembly.first_triangle
        inputs.surfaces["normals"][first:] = normals[first:]
        moving = vertices, assembly.first_vertex, faces, first
        maps = LightMaps(*(static.with_moving(*moving) for static in self._static_maps))
        if self._kept_pixels is None:
            self._kept_pixels = keep_nothing(self.height, self.width, maps)
        colors = self._kept_pixels.colors.copy()
        shade(self._buffer, self._kept_triangles, inputs, maps, self._kept_pixels, colors)
        return colors

    def _fill_geometry(
        self, triangle_ids: I32, points: F64, normals: F32, frame: int, flow: bool
    ) -> GeometryBuffers:
        """Return the passes other than colour; ``flow`` only if asked for, otherwise zero.

        Parameters
        ----------
        triangle_ids, points, normals
            Visible triangles, homogeneous pixels and corner normals of this frame.
        frame
            Index of the frame.
        flow
            Whether the flow is asked for.
        """
        assembly = self._assembly
        motion = SurfaceMotion(normals, assembly.object_ids, points)
        if self._static_geometry is None:
            self._static_geometry = _empty_geometry(self.height, self.width)
            ids = self._static_buffer.triangle_ids
            fill_geometry_buffers(ids, self._triangles, motion, 0, self._static_geometry)
            self._static_geometry.flow[...] = 0.0
        following = frame + 1
        flow = flow and following < len(self.trajectory)
        if flow:
            vertices = np.zeros_like(self._vertices)
            pose_meshes(assembly, self.scene, self.trajectory, following, True, vertices)
            motion = motion._replace(next_points=self._moved_points(vertices))
        static = self._static_geometry
        out = GeometryBuffers(
            static.depth.copy(),
            static.normals.copy(),
            static.object_ids.copy(),
            static.flow.copy(),
        )
        first = assembly.first_triangle
        fill_geometry_buffers(triangle_ids, self._triangles, motion, first, out)
        if not flow:
            out.flow[...] = 0.0
        return out


def _pack_camera(view: View) -> Records:
    """Return the camera as one record of `CAMERA`, (1,)."""
    camera = np.zeros(1, CAMERA)
    camera["position"], camera["rays"] = view.camera.position, view.ray_matrix
    return camera


def _pack_surfaces(assembly: Assembly, normals: F32) -> Records:
    """Return the triangles with these corner normals (T, 3, 3) as (T,) of `SURFACE`."""
    surfaces = np.zeros(len(assembly.faces), SURFACE)
    surfaces["normals"], surfaces["uv"] = normals, assembly.uv
    surfaces["tangents"], surfaces["material"] = assembly.tangents, assembly.material
    return surfaces


def _empty_geometry(height: int, width: int) -> GeometryBuffers:
    """Return the G-buffer of a picture in which nothing is seen."""
    return GeometryBuffers(
        depth=np.full((height, width), np.inf, np.float32),
        normals=np.zeros((height, width, 3), np.float32),
        object_ids=np.zeros((height, width), np.int16),
        flow=np.zeros((height, width, 2), np.float32),
    )


def role_map(ids: NDArray[np.integer], scene: Scene) -> NDArray[np.uint8]:
    """Return a picture (H, W, 4) uint8 with the agent in red and the patient in yellow.

    ``ids`` (H, W) as in a `Frame`. Everything else is transparent: alpha is 0.
    """
    colors = np.zeros((len(scene.names()) + 1, 4), np.uint8)
    colors[scene.index(scene.roles.agent) + 1] = AGENT_COLOR
    colors[scene.index(scene.roles.patient) + 1] = PATIENT_COLOR
    return np.asarray(colors[ids])
