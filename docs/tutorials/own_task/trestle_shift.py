"""Trestle shift: two hands lift a trestle by its ends, and set it down on a step."""

import numpy as np
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.world import ROBOT
from hdril.tasks.bench import BENCH, BENCH_PLACEMENT
from hdril.tasks.conditions import Measure, Stage, at_height, at_rest, not_touching, raised, touching, upright
from hdril.tasks.primitives import Grip, extend, grasp, lift, place, retract
from hdril.tasks.task import Task, Uniform, fixed

HEIGHT, HANDLE_Y, STEP_X = 0.30, 0.41, 0.90

# Boxes of one density, in the body's frame: x forward, y left, z up, the origin at the foot. A handle is 2.5 cm thick in y,
# which the jaws close on; the beam is thicker than they open.
TRESTLE = BodySpec(
    "trestle",
    (
        Box((0.12, 0.85, 0.06), (0.0, 0.0, HEIGHT - 0.03)),
        *(Box((0.20, 0.04, HEIGHT - 0.06), (0.0, y, (HEIGHT - 0.06) / 2)) for y in (-0.30, 0.30)),
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


def make_task(height: float = 0.12) -> Task:
    """The task; ``height``, m, is that of the step: ``--task=trestle_shift:height=0.14``.

    Raises:
        ValueError: the step is too low to need two hands, or too high to reach.
    """
    if not 0.10 <= height <= 0.14:
        raise ValueError(f"height must be from 0.10 to 0.14 m, got {height}")
    step = BodySpec("step", (Box((0.30, 0.90, height), (0.0, 0.0, height / 2)),))
    return Task(
        name="trestle_shift",
        description="Lift the trestle with both hands and set it down on the step.",
        bodies=(BENCH, TRESTLE, step),
        placements={
            BENCH.name: BENCH_PLACEMENT,
            "trestle": Uniform((0.50, -0.20, 0.0), (0.60, 0.20, 0.0)),
            "step": fixed((STEP_X, 0.0, 0.0)),
        },
        observed=("trestle",),
        primitives=(
            grasp(GRIPS),
            lift("trestle", height + 0.06),
            extend("trestle", STEP_X, 0.0),
            place("trestle", height),
            retract(),
        ),
        success=(
            upright("trestle"),
            at_height("trestle", height),
            at_rest("trestle"),
            touching("trestle", "step"),
            not_touching("trestle", ROBOT),
        ),
        stages=(Stage("lifted", (raised("trestle", 0.05),)),),
        measures=(Measure("trestle_height_m", lambda world: float(world.pose("trestle").position[2])),),
    )


TASK = make_task()
