"""What every scene has: the bench in front of the robot, its top at z = 0; and the motors of the robot that may stop."""

from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.robots.spec import SIDES
from hdril.tasks.task import fixed

BENCH_HEIGHT = 0.23
BENCH = BodySpec(
    "bench",
    (Box((1.10, 2.20, BENCH_HEIGHT), (0.0, 0.0, -BENCH_HEIGHT / 2), (0.86, 0.87, 0.88, 1.0)),),
    # With 0.5, a table that is pulled at its handles tips before it slides.
    friction=0.3,
    anchored=False,
)
BENCH_PLACEMENT = fixed((0.82, 0.0, 0.0))

ARM_JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in ("s1", "e1", "w1"))
"""One joint each of shoulder, elbow and wrist."""
