"""Bodies seen from above: apart, or not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose
from hdril.simulation.bodies import BodySpec, Box
from hdril.tasks.footprint import apart, distance, footprint

SQUARE = Box((0.2, 0.2, 0.1), (0.0, 0.0, 0.05))


def turned(x: float, y: float, degrees: float) -> Pose:
    return Pose((x, y, 0.0), Rotation.from_euler("z", degrees, degrees=True).as_quat())


@pytest.mark.parametrize(
    ("pose", "gap"),
    [
        (turned(0.3, 0.0, 0.0), 0.1),
        (turned(0.0, -0.25, 0.0), 0.05),
        (turned(0.15, 0.1, 0.0), -0.05),
        (turned(0.3, 0.0, 45.0), 0.2 - 0.1 * np.sqrt(2.0)),
        # Of boxes along the axes, these would overlap: only the normal of the turned one tells them apart.
        (turned(0.19, 0.19, 45.0), 0.38 / np.sqrt(2.0) - 0.1 - 0.1 * np.sqrt(2.0)),
    ],
)
def test_distance_of_two_squares(pose: Pose, gap: float) -> None:
    first, second = footprint(SQUARE, Pose((0.0, 0.0, 0.0))), footprint(SQUARE, pose)
    assert distance(first, second) == pytest.approx(gap)
    assert distance(second, first) == pytest.approx(gap)


def test_footprint_has_the_centre_and_turn_of_its_box() -> None:
    box = Box((0.4, 0.02, 0.1), (0.3, 0.0, 0.2), quaternion=tuple(Rotation.from_euler("z", 90, degrees=True).as_quat()))
    points = footprint(box, turned(1.0, 0.0, 90.0))
    assert points.mean(0) == pytest.approx([1.0, 0.3])
    assert np.ptp(points, axis=0) == pytest.approx([0.4, 0.02])


def test_a_body_may_stand_in_the_gap_of_another() -> None:
    """A small box between the legs of a gate: every box is clear of every other, though the bodies' outlines overlap."""
    gate = BodySpec("gate", (Box((0.1, 0.1, 0.3), (0.0, -0.3, 0.15)), Box((0.1, 0.1, 0.3), (0.0, 0.3, 0.15))), 1.0)
    cube = BodySpec("cube", (SQUARE,), 1.0)
    at = Pose((0.5, 0.0, 0.0))
    assert apart(gate, at, cube, at, margin=0.14)
    assert not apart(gate, at, cube, at, margin=0.16)
    assert not apart(gate, at, cube, at.translated((0.0, 0.1, 0.0)), margin=0.06)
