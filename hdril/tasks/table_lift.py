"""Table lift (paper, Section 5.2): slide a table to the middle, lift it, and set it down on a platform.

Sizes and start area are the paper's (35 x 85 cm; 20 x 60 cm); mass, handles and platform are ours, chosen so that one
arm cannot do it and the jaws close on nothing but the handles.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.world import ROBOT
from hdril.tasks.bench import BENCH, BENCH_PLACEMENT
from hdril.tasks.conditions import at_height, at_rest, not_touching, touching, upright
from hdril.tasks.primitives import Grip, extend, grasp, lift, move, place, retract
from hdril.tasks.task import Task, Uniform, fixed

DEPTH, WIDTH, TOP = 0.35, 0.85, 0.30
BOARD = 0.06  # thicker than the jaws are wide, so that the board itself cannot be pinched
HANDLE_Y, GRIP_HEIGHT = 0.41, 0.355
PLATFORM_HEIGHT, PLATFORM_X = 0.12, 0.98

WOOD, DARK, STEEL = (0.80, 0.62, 0.42, 1.0), (0.45, 0.31, 0.20, 1.0), (0.35, 0.42, 0.50, 1.0)

TABLE = BodySpec(
    "table",
    (
        Box((DEPTH, WIDTH, BOARD), (0.0, 0.0, TOP - BOARD / 2), WOOD),
        *(
            Box((0.04, 0.04, TOP - BOARD), (x, y, (TOP - BOARD) / 2), DARK)
            for x in (-0.10, 0.10)
            for y in (-0.35, 0.35)
        ),
        *(Box((0.08, 0.025, 0.09), (0.0, y, TOP + 0.045), DARK) for y in (-HANDLE_Y, HANDLE_Y)),
    ),
    # One arm can lift a table of 0.5 kg. Tests check that one arm fails at this mass.
    mass=2.0,
)
PLATFORM = BodySpec("platform", (Box((0.30, 0.90, PLATFORM_HEIGHT), (0.0, 0.0, PLATFORM_HEIGHT / 2), STEEL),))

# Hands pitched 45 degrees, down and forward, jaws across the handles.
_PITCH = Rotation.from_matrix(np.array([[-1, 0, 1], [0, np.sqrt(2), 0], [-1, 0, -1]]) / np.sqrt(2)).as_quat()
GRIPS = {
    side: Grip("table", Pose((0.0, y, GRIP_HEIGHT), _PITCH)) for side, y in (("left", HANDLE_Y), ("right", -HANDLE_Y))
}

TASK = Task(
    name="table_lift",
    description="Lift the table with both hands and set it down upright on the platform.",
    bodies=(BENCH, TABLE, PLATFORM),
    placements={
        BENCH.name: BENCH_PLACEMENT,
        "table": Uniform((0.50, -0.30, 0.0), (0.70, 0.30, 0.0)),
        "platform": fixed((PLATFORM_X, 0.0, 0.0)),
    },
    observed=("table",),
    primitives=(
        grasp(GRIPS),
        move("table", x=0.66, y=0.0),
        lift("table", height=PLATFORM_HEIGHT + 0.06),
        extend("table", x=PLATFORM_X, y=0.0),
        place("table", height=PLATFORM_HEIGHT),
        retract(),
    ),
    success=(
        upright("table"),
        at_height("table", PLATFORM_HEIGHT),
        at_rest("table"),
        touching("table", "platform"),
        not_touching("table", ROBOT),
    ),
)
