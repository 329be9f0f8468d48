"""Episodes as Rerun recordings: the robot, the objects, where the hands were told to go and went, and the primitives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from hdril.env import BimanualEnv
from hdril.geometry import Pose
from hdril.metrics import hand_poses
from hdril.robots.spec import SIDES

if TYPE_CHECKING:
    from hdril.evaluation import Outcome, Reference, Trace

TIMELINE = "time"
WORLD_FRAME = "tf#/world"  # the frame that Rerun gives the entity "world"; the robot's own frames hang below it
COLOURS = {
    "executed": ((40, 110, 220), (220, 90, 30)),
    "commanded": ((150, 190, 250), (250, 190, 150)),
    "expert": ((120, 200, 120), (120, 200, 120)),
    "plan": ((150, 60, 220), (220, 60, 180)),
}


def recording_name(outcome: Outcome) -> str:
    """Sorts by seed, and says how it ended."""
    return f"seed_{outcome.seed:07d}_{'success' if outcome.success else 'failure'}"


def write_recording(folder: Path, env: BimanualEnv, outcome: Outcome, trace: Trace, reference: Reference) -> Path:
    """Write ``<folder>/<recording_name>.rrd``. Times are seconds from the start of the episode."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{recording_name(outcome)}.rrd"
    with rr.RecordingStream("hdril", recording_id=f"{env.task}-{recording_name(outcome)}") as stream:
        stream.save(path, default_blueprint=_blueprint(env))
        stream.send_recording_name(recording_name(outcome))
        times = np.arange(len(trace.state)) * env.world.physics.control_period
        _log_scene(stream, env)
        _log_robot(stream, env, trace, times)
        for name, poses in zip(
            env.task_spec.observed, trace.environment_state.reshape(len(times), -1, 7).swapaxes(0, 1), strict=True
        ):
            _send_poses(stream, f"world/{name}", poses, times)
        _log_hands(stream, "executed", trace.state, times)
        _log_hands(stream, "commanded", trace.action, times[:-1])
        _log_hands(
            stream, "expert", reference.state, np.arange(len(reference.state)) * env.world.physics.control_period
        )
        _log_primitives(stream, env, trace, times)
        _log_beliefs(stream, env, trace, times)
        _log_scalars(stream, env, outcome, trace, times)
    return path


def _columns(times: NDArray[np.floating]) -> list[rr.TimeColumn]:
    return [rr.TimeColumn(TIMELINE, duration=times)]


def _send_poses(
    stream: rr.RecordingStream, entity: str, poses: NDArray[np.floating], times: NDArray[np.floating]
) -> None:
    """(T, 7) poses in the world as the transform of an entity."""
    columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, 3:])
    stream.send_columns(entity, _columns(times), columns)


def _log_scene(stream: rr.RecordingStream, env: BimanualEnv) -> None:
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for body in env.task_spec.bodies:
        stream.log(
            f"world/{body.name}/shape",
            rr.Boxes3D(
                sizes=[box.size for box in body.boxes],
                centers=[box.centre for box in body.boxes],
                quaternions=[box.quaternion for box in body.boxes],
                colors=[[round(255 * c) for c in box.colour] for box in body.boxes],
                fill_mode="solid",
            ),
            static=True,
        )
        if body.name not in env.task_spec.observed:
            pose = env.world.pose(body.name)
            stream.log(
                f"world/{body.name}",
                rr.Transform3D(translation=pose.position, quaternion=pose.quaternion.tolist()),
                static=True,
            )


