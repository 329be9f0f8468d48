"""Trestle shift: two hands lift a trestle by its ends, and set it down in the middle of the bench."""

import numpy as np
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.world import ROBOT
from hdril.tasks.bench import BENCH, BENCH_PLACEMENT
from hdril.tasks.conditions import Measure, Stage, at_height, at_rest, lies_at, not_touching, raised, upright
from hdril.tasks.primitives import Grip, extend, grasp, lift, place, retract
from hdril.tasks.task import Task, Uniform

HEIGHT, HANDLE_Y = 0.30, 0.41

# Boxes of one density, in the body's frame: x forward, y left, z up, the origin at the foot. A handle is 2.5 cm thick in y,
# which the jaws close on; the beam is thicker than they open.
TRESTLE = BodySpec(
    "trestle",
    (
        Box((0.12, 0.85, 0.06), (0.0, 0.0, HEIGHT - 0.03)),
        *(Box((0.30, 0.04, HEIGHT - 0.06), (0.0, y, (HEIGHT - 0.06) / 2)) for y in (-0.30, 0.30)),
        *(Box((0.08, 0.025, 0.09), (0.0, y, HEIGHT + 0.045)) for y in (-HANDLE_Y, HANDLE_Y)),
    ),
    mass=2.5,
)

# A grip is a pose of the tool in the body's frame: z is the direction in which the hand approaches, here forward and down.
APPROACH = Rotation.from_matrix(np.array([[-1, 0, 1], [0, np.sqrt(2), 0], [-1, 0, -1]]) / np.sqrt(2)).as_quat()
GRIPS = {
    "left": Grip("trestle", Pose((0.0, HANDLE_Y, HEIGHT + 0.055), APPROACH)),
    "right": Grip("trestle", Pose((0.0, -HANDLE_Y, HEIGHT + 0.055), APPROACH)),
}


def make_task(x: float = 0.75) -> Task:
    """The task; ``x``, m, is where the trestle is to stand: ``--task=trestle_shift:x=0.8``.

    Raises:
        ValueError: the place is out of reach.
    """
    if not 0.65 <= x <= 0.85:
        raise ValueError(f"x must be from 0.65 to 0.85 m, got {x}")
    return Task(
        name="trestle_shift",
        description="Lift the trestle with both hands and set it down in the middle of the bench.",
        bodies=(BENCH, TRESTLE),
        placements={BENCH.name: BENCH_PLACEMENT, "trestle": Uniform((0.52, -0.20, 0.0), (0.66, 0.20, 0.0))},
        observed=("trestle",),
        primitives=(grasp(GRIPS), lift("trestle", 0.08), extend("trestle", x, 0.0), place("trestle", 0.0), retract()),
        success=(
            upright("trestle"),
            at_height("trestle", 0.0),
            at_rest("trestle"),
            lies_at("trestle", "x", x, tolerance=0.02),
            lies_at("trestle", "y", 0.0, tolerance=0.02),
            not_touching("trestle", ROBOT),
        ),
        stages=(Stage("lifted", (raised("trestle", 0.05),)),),
        measures=(Measure("trestle_height_m", lambda world: float(world.pose("trestle").position[2])),),
    )


TASK = make_task()
