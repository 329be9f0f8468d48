"""The simulated world. This module alone talks to PyBullet; everything else names bodies, links and joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pybullet as bullet
from numpy.typing import NDArray

from hdril.geometry import Pose
from hdril.simulation.bodies import BodySpec, Vector3

ROBOT = "robot"
"""The name under which every world knows its robot."""

_idle: list[int] = []
"""The client of a world that was closed, empty, if there is one. To empty it takes a tenth of the time that a new one takes. One
is enough, because an environment closes its world before it opens the next. Each client keeps 28 MB."""
_STATIC = 2
"""The group of what is immovable, in a collision filter."""
_FIRST_GROUP, _FREE_GROUPS = 6, 25
"""The number of the first bit of a collision filter that Bullet does not use, and how many there are before the sign."""
_BOTH_MASKS = 0
"""Bullet's mode of collision filters in which each of two bodies must let the other one touch it; by default one is enough."""


@dataclass(frozen=True)
class Physics:
    """Settings of the simulator that every body shares.

    30 solver iterations hold a table as well as 50 (pitch and slip over 40 episodes) and are a quarter faster.

    ``substeps`` of ``timestep`` s make one control period: 24 / 240 Hz = 0.1 s. With 8 substeps the arms cannot follow
    the waypoints and three grasps in twenty hold; from 24 on all do.
    """

    timestep: float = 1.0 / 240.0
    substeps: int = 24
    solver_iterations: int = 30
    gravity: float = 9.81

    @property
    def control_period(self) -> float:
        """Seconds between two actions."""
        return self.timestep * self.substeps


@dataclass(frozen=True)
class Contact:
    """One contact point between two bodies: the links that touch, where (world, m), and the normal force (N)."""

    link_a: str
    link_b: str
    position: NDArray[np.float64]
    force: float


@dataclass(frozen=True)
class Camera:
    """A pinhole camera for pictures: eye and target in the world frame, m; vertical field of view in degrees."""

    eye: Vector3 = (2.15, -1.35, 1.30)
    target: Vector3 = (0.52, 0.0, 0.40)
    field_of_view: float = 50.0
    width: int = 320
    height: int = 240


@dataclass
class _Push:
    """A force (3,), N, at a body's centre of mass, for the next ``left`` timesteps."""

    body: int
    force: NDArray[np.float64]
    left: int


@dataclass
class _Slide:
    """A displacement (3,), m, of an immovable body in each of the next ``left`` timesteps."""

    body: int
    step: NDArray[np.float64]
    left: int


