"""The two halves of a table, one with a peg and one with a hole: their boxes, and how far they are joined."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose
from hdril.simulation.bodies import BodySpec, Box
from hdril.tasks.task import Values

LEFT, RIGHT = HALVES = ("left_half", "right_half")
SIGN = {LEFT: 1.0, RIGHT: -1.0}
"""The side of the robot's middle (y = 0) on which a half is."""
DEPTH, WIDTH, TOP, BOARD = 0.35, 0.425, 0.30, 0.06
HANDLE_Y, GRIP_HEIGHT = 0.19, 0.355
PEG_LENGTH, PEG_WIDTH, PEG_HEIGHT, PEG_Z = 0.10, 0.03, 0.09, 0.19
WALL = 0.03
FACE_Z = TOP - BOARD / 2  # where the gap is measured: joined halves sag by 3 degrees, which opens 4 cm at the feet

WOOD, DARK, STEEL = (0.80, 0.62, 0.42, 1.0), (0.45, 0.31, 0.20, 1.0), (0.35, 0.42, 0.50, 1.0)


def scale(values: Values, half: str, axis: str) -> float:
    return values.get(f"size:{half}.{axis}", 1.0)


def width_of(values: Values, half: str) -> float:
    return WIDTH * scale(values, half, "length")


def _table_half(values: Values, half: str) -> tuple[Box, ...]:
    leg, length, depth = TOP - BOARD, scale(values, half, "length"), scale(values, half, "depth")
    leg_x, leg_y, handle_y = 0.13 * depth, 0.17 * length, HANDLE_Y * length
    return (
        Box((DEPTH * depth, WIDTH * length, BOARD), (0.0, 0.0, TOP - BOARD / 2), WOOD),
        *(Box((0.04, 0.04, leg), (x, y, leg / 2), DARK) for x in (-leg_x, leg_x) for y in (-leg_y, leg_y)),
        *(Box((0.08, 0.025, 0.09), (0.0, y, TOP + 0.045), DARK) for y in (-handle_y, handle_y)),
    )


def _peg_half(values: Values) -> tuple[Box, ...]:
    """The left half: a peg sticks out of its face, held by a block under the board."""
    face, block = -width_of(values, LEFT) / 2, 0.08
    return (
        *_table_half(values, LEFT),
        Box((0.10, block, 0.14), (0.0, face + block / 2, TOP - BOARD - 0.07), WOOD),
        Box((PEG_WIDTH, PEG_LENGTH, PEG_HEIGHT), (0.0, face - PEG_LENGTH / 2, PEG_Z), STEEL),
    )


def _hole_half(values: Values, clearance: float, chamfer: float) -> tuple[Box, ...]:
    """The right half: walls under its board leave a hole that is ``clearance`` wider than the peg on each side.

    Above the peg the board itself is the ceiling, 5 mm away, whatever the clearance beyond that.

    With a chamfer the cheeks begin ``chamfer`` behind the face, and plates at 30 degrees lead the peg in between them.
    """
    face, depth = width_of(values, RIGHT) / 2, PEG_LENGTH + 0.02
    half_width, half_height = PEG_WIDTH / 2 + clearance, PEG_HEIGHT / 2 + clearance
    low, high, outer = PEG_Z - half_height, PEG_Z + half_height, 2 * (half_width + WALL)
    boxes = [*_table_half(values, RIGHT), Box((outer, depth, WALL), (0.0, face - depth / 2, low - WALL / 2), WOOD)]
    if high < TOP - BOARD:
        ceiling = TOP - BOARD - high
        boxes.append(Box((outer, depth, ceiling), (0.0, face - depth / 2, high + ceiling / 2), WOOD))
    for sign in (-1.0, 1.0):
        length = depth - chamfer
        boxes.append(
            Box((WALL, length, high - low), (sign * (half_width + WALL / 2), face - depth + length / 2, PEG_Z), WOOD)
        )
        if chamfer > 0.0:
            boxes.append(_lead_in(sign, half_width, high - low, face, chamfer))
    return tuple(boxes)


def _lead_in(sign: float, half_width: float, height: float, face: float, chamfer: float) -> Box:
    """A plate whose inner surface runs from the cheek, ``chamfer`` behind the face, outwards to the face."""
    angle, thickness = np.deg2rad(30.0), 0.008
    turn = Rotation.from_euler("z", -sign * angle)
    inner_edge = np.array((sign * half_width, face - chamfer, PEG_Z))
    length = chamfer / np.cos(angle)
    # From the middle of the inner surface outwards by half the thickness; the outer end stays behind the face.
    middle = inner_edge + turn.apply((sign * thickness / 2, length / 2 - thickness * np.tan(angle) / 2, 0.0))
    x, y, z, w = turn.as_quat().tolist()
    return Box((thickness, length - thickness * np.tan(angle), height), tuple(middle.tolist()), WOOD, (x, y, z, w))


def halves(values: Values, clearance: float, chamfer: float) -> tuple[BodySpec, BodySpec]:
    """The two halves for some values of the factors."""
    boxes = {LEFT: _peg_half(values), RIGHT: _hole_half(values, clearance * values.get("hole", 1.0), chamfer)}
    friction = values.get("friction", 1.0)
    left, right = (BodySpec(half, boxes[half], 2.0 * values.get(f"mass:{half}", 1.0), friction) for half in HALVES)
    return left, right


def gap_between(left: Pose, right: Pose, widths: tuple[float, float]) -> float:
    """The gap, m, along the left half's y axis, at half the board's thickness, for the widths of the halves."""
    left_face, right_face = Pose((0.0, -widths[0] / 2, FACE_Z)), Pose((0.0, widths[1] / 2, FACE_Z))
    return float(((left @ left_face).position - (right @ right_face).position) @ left.rotation_matrix()[:, 1])


def depth_of_peg(left: Pose, right: Pose, widths: tuple[float, float]) -> float:
    tip = Pose((0.0, -widths[0] / 2 - PEG_LENGTH, PEG_Z))
    x, y, z = (right.inverse() @ left @ tip).position
    inside = abs(x) < PEG_WIDTH and abs(z - PEG_Z) < PEG_HEIGHT / 2  # walls are further off than this, or in the way
    return float(max(0.0, widths[1] / 2 - y)) if inside else 0.0
