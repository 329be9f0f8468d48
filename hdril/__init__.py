"""Bimanual imitation learning for LeRobot: tasks, scripted experts, recording and evaluation.

Importing this package registers every task with Gymnasium: ``gymnasium.make("hdril/TableLift-v0")``.

Frames: everything is expressed in the world frame unless a name says otherwise (x forward from the robot, y to its
left, z up; the bench top is z = 0). Units: m, rad, s, kg, N. Quaternions are (x, y, z, w), unit length.
"""

import gymnasium

__version__ = "0.1.0"  # before the imports below, which read it

from hdril.tasks import TASKS
from hdril.tasks.task import gym_id

for _name in TASKS:
    gymnasium.register(id=gym_id(_name), entry_point="hdril.env:BimanualEnv", kwargs={"task": _name})
