"""Bimanual imitation learning for LeRobot: tasks, scripted experts, recording and evaluation.

Frames: everything is expressed in the world frame unless a name says otherwise (x forward from the robot, y to its
left, z up; the bench top is z = 0). Units: m, rad, s, kg, N. Quaternions are (x, y, z, w), unit length.
"""

__version__ = "0.1.0"
