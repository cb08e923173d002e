"""Rigid motions of objects from the motions of their particles.

Rotations are written as rotation vectors (axis times angle in radians) where they are learned.
The fit of a rotation R and translation t to n pairs of points x -> y with weights w is the least
squares problem

    min sum_i w_i |R x_i + t - y_i|^2

Its solution (Kabsch 1976): with the weighted means x', y' and
H = sum_i w_i (x_i - x') (y_i - y')^T = U S V^T is R = V diag(1, 1, det(V U^T)) U^T, t = y' - R x'.

References
----------
W. Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Crystallographica
A 32, 1976.
M. A. Fischler and R. C. Bolles, Random sample consensus, Communications of the ACM 24, 1981.
"""

from __future__ import annotations

import torch
from torch import Tensor

_SMALL = 1e-12


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians.

    Rodrigues: R = I + a K + b K^2 with K the cross product matrix of the vector, angle t,
    a = sin(t) / t and b = (1 - cos(t)) / t^2.
    """
    squared = vector.pow(2).sum(-1)
    angle = squared.clamp_min(_SMALL).sqrt()
    small = squared < 1e-8
    a = torch.where(small, 1 - squared / 6, angle.sin() / angle)[..., None, None]
    b = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / angle.pow(2))[..., None, None]
    cross = cross_matrix(vector)
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    rotation: Tensor = eye + a * cross + b * (cross @ cross)
    return rotation


def cross_matrix(vector: Tensor) -> Tensor:
    """Return the matrices K (..., 3, 3) with K x = vector x x."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, -1).reshape(*vector.shape[:-1], 3, 3)


def vector_from_rotation(rotation: Tensor) -> Tensor:
    """Return rotation vectors (..., 3) of rotation matrices (..., 3, 3), angles in 0..pi.

    The angle t is atan2(|s|, (trace - 1) / 2) with s the axial vector of (R - R^T) / 2, whose
    length is sin(t) and whose direction is the axis. Where sin(t) vanishes with t near pi, the axis
    is the longest column of (R + I) / 2, which is the projection on it.
    """
    axial = torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        -1,
    )
    sine = axial / 2
    length = sine.pow(2).sum(-1).clamp_min(_SMALL).sqrt()
    cosine = (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angle = torch.atan2(length, cosine)
    factor = torch.where(length < 1e-5, torch.ones_like(length), angle / length)
    vector = sine * factor[..., None]
    halfway = (length < 1e-4) & (cosine < 0)
    if bool(halfway.any()):
        eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
        columns = ((rotation[halfway] + eye) / 2).transpose(-1, -2)
        rows = columns.pow(2).sum(-1).argmax(-1)
        axis = columns[torch.arange(len(rows), device=rows.device), rows]
        axis = axis / axis.norm(dim=-1, keepdim=True)
        sign = torch.where((axis * sine[halfway]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        vector = vector.clone()
        vector[halfway] = sign * axis * angle[halfway][..., None]
    return vector


def sum_by(values: Tensor, group: Tensor, count: int) -> Tensor:
    """Return the sums (count, ...) of the rows of ``values`` (n, ...) with each group (n,)."""
    return values.new_zeros(count, *values.shape[1:]).index_add(0, group, values)


def mean_by(values: Tensor, group: Tensor, count: int) -> Tensor:
    """Return the means (count, ...) of the rows of each group; 0 for a group without rows."""
    rows = torch.bincount(group, minlength=count).clamp_min(1).to(values.dtype)
    return sum_by(values, group, count) / rows.reshape(-1, *[1] * (values.ndim - 1))


def fit_rigid(
    shape: Tensor, points: Tensor, owners: Tensor, count: int, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the rotations (K, 3, 3) and translations (K, 3) that fit shapes to points best.

    Parameters
    ----------
    shape, points : (P, 3)
        Points of the objects at rest, and where they are, metres.
    owners : (P,)
        Object of each point, 0..K-1.
    count : int
        K.
    weights : (P,), optional
        Not negative; by default 1.

    Notes
    -----
    An object of one or two points, or of points on a line, has more than one best rotation; one of
    them is returned.
    """
    weight = torch.ones_like(points[:, 0]) if weights is None else weights
    total = sum_by(weight, owners, count).clamp_min(_SMALL)[:, None]
    start = sum_by(weight[:, None] * shape, owners, count) / total
    goal = sum_by(weight[:, None] * points, owners, count) / total
    a, b = shape - start[owners], points - goal[owners]
    spread = sum_by(weight[:, None, None] * a[:, :, None] * b[:, None, :], owners, count)
    rotation = _best_rotation(spread)
    return rotation, goal - (rotation @ start[..., None])[..., 0]


def _best_rotation(spread: Tensor) -> Tensor:
    """Return the rotation of Kabsch for matrices H (..., 3, 3)."""
    u, _, vh = torch.linalg.svd(spread)
    v, ut = vh.transpose(-1, -2), u.transpose(-1, -2)
    sign = torch.det(v @ ut)
    scale = torch.ones_like(spread[..., 0])
    scale[..., 2] = torch.where(sign < 0, -1.0, 1.0).to(spread.dtype)
    rotation: Tensor = (v * scale[..., None, :]) @ ut
    return rotation


def fit_robust(
    shape: Tensor,
    points: Tensor,
    owners: Tensor,
    count: int,
    tolerance: float,
    draws: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit a rigid motion to the particles of each object that agree with one another (RANSAC).

    Every hypothesis is fitted to four particles of each object; its inliers are the particles that
    it puts within ``tolerance`` of where they are. The one with most inliers, among them the fit to
    all particles, is fitted again to its inliers.

    Parameters
    ----------
    shape, points, owners, count
        As `fit_rigid`.
    tolerance : float
        Metres.
    draws : (hypotheses, 4)
        Random numbers in 0..1 that choose the particles. They are the same for every object, so
        that the fit of one does not depend on the others.

    Returns
    -------
    rotation, translation, inliers
        (K, 3, 3), (K, 3), and which particles (P,) are inliers.
    """
    numbers = torch.bincount(owners, minlength=count)
    starts = torch.cumsum(numbers, 0) - numbers
    rotation, shift = fit_rigid(shape, points, owners, count)

    def agree(rotation: Tensor, shift: Tensor) -> Tensor:
        put = (rotation[owners] @ shape[..., None])[..., 0] + shift[owners]
        return (put - points).pow(2).sum(-1) <= tolerance**2

    inliers = agree(rotation, shift)
    votes = sum_by(inliers.to(points.dtype), owners, count)
    for draw in draws:
        rows = starts[:, None] + (draw * numbers[:, None]).long().clamp_max(
            (numbers - 1).clamp_min(0)[:, None]
        )
        own = torch.arange(count, device=points.device).repeat_interleave(4)
        tried, moved = fit_rigid(shape[rows].flatten(0, 1), points[rows].flatten(0, 1), own, count)
        found = agree(tried, moved)
        number = sum_by(found.to(points.dtype), owners, count)
        better = number > votes
        votes = torch.where(better, number, votes)
        inliers = torch.where(better[owners], found, inliers)
    # An object without inliers keeps all its particles.
    inliers = inliers | (votes < 3)[owners]
    rotation, shift = fit_rigid(shape, points, owners, count, inliers.to(points.dtype))
    return rotation, shift, inliers