def _log_robot(stream: rr.RecordingStream, env: BimanualEnv, trace: Trace, times: NDArray[np.floating]) -> None:
    """The robot as the simulation has it, shapes that collide and no meshes: 16 MB less in every file."""
    spec = env.robot_spec
    tree = rr.urdf.UrdfTree.from_file_path(spec.urdf(False), entity_path_prefix="robot")
    tree.log_urdf_to_recording(stream)
    base: Pose = spec.base
    stream.log(
        "robot/base_in_world",
        rr.Transform3D(
            translation=base.position,
            quaternion=base.quaternion.tolist(),
            parent_frame=WORLD_FRAME,
            child_frame=tree.root_link().name,
        ),
        static=True,
    )
    for column, name in enumerate(env.controller.joint_names):
        joint = tree.get_joint_by_name(name)
        if joint is None:
            raise ValueError(f"{spec.name}'s URDF has no joint {name!r}")
        # A finger that is pressed leaves its limits by a hair: clamping would print a warning for every frame.
        values = trace.joints[:, column].tolist()
        stream.send_columns(
            f"robot/joints/{name}", _columns(times), joint.compute_transform_columns(values, clamp=False)
        )


def _log_hands(stream: rr.RecordingStream, kind: str, rows: NDArray[np.floating], times: NDArray[np.floating]) -> None:
    poses = hand_poses(rows)
    for i, side in enumerate(SIDES):
        colour, path = COLOURS[kind][i], poses[:, i, :3]
        stream.log(
            f"world/hands/{side}/{kind}_path",
            rr.LineStrips3D([path], colors=[colour], radii=[0.0015 if kind == "expert" else 0.002]),
            static=True,
        )
        columns = rr.Points3D.columns(
            positions=path, colors=np.tile(colour, (len(path), 1)), radii=np.full(len(path), 0.012)
        ).partition([1] * len(path))
        stream.send_columns(f"world/hands/{side}/{kind}", _columns(times), columns)


def _log_primitives(stream: rr.RecordingStream, env: BimanualEnv, trace: Trace, times: NDArray[np.floating]) -> None:
    """A lane of the expert's labels and one of the policy's."""
    names = env.task_spec.labels
    for lane, labels in (("scripted", trace.scripted), ("predicted", trace.predicted)):
        for i in np.flatnonzero(np.diff(labels, prepend=-2)):
            if labels[i] >= 0:
                stream.set_time(TIMELINE, duration=float(times[i]))
                stream.log(f"primitive/{lane}", rr.StateChange(state=names[labels[i]]))
    stream.reset_time()


def _send_scalars(
    stream: rr.RecordingStream, entity: str, values: NDArray[np.floating], at: NDArray[np.floating]
) -> None:
    stream.send_columns(entity, _columns(at), rr.Scalars.columns(scalars=np.asarray(values, dtype=np.float64)))


def _log_beliefs(stream: rr.RecordingStream, env: BimanualEnv, trace: Trace, times: NDArray[np.floating]) -> None:
    """The planner's probabilities, who receives the model's attention, and each plan as a trail that fades to its end."""
    frames = [i for i, belief in enumerate(trace.beliefs) if belief is not None]
    beliefs = [belief for belief in trace.beliefs if belief is not None]
    if not beliefs:
        return
    at = times[frames]
    for label, name in enumerate(env.task_spec.labels):
        _send_scalars(stream, f"planner/{name}", np.array([b.probabilities[label] for b in beliefs]), at)
    for name in beliefs[0].attention:
        _send_scalars(stream, f"attention/{name}", np.array([b.attention[name] for b in beliefs]), at)
    for time, belief in zip(at, beliefs, strict=True):
        if belief.plan is None or len(belief.plan) < 2:
            continue
        stream.set_time(TIMELINE, duration=float(time))
        poses = hand_poses(belief.plan)
        fading = np.linspace(255, 50, len(poses) - 1).astype(int)
        for i, side in enumerate(SIDES):
            path = poses[:, i, :3]
            stream.log(
                f"world/hands/{side}/plan",
                rr.LineStrips3D(
                    np.stack([path[:-1], path[1:]], axis=1),
                    colors=[(*COLOURS["plan"][i], alpha) for alpha in fading],
                    radii=[0.004],
                ),
            )
    stream.reset_time()


