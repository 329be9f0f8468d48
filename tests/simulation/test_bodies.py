"""Mass properties of bodies against numerical integration, and against what PyBullet makes of them."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pybullet as bullet
import pytest
from scipy.spatial.transform import Rotation

from hdril.geometry import Pose, geodesic_distance
from hdril.simulation.bodies import BodySpec, Box
from hdril.simulation.world import Physics, World
from hdril.tasks import TASKS, get_task

SKEW = tuple(Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_quat())
BODIES = {
    "box": BodySpec("box", (Box((0.1, 0.2, 0.3), (0.0, 0.0, 0.0)),), mass=1.5),
    "off-centre box": BodySpec("off", (Box((0.1, 0.2, 0.3), (0.3, -0.1, 0.2)),), mass=2.0),
    "turned box": BodySpec("turned", (Box((0.1, 0.2, 0.3), (0.1, 0.0, 0.0), quaternion=SKEW),), mass=2.0),
    "stairs": BodySpec(
        "stairs",
        (Box((0.4, 0.1, 0.1), (0.0, 0.0, 0.0)), Box((0.1, 0.3, 0.1), (0.2, 0.2, 0.1)),
         Box((0.1, 0.1, 0.5), (0.2, 0.3, 0.3), quaternion=SKEW)),
        mass=3.0,
    ),
} | {
    f"{task} {body.name}": body
    for task in (*TASKS, "peg_in_hole:chamfer=0.02") for body in get_task(task).bodies if body.mass > 0
}  # fmt: skip
spec_of_each = pytest.mark.parametrize("spec", BODIES.values(), ids=BODIES)


def integrate(spec: BodySpec) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass (3,) and inertia about it (3, 3), from points: two Gauss points an edge are exact for squares."""
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T / np.sqrt(12.0)
    volumes = [np.prod(box.size) for box in spec.boxes]
    points = np.concatenate([Rotation.from_quat(b.quaternion).apply(corners * b.size) + b.centre for b in spec.boxes])
    masses = np.repeat(spec.mass * np.array(volumes) / sum(volumes) / 8.0, 8)
    com = masses @ points / spec.mass
    arms = points - com
    return com, sum(m * ((r @ r) * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, arms, strict=True))


@spec_of_each
def test_inertia_is_that_of_the_points(spec: BodySpec) -> None:
    com, tensor = integrate(spec)
    np.testing.assert_allclose(spec.centre_of_mass, com, atol=1e-12)
    np.testing.assert_allclose(spec.inertia, tensor, atol=1e-12)


@spec_of_each
def test_principal_axes_diagonalise_the_tensor(spec: BodySpec) -> None:
    com, tensor = integrate(spec)
    frame, moments = spec.inertial_frame
    axes = frame.rotation_matrix()
    np.testing.assert_allclose(frame.position, com, atol=1e-12)
    np.testing.assert_allclose(axes @ np.diag(moments) @ axes.T, tensor, atol=1e-9)


def test_axes_of_a_symmetric_body_are_its_own() -> None:
    (table,) = (body for body in get_task("table_lift").bodies if body.name == "table")
    frame, _ = table.inertial_frame
    assert frame.quaternion.tolist() == [0.0, 0.0, 0.0, 1.0]


def weightless(spec: BodySpec, pose: Pose) -> World:
    world = World(Physics(gravity=0.0))
    world.add_body(spec, pose)
    world._call("changeDynamics", world._ids[spec.name], -1, linearDamping=0.0, angularDamping=0.0)
    return world


@spec_of_each
def test_a_body_is_where_it_was_put(spec: BodySpec) -> None:
    pose = Pose((0.3, -0.2, 0.5), Rotation.from_euler("xyz", [0.3, 0.2, -1.0]).as_quat())
    with closing(weightless(spec, pose)) as world:
        np.testing.assert_allclose(world.pose(spec.name).position, pose.position, atol=1e-9)
        assert geodesic_distance(world.pose(spec.name).quaternion, pose.quaternion) < 1e-7
        shapes = world._call("getCollisionShapeData", world._ids[spec.name], -1)
        base = Pose(*world._call("getBasePositionAndOrientation", world._ids[spec.name]))
        for box, shape in zip(spec.boxes, shapes, strict=True):
            drawn, wanted = base @ Pose(shape[5], shape[6]), pose @ Pose(box.centre, box.quaternion)
            np.testing.assert_allclose(drawn.position, wanted.position, atol=1e-6)
            assert geodesic_distance(drawn.quaternion, wanted.quaternion) < 1e-5


@spec_of_each
@pytest.mark.parametrize("axis", range(3))
def test_a_torque_turns_a_body_as_its_tensor_says(spec: BodySpec, axis: int) -> None:
    """Euler's equation from rest: dw = I^-1 tau dt, in the world's axes."""
    turn = Rotation.from_euler("xyz", [0.3, 0.2, -1.0])
    _, tensor = integrate(spec)
    torque = 0.01 * np.eye(3)[axis]
    with closing(weightless(spec, Pose((0.0, 0.0, 0.0), turn.as_quat()))) as world:
        world._call("applyExternalTorque", world._ids[spec.name], -1, torque.tolist(), bullet.WORLD_FRAME)
        world.step()
        _, spin = world.velocity(spec.name)
        expected = np.linalg.solve(turn.as_matrix() @ tensor @ turn.as_matrix().T, torque) * world.physics.timestep
    np.testing.assert_allclose(spin, expected, rtol=1e-4, atol=1e-4 * np.linalg.norm(expected))


@spec_of_each
def test_angular_momentum_is_kept(spec: BodySpec) -> None:
    """A body that tumbles freely for half a second keeps I w, in the world's axes."""
    _, tensor = integrate(spec)
    with closing(weightless(spec, Pose((0.0, 0.0, 0.0)))) as world:
        world._call("resetBaseVelocity", world._ids[spec.name], [0.0] * 3, [1.0, 0.5, -0.7])

        def momentum() -> np.ndarray:
            rotation = world.pose(spec.name).rotation_matrix()
            return rotation @ tensor @ rotation.T @ world.velocity(spec.name)[1]

        before = momentum()
        world.step(120)
        assert np.linalg.norm(momentum() - before) < 0.01 * np.linalg.norm(before)
