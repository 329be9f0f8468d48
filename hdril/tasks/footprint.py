"""Whether bodies made of boxes stand clear of each other, seen from above."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from hdril.geometry import Pose
from hdril.simulation.bodies import BodySpec, Box

_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


def footprint(box: Box, pose: Pose) -> NDArray[np.float64]:
    """Corners (8, 2), m, of a box of a body at ``pose``, seen from above."""
    frame = pose @ Pose(box.centre, box.quaternion)
    return (frame.position + (_CORNERS * box.size) @ frame.rotation_matrix().T)[:, :2]


def distance(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Largest gap, m, between two convex sets of points (n, 2) along the normals of their edges; negative if they overlap.

    The separating-axis theorem: the sets are apart where it is positive. It is never more than their distance, and less only
    where a corner is nearest to a corner.
    """
    normals = np.concatenate([_normals(first), _normals(second)])
    a, b = first @ normals.T, second @ normals.T
    return float(np.maximum(a.min(0) - b.max(0), b.min(0) - a.max(0)).max())


def _normals(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors (m, 2): the normals of the edges of a :func:`footprint`, along its box's x, y and z."""
    edges = points[[4, 2, 1]] - points[0]
    lengths = np.linalg.norm(edges, axis=1)
    edges = edges[lengths > 1e-9] / lengths[lengths > 1e-9, None]
    return np.stack([-edges[:, 1], edges[:, 0]], axis=1)


def apart(first: BodySpec, at: Pose, second: BodySpec, there: Pose, margin: float) -> bool:
    """Whether every box of the first body is at least ``margin``, m, from every box of the second, seen from above."""
    these = [footprint(box, at) for box in first.boxes]
    those = [footprint(box, there) for box in second.boxes]
    near = [(a, b) for a, b in itertools.product(these, those) if _circles(a, b) < margin]
    return all(distance(a, b) >= margin for a, b in near)


def _circles(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Gap, m, between the circles around two footprints: quick to tell, and less than their :func:`distance` may be."""
    a, b = first[0] + first[-1], second[0] + second[-1]  # opposite corners: twice the middles
    radii = math.dist(first[0], first[-1]) + math.dist(second[0], second[-1])
    return 0.5 * (math.dist(a, b) - radii)