class World:
    """A PyBullet world with a robot and bodies, addressed by name.

    Every episode gets a world of its own, built anew, which takes some 30 ms. Restoring a saved state would be
    faster, but after a contact PyBullet restores it with other last digits, and the episode could not be repeated bit for bit.
    Once the world has stepped, only :meth:`step` moves bodies: by its motors, by gravity and contacts, and by the disturbances
    that were declared (:meth:`push`, :meth:`slide`).
    """

    def __init__(self, physics: Physics | None = None) -> None:
        self.physics = physics or Physics()
        try:
            self._client: int = _idle.pop()
        except IndexError:
            self._client = bullet.connect(bullet.DIRECT)
        if self._client < 0:
            raise RuntimeError("PyBullet gave no physics client; too many worlds are open in this process")
        self._ids: dict[str, int] = {}
        self._body_frames: dict[str, Pose] = {}  # of bodies made of boxes, in their inertial frames
        self._placed: dict[str, Pose] = {}
        self._poses: dict[str, Pose] = {}  # as read since the last timestep: several readers ask at every frame
        self._immovable: set[str] = set()
        self._filtered = False  # the free bits of collision filters are given to the links of one body
        self._joints: dict[str, dict[str, int]] = {}
        self._links: dict[str, dict[str, int]] = {}
        self._link_names: dict[int, dict[int, str]] = {}
        self._names: dict[int, str] = {}
        self._began = False
        self._disturbing: list[_Push | _Slide] = []
        self._call("setPhysicsEngineParameter", fixedTimeStep=self.physics.timestep, numSubSteps=0,
                   numSolverIterations=self.physics.solver_iterations, deterministicOverlappingPairs=1,
                   collisionFilterMode=_BOTH_MASKS, enableFileCaching=0)  # fmt: skip
        self._call("setGravity", 0.0, 0.0, -self.physics.gravity)

    def _call(self, function: str, *args: Any, **kwargs: Any) -> Any:
        return getattr(bullet, function)(*args, physicsClientId=self._client, **kwargs)

    def close(self) -> None:
        """Give the client back. Calling it twice does no harm, even if Ctrl-C came in the middle of the first call."""
        client, self._client = self._client, -1
        self._poses.clear()
        if client < 0:
            return
        if _idle:
            bullet.disconnect(client)
        else:
            bullet.resetSimulation(physicsClientId=client)
            _idle.append(client)

    # ------------------------------------------------------------------ building

    def _register(self, name: str, body: int, root_link: str) -> None:
        joints = [self._call("getJointInfo", body, i) for i in range(self._call("getNumJoints", body))]
        self._ids[name], self._names[body] = body, name
        self._joints[name] = {info[1].decode(): info[0] for info in joints}
        self._links[name] = {root_link: -1} | {info[12].decode(): info[0] for info in joints}
        self._link_names[body] = {index: link for link, index in self._links[name].items()}

    def _new(self, name: str) -> None:
        if self._began:
            raise RuntimeError(f"{name!r} cannot be added: the episode has begun")
        if name in self._ids:
            raise ValueError(f"there is already a body named {name!r}; bodies: {', '.join(self._ids)}")

    def add_urdf(self, name: str, path: Path, base: Pose, *, self_collision: bool = False) -> None:
        """Load a robot with a fixed base."""
        self._new(name)
        flags = bullet.URDF_USE_INERTIA_FROM_FILE
        if self_collision:
            flags |= bullet.URDF_USE_SELF_COLLISION
        body = self._call("loadURDF", str(path), base.position, base.quaternion, useFixedBase=1, flags=flags)
        self._register(name, body, self._call("getBodyInfo", body)[0].decode())

    def add_body(self, spec: BodySpec, pose: Pose) -> None:
        """Build a compound body from its boxes and put it at ``pose`` (of the body's frame, not of its centre of mass)."""
        self._new(spec.name)
        inertial, moments = spec.inertial_frame
        # PyBullet's base frame is the inertial one: its origin the centre of mass, its axes the principal ones.
        frames = [inertial.inverse() @ Pose(box.centre, box.quaternion) for box in spec.boxes]
        places, turns = [frame.position.tolist() for frame in frames], [frame.quaternion.tolist() for frame in frames]
        half = [[0.5 * edge for edge in box.size] for box in spec.boxes]
        shapes = {"shapeTypes": [bullet.GEOM_BOX] * len(half), "halfExtents": half}
        collision = self._call("createCollisionShapeArray", collisionFramePositions=places,
                               collisionFrameOrientations=turns, **shapes)  # fmt: skip
        visual = self._call("createVisualShapeArray", visualFramePositions=places, visualFrameOrientations=turns,
                            rgbaColors=[box.colour for box in spec.boxes], **shapes)  # fmt: skip
        at = pose @ inertial
        body = self._call("createMultiBody", spec.mass, collision, visual, at.position, at.quaternion)
        dynamics: dict[str, Any] = {"lateralFriction": spec.friction, "frictionAnchor": int(spec.anchored)}
        if spec.mass > 0:
            # Never asleep: a sleeping body would not feel a slow push.
            dynamics |= {
                "localInertiaDiagonal": moments,
                "activationState": bullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            }
        self._call("changeDynamics", body, -1, **dynamics)
        if spec.mass <= 0:
            self._immovable.add(spec.name)
        self._register(spec.name, body, spec.name)
        self._body_frames[spec.name] = inertial.inverse()
        self._placed[spec.name] = pose

    def set_link_dynamics(self, body: str, links: Sequence[str], **dynamics: Any) -> None:
        """Forward ``dynamics`` (``lateralFriction``, ``frictionAnchor``, …) to the named links."""
        for link in links:
            self._call("changeDynamics", self._id(body), self._link(body, link), **dynamics)

    def set_joint_velocity_limits(self, body: str, limits: dict[str, float]) -> None:
        """Cap joint speeds, rad/s or m/s."""
        for joint, limit in limits.items():
            self._call("changeDynamics", self._id(body), self._joint(body, joint), maxJointVelocity=limit)

    def couple_joints(self, body: str, first: str, second: str, max_force: float) -> None:
        """Gear two joints of one body so that they move by opposite amounts, with at most ``max_force`` (N or Nm)."""
        if self._began:
            raise RuntimeError(f"joints of {body!r} cannot be coupled: the episode has begun")
        gear = self._call("createConstraint", self._id(body), self._joint(body, first), self._id(body),
                          self._joint(body, second), bullet.JOINT_GEAR, (0, 1, 0), (0, 0, 0), (0, 0, 0))  # fmt: skip
        # PyBullet's ratio has the sign of gears that mesh: 1 turns them against each other.
        self._call("changeConstraint", gear, gearRatio=1, relativePositionTarget=0, erp=0.5, maxForce=max_force)

    def ignore_collisions(self, body: str, pairs: Sequence[tuple[str, str]]) -> None:
        """Let the named pairs of links of one body pass through each other."""
        ignored = {index: {index} for index in self._links[self._name(body)].values()}
        indices = [(self._link(body, a), self._link(body, b)) for a, b in pairs]
        for first, second in indices:
            ignored[first].add(second)
            ignored[second].add(first)
        # Links that ignore the same ones share a bit. A filter for each link takes a hundredth of the time of one for each pair.
        alike = list(dict.fromkeys(map(frozenset, ignored.values())))
        bits = {index: 1 << alike.index(frozenset(others)) for index, others in ignored.items()}
        if self._filtered or len(alike) > _FREE_GROUPS:
            for first, second in indices:
                self._call("setCollisionFilterPair", self._id(body), self._id(body), first, second, 0)
            return
        self._filtered = True
        for index, others in ignored.items():
            mask = ~_STATIC if index < 0 else -1  # a fixed base does not touch what is immovable
            for other in others:
                mask &= ~(bits[other] << _FIRST_GROUP)
            self._call("setCollisionFilterGroupMask", self._id(body), index, bits[index] << _FIRST_GROUP, mask)

    def links(self, body: str) -> tuple[str, ...]:
        return tuple(self._links[self._name(body)])

    # ------------------------------------------------------------------ names

    def _name(self, body: str) -> str:
        if body not in self._ids:
            raise KeyError(f"no body {body!r}; bodies: {', '.join(self._ids)}")
        return body

    def _id(self, body: str) -> int:
        return self._ids[self._name(body)]

    def _joint(self, body: str, joint: str) -> int:
        joints = self._joints[self._name(body)]
        if joint not in joints:
            raise KeyError(f"{body} has no joint {joint!r}; joints: {', '.join(joints)}")
        return joints[joint]

    def _link(self, body: str, link: str) -> int:
        links = self._links[self._name(body)]
        if link not in links:
            raise KeyError(f"{body} has no link {link!r}; links: {', '.join(links)}")
        return links[link]

    def joint_indices(self, body: str, joints: Sequence[str]) -> list[int]:
        """Resolve names once; the hot calls below take the result."""
        return [self._joint(body, joint) for joint in joints]

    def reset_joints(self, body: str, joints: Sequence[str], positions: Sequence[float]) -> None:
        """Set joints at rest, rad or m.

        Raises:
            RuntimeError: the episode has begun; nothing is moved by hand then.
        """
        if self._began:
            raise RuntimeError(f"joints of {body!r} cannot be reset: the episode has begun")
        for joint, position in zip(joints, positions, strict=True):
            self._call("resetJointState", self._id(body), self._joint(body, joint), float(position))

    # ------------------------------------------------------------------ stepping and reading

    def step(self, count: int = 1) -> None:
        """Advance by ``count`` timesteps."""
        self._began = True
        self._poses.clear()
        for _ in range(count):
            if self._disturbing:
                self._disturb()
            bullet.stepSimulation(physicsClientId=self._client)

    def push(self, body: str, impulse: Sequence[float], steps: int) -> None:
        """Push a body at its centre of mass during the next ``steps`` timesteps: ``impulse`` (3,), N s, in the world's frame.

        Raises:
            ValueError: the body is immovable.
        """
        if body in self._immovable:
            raise ValueError(f"{body} is immovable and cannot be pushed")
        force = np.asarray(impulse, dtype=np.float64) / (steps * self.physics.timestep)
        self._disturbing.append(_Push(self._id(body), force, steps))

    def slide(self, body: str, offset: Sequence[float], steps: int) -> None:
        """Move an immovable body by ``offset`` (3,), m, in equal parts during the next ``steps`` timesteps.

        Raises:
            ValueError: the body is not immovable.
        """
        if body not in self._immovable:
            raise ValueError(f"{body} is not immovable: only forces move it")
        self._disturbing.append(_Slide(self._id(body), np.asarray(offset, dtype=np.float64) / steps, steps))

    def _disturb(self) -> None:
        for item in self._disturbing:
            position, quaternion = self._call("getBasePositionAndOrientation", item.body)
            if isinstance(item, _Push):
                self._call("applyExternalForce", item.body, -1, item.force, position, bullet.WORLD_FRAME)
            else:
                moved = np.add(position, item.step)
                self._call("resetBasePositionAndOrientation", item.body, moved, quaternion)
            item.left -= 1
        self._disturbing = [item for item in self._disturbing if item.left]

    def drive(
        self,
        body: str,
        indices: Sequence[int],
        positions: Sequence[float],
        gains: Sequence[float],
        forces: Sequence[float],
    ) -> None:
        """Position targets (rad or m) for the motors of the joints at ``indices``, at most ``forces`` (Nm or N)."""
        bullet.setJointMotorControlArray(
            self._ids[body], indices, bullet.POSITION_CONTROL, targetPositions=positions,
            positionGains=gains, forces=forces, physicsClientId=self._client,
        )  # fmt: skip

    def joint_positions(self, body: str, indices: Sequence[int]) -> NDArray[np.float64]:
        """(len(indices),), rad or m."""
        states = bullet.getJointStates(self._ids[body], indices, physicsClientId=self._client)
        return np.array([state[0] for state in states])

    def link_pose(self, body: str, link: str) -> Pose:
        """Frame of a link, as the URDF has it."""
        state = self._call("getLinkState", self._id(body), self._link(body, link), computeForwardKinematics=1)
        return Pose(state[4], state[5])

    def pose(self, body: str) -> Pose:
        """Frame of a body made of boxes."""
        pose = self._poses.get(body)
        if pose is None:
            position, quaternion = self._call("getBasePositionAndOrientation", self._id(body))
            pose = self._poses[body] = Pose(position, quaternion) @ self._body_frames[body]
        return pose

    def placed(self, body: str) -> Pose:
        """Where a body made of boxes was put before the episode began."""
        return self._placed[self._name(body)]

    def velocity(self, body: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Linear (3,), m/s, of the centre of mass, and angular (3,), rad/s."""
        linear, angular = self._call("getBaseVelocity", self._id(body))
        return np.array(linear), np.array(angular)

    def contacts(self, body_a: str, body_b: str) -> list[Contact]:
        """Contact points of the last timestep in which the two bodies touch."""
        a, b = self._id(body_a), self._id(body_b)
        points = self._call("getContactPoints", bodyA=a, bodyB=b)
        return [
            Contact(self._link_names[a][point[3]], self._link_names[b][point[4]], np.array(point[5]), float(point[9]))
            for point in points
            if point[8] <= 0.0  # a positive distance is a contact that is near, but not made
        ]

    def near(self, body_a: str, body_b: str, distance: float) -> bool:
        """Whether some points of the two bodies are no further than ``distance``, m, from each other."""
        return bool(self._call("getClosestPoints", self._id(body_a), self._id(body_b), distance))

    def state_vector(self) -> NDArray[np.float64]:
        """Poses of all bodies, positions and velocities of all joints, in one vector, to compare two runs bit for bit."""
        parts: list[float] = []
        for body in self._ids.values():
            base = self._call("getBasePositionAndOrientation", body)
            parts += [*base[0], *base[1]]
            parts += [value for i in range(self._call("getNumJoints", body)) for value in
                      self._call("getJointState", body, i)[:2]]  # fmt: skip
        return np.array(parts)

    def render(self, camera: Camera) -> NDArray[np.uint8]:
        """(height, width, 3) RGB, drawn on the CPU."""
        view = bullet.computeViewMatrix(camera.eye, camera.target, (0.0, 0.0, 1.0))
        lens = bullet.computeProjectionMatrixFOV(camera.field_of_view, camera.width / camera.height, 0.05, 10.0)
        image = self._call("getCameraImage", camera.width, camera.height, view, lens, lightDirection=(1.5, -1.0, 3.0),
                           shadow=0, flags=bullet.ER_NO_SEGMENTATION_MASK, renderer=bullet.ER_TINY_RENDERER)  # fmt: skip
        return np.ascontiguousarray(np.reshape(image[2], (camera.height, camera.width, 4))[:, :, :3], dtype=np.uint8)
