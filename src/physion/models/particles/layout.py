"""Particles of several scenes as one set of tensors, and the state of their objects.

Numbers of objects and rows of particles run over all scenes, which lie one after the other, so
that the graphs of all scenes are one graph without edges between scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from physion.models.particles.bodies import CLOTH, KINEMATIC, Poses, SceneParticles
from physion.models.particles.rigid_motion import mean_by

I64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SceneLayout:
    """What does not change in time: K objects with P particles of B scenes.

    - ``shape`` (P, 3) float64: offset of a particle from the centre of its object at rest, metres.
    - ``normals`` (P, 3) float64: outward unit normals at rest; 0 where there are none.
    - ``owners`` (P,), ``kinds`` (K,), ``scene`` (K,): see `bodies.SceneParticles`.
    - ``loose`` (C,): rows of the particles that move on their own.
    - ``links`` (2, L): edges within objects that never change: receivers and senders.
    - ``floor`` (K,): height of the floor, metres. ``size`` (K,): root mean square of ``shape``.
    - ``starts`` (K + 1,), ``scene_array`` (K,), ``moves`` (K,): for `neighbours`, numpy.
    - ``ends`` (B + 1,): rows at which the particles of a scene begin. ``object_ends``: objects.
    """

    shape: Tensor
    normals: Tensor
    owners: Tensor
    kinds: Tensor
    scene: Tensor
    loose: Tensor
    links: Tensor
    floor: Tensor
    size: Tensor
    starts: I64
    scene_array: I64
    moves: NDArray[np.bool_]
    ends: I64
    object_ends: I64

    @property
    def objects(self) -> int:
        """Number of objects K."""
        return len(self.kinds)

    @property
    def scenes(self) -> int:
        """Number of scenes B."""
        return len(self.ends) - 1


@dataclass(frozen=True, eq=False)
class ObjectState:
    """Where the objects of a `SceneLayout` are; float64, metres.

    - ``centers`` (K, 3): means of the particles. ``rotations`` (K, 3, 3): of bodies.
    - ``loose`` (C, 3): particles that move on their own.
    """

    centers: Tensor
    rotations: Tensor
    loose: Tensor

    def positions(self, layout: SceneLayout) -> Tensor:
        """Return the positions of all particles (P, 3)."""
        rotated = (self.rotations[layout.owners] @ layout.shape[..., None])[..., 0]
        return (self.centers[layout.owners] + rotated).index_copy(0, layout.loose, self.loose)

    def detached(self) -> ObjectState:
        """Return this state without gradient."""
        return ObjectState(self.centers.detach(), self.rotations.detach(), self.loose.detach())


def join_scenes(scenes: Sequence[SceneParticles], device: torch.device) -> SceneLayout:
    """Return the layout of several scenes."""
    counts = np.array([len(scene.owners) for scene in scenes], np.int64)
    objects = np.array([len(scene.kinds) for scene in scenes], np.int64)
    ends, object_ends = (np.concatenate([[0], np.cumsum(n)]) for n in (counts, objects))
    owners = np.concatenate(
        [scene.owners + start for scene, start in zip(scenes, object_ends[:-1], strict=True)]
    )
    shape = np.concatenate([scene.shape for scene in scenes])
    kinds = np.concatenate([scene.kinds for scene in scenes])
    links = [scene.links + start for scene, start in zip(scenes, ends[:-1], strict=True)]
    total = len(kinds)

    def tensor(values: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(device)

    scene_array = np.repeat(np.arange(len(scenes)), objects)
    return SceneLayout(
        shape=tensor(shape),
        normals=tensor(np.concatenate([scene.normals for scene in scenes])),
        owners=tensor(owners),
        kinds=tensor(kinds),
        scene=tensor(scene_array),
        loose=tensor(np.flatnonzero(kinds[owners] >= CLOTH)),
        links=tensor(np.concatenate(links, axis=1)),
        floor=tensor(np.repeat([scene.floor for scene in scenes], objects)),
        size=tensor(np.concatenate([scene.sizes for scene in scenes])),
        starts=np.searchsorted(owners, np.arange(total + 1)).astype(np.int64),
        scene_array=scene_array,
        moves=kinds != KINEMATIC,
        ends=ends,
        object_ends=object_ends,
    )


def join_poses(poses: Sequence[Poses], frame: int, device: torch.device) -> ObjectState:
    """Return the state in one row of the motions of several scenes."""
    parts = (
        [motion.centers[frame] for motion in poses],
        [motion.rotations[frame] for motion in poses],
        [motion.loose[frame] for motion in poses],
    )
    centers, rotations, loose = (
        torch.from_numpy(np.concatenate(part)).to(device) for part in parts
    )
    return ObjectState(centers, rotations, loose)


def rotate_scenes(state: ObjectState, layout: SceneLayout, rotations: Tensor) -> ObjectState:
    """Return a state whose scenes rotate about the vertical axis by ``rotations`` (B, 3, 3)."""
    by_object = rotations[layout.scene]
    by_loose = by_object[layout.owners[layout.loose]]
    return ObjectState(
        (by_object @ state.centers[..., None])[..., 0],
        by_object @ state.rotations,
        (by_loose @ state.loose[..., None])[..., 0],
    )


def with_loose(
    layout: SceneLayout, centers: Tensor, rotations: Tensor, loose: Tensor
) -> ObjectState:
    """Return a state in which centres of cloths and free bodies are the means of their particles.

    The other arguments are as in `ObjectState`.
    """
    if len(loose):
        means = mean_by(loose, layout.owners[layout.loose], layout.objects)
        centers = torch.where((layout.kinds >= CLOTH)[:, None], means, centers)
    return ObjectState(centers, rotations, loose)
