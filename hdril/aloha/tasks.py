"""The two tasks as data: what is in them, and what their scripted experts do."""

from __future__ import annotations

from dataclasses import dataclass

from hdril.geometry import POSE_AXES

START, MEETING = "start", "meeting"
"""Anchors of waypoints beside the objects: where the hand is told to be at first, and the point where both hands meet."""
STARTS = {"left": (-0.31718881, 0.5, 0.29525084), "right": (0.31718881, 0.49999888, 0.29525084)}
"""Where gym-aloha tells the hands to be at first, m."""


@dataclass(frozen=True)
class Waypoint:
    """Where a hand is told to be at a control step (50 in a second).

    ``offset`` (3,), m, is from the position of the ``anchor`` at the start of the episode: an object, :data:`START` or
    :data:`MEETING`. The orientation is a turn by ``degrees`` about the world's ``axis``.
    """

    step: int
    anchor: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    opening: float = 0.0
    degrees: float = 0.0
    axis: str = "y"


@dataclass(frozen=True)
class AlohaTask:
    """A task of gym-aloha with its scripted expert."""

    name: str
    description: str
    model: str
    """File of the model among gym-aloha's assets."""
    rules: str
    """Class of control and reward in ``gym_aloha.tasks.sim_end_effector``."""
    places: str
    """Function of ``gym_aloha.utils`` that draws the places of the objects from a seed."""
    objects: tuple[str, ...]
    """Names of the objects, in the order of their joints in the model."""
    meeting: tuple[float, float, float]
    """m."""
    script: dict[str, tuple[Waypoint, ...]]
    """Waypoints by hand; between them the hand moves evenly."""
    phases: dict[str, int]
    """The primitives in order, each with the control step at which it is over."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the primitives."""
        return tuple(self.phases)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the numbers of ``observation.environment_state``."""
        return tuple(f"{name}.{axis}" for name in self.objects for axis in POSE_AXES)


# Steps, offsets, turns and openings are those of ACT's scripted policies (github.com/tonyzhaozh/act, scripted_policy.py, commit
# ab1b06b: PickAndTransferPolicy and InsertionPolicy). Every step is a multiple of 5, so at 10 Hz no waypoint is missed. The
# phases are ours: they end where the script changes what a hand does.
TRANSFER_CUBE = AlohaTask(
    name="transfer_cube",
    description="Pick the cube up with the right hand and hand it over to the left one.",
    model="bimanual_viperx_end_effector_transfer_cube.xml",
    rules="TransferCubeEndEffectorTask",
    places="sample_box_pose",
    objects=("cube",),
    meeting=(0.0, 0.5, 0.25),
    script={
        "left": (
            Waypoint(0, START),
            Waypoint(100, MEETING, (-0.1, 0.0, -0.02), 1.0, 90.0, "x"),
            Waypoint(260, MEETING, (0.02, 0.0, -0.02), 1.0, 90.0, "x"),
            Waypoint(310, MEETING, (0.02, 0.0, -0.02), 0.0, 90.0, "x"),
            Waypoint(360, MEETING, (-0.1, 0.0, -0.02)),
            Waypoint(400, MEETING, (-0.1, 0.0, -0.02)),
        ),
        "right": (
            Waypoint(0, START),
            Waypoint(90, "cube", (0.0, 0.0, 0.08), 1.0, -60.0),
            Waypoint(130, "cube", (0.0, 0.0, -0.015), 1.0, -60.0),
            Waypoint(170, "cube", (0.0, 0.0, -0.015), 0.0, -60.0),
            Waypoint(200, MEETING, (0.05, 0.0, 0.0), 0.0, -60.0),
            Waypoint(220, MEETING, (0.0, 0.0, 0.0), 0.0, -60.0),
            Waypoint(310, MEETING, (0.0, 0.0, 0.0), 1.0, -60.0),
            Waypoint(360, MEETING, (0.1, 0.0, 0.0), 1.0, -60.0),
            Waypoint(400, MEETING, (0.1, 0.0, 0.0), 1.0, -60.0),
        ),
    },
    phases={"approach": 90, "grasp": 170, "lift": 220, "hand over": 310, "retreat": 400},
)
INSERTION = AlohaTask(
    name="insertion",
    description="Pick up the socket with the left hand and the peg with the right one, and insert the peg.",
    model="bimanual_viperx_end_effector_insertion.xml",
    rules="InsertionEndEffectorTask",
    places="sample_insertion_pose",
    objects=("peg", "socket"),
    meeting=(0.0, 0.5, 0.15),
    script={
        "left": (
            Waypoint(0, START),
            Waypoint(120, "socket", (0.0, 0.0, 0.08), 1.0, 60.0),
            Waypoint(170, "socket", (0.0, 0.0, -0.03), 1.0, 60.0),
            Waypoint(220, "socket", (0.0, 0.0, -0.03), 0.0, 60.0),
            Waypoint(285, MEETING, (-0.1, 0.0, 0.0), 0.0, 60.0),
            Waypoint(340, MEETING, (-0.05, 0.0, 0.0), 0.0, 60.0),
            Waypoint(400, MEETING, (-0.05, 0.0, 0.0), 0.0, 60.0),
        ),
        "right": (
            Waypoint(0, START),
            Waypoint(120, "peg", (0.0, 0.0, 0.08), 1.0, -60.0),
            Waypoint(170, "peg", (0.0, 0.0, -0.03), 1.0, -60.0),
            Waypoint(220, "peg", (0.0, 0.0, -0.03), 0.0, -60.0),
            Waypoint(285, MEETING, (0.1, 0.0, 0.00715), 0.0, -60.0),
            Waypoint(340, MEETING, (0.05, 0.0, 0.00715), 0.0, -60.0),
            Waypoint(400, MEETING, (0.05, 0.0, 0.00715), 0.0, -60.0),
        ),
    },
    phases={"approach": 120, "grasp": 220, "align": 285, "insert": 400},
)
TASKS = {task.name: task for task in (TRANSFER_CUBE, INSERTION)}


def find_task(name: str) -> AlohaTask:
    """The task of that name.

    Raises:
        ValueError: there is none; lists the names.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; choose from: {', '.join(TASKS)}")
    return TASKS[name]