def _log_scalars(
    stream: rr.RecordingStream, env: BimanualEnv, outcome: Outcome, trace: Trace, times: NDArray[np.floating]
) -> None:
    told, went = hand_poses(trace.action), hand_poses(trace.state[1:])
    for i, side in enumerate(SIDES):
        _send_scalars(
            stream,
            f"tracking_error_mm/{side}",
            1e3 * np.linalg.norm(told[:, i, :3] - went[:, i, :3], axis=-1),
            times[1:],
        )
        _send_scalars(stream, f"gripper/{side}/commanded", trace.action[:, 8 * i + 7], times[:-1])
        _send_scalars(stream, f"gripper/{side}/measured", trace.state[:, 8 * i + 7], times)
        _send_scalars(stream, f"grip_force_N/{side}", trace.grip_force[:, i], times)
        _send_scalars(stream, f"ik_error_mm/{side}", 1e3 * trace.ik_error[:, i], times[:-1])
    for pair, touching in trace.contacts.items():
        entity = f"contact/{pair.replace(', ', '-')}"
        for frame in np.flatnonzero(np.diff(touching.astype(int), prepend=-1)):
            stream.set_time(TIMELINE, duration=float(times[frame]))
            stream.log(entity, rr.StateChange(state="touch" if touching[frame] else "apart"))
    stream.reset_time()
    _send_scalars(stream, "reward", trace.reward, times[1:])
    _send_scalars(stream, "progress/stage", trace.stage, times)
    for measure, values in zip(env.task_spec.measures, trace.measures.T, strict=True):
        _send_scalars(stream, f"progress/{measure.name}", values, times)
    for i, failure in enumerate(trace.ik_failures):
        if failure:
            stream.set_time(TIMELINE, duration=float(times[i]))
            stream.log("log", rr.TextLog(f"no inverse kinematics: {failure}", level="WARN"))
    stream.set_time(TIMELINE, duration=float(times[-1]))
    verdict = "success" if outcome.success else f"failure: {outcome.unmet}"
    stream.log("log", rr.TextLog(verdict, level="INFO" if outcome.success else "ERROR"))
    stream.reset_time()
    stream.log(
        "summary",
        rr.TextDocument(
            f"**{env.task}, seed {outcome.seed}: {verdict}**\n\n"
            f"Played: {' → '.join(outcome.primitives) or 'no primitives'}\n\n"
            f"Mean error against the expert: {outcome.position_error_cm:.2f} cm, {outcome.angle_error_rad:.3f} rad. "
            f"Inverse kinematics failed on {outcome.ik_failures} of {outcome.frames} frames.",
            media_type="text/markdown",
        ),
        static=True,
    )


def _blueprint(env: BimanualEnv) -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(
                    origin="world",
                    contents=["+ /world/**", "+ /robot/**", f"- /robot/{env.robot_spec.name}/collision_geometries/**"],
                    name=env.task,
                    eye_controls=rrb.EyeControls3D(
                        position=env.task_spec.camera.eye, look_target=env.task_spec.camera.target
                    ),
                ),
                rrb.StateTimelineView(origin="primitive", name="Primitives: expert's and policy's"),
                rrb.StateTimelineView(origin="contact", name="Who touches whom"),
                row_shares=[4, 1, 1],
            ),
            rrb.Vertical(
                rrb.TextDocumentView(origin="summary", name="Outcome"),
                rrb.Tabs(
                    rrb.TimeSeriesView(origin="planner", name="Planner's probabilities"),
                    rrb.TimeSeriesView(origin="attention", name="Attention received"),
                ),
                rrb.Tabs(
                    rrb.TimeSeriesView(origin="tracking_error_mm", name="Hand to command, mm"),
                    rrb.TimeSeriesView(origin="ik_error_mm", name="Inverse kinematics, mm"),
                ),
                rrb.Tabs(
                    rrb.TimeSeriesView(origin="grip_force_N", name="Grip, N"),
                    rrb.TimeSeriesView(origin="gripper", name="Gripper opening"),
                ),
                rrb.TimeSeriesView(origin="progress", name="Stage and measures"),
                rrb.TextLogView(origin="log", name="Events"),
            ),
            column_shares=[3, 1],
        ),
        collapse_panels=True,
    )
