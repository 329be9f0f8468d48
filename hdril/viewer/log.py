"""Episodes as Rerun recordings: the robot, the objects, where the hands were told to go and went, and the primitives."""

from __future__ import annotations

from colorsys import hsv_to_rgb
from functools import lru_cache

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from hdril.evaluation.evaluate import EvaluatedEpisode
from hdril.evaluation.score import in_words
from hdril.simulation.actions import hand_poses, openings
from hdril.simulation.robots.spec import SIDES
from hdril.viewer.blueprint import robot_entity

TIMELINE = "time"
COLOURS = {
    "executed": ((40, 110, 220), (220, 90, 30)),
    "commanded": ((150, 190, 250), (250, 190, 150)),
    "expert": ((120, 200, 120), (120, 200, 120)),
    "plan": ((150, 60, 220), (220, 60, 180)),
}
LANES = ("scripted", "predicted", "executed")  # attributes of a Trace


@lru_cache(maxsize=4)
def _robot_tree(path: str, root: str) -> rr.urdf.UrdfTree:
    """Once a process: reading the URDF takes as long as all the curves of an episode."""
    return rr.urdf.UrdfTree.from_file_path(path, entity_path_prefix=robot_entity(root), frame_prefix=root or None)


class EpisodeLog:
    """One player's entities."""

    def __init__(self, stream: rr.RecordingStream, episode: EvaluatedEpisode, player: str) -> None:
        self._stream, self._env = stream, episode.env
        self._outcome, self._trace, self._reference = episode.outcome, episode.trace, episode.reference
        self._identity = episode.identity
        self._root = f"{player}/" if player else ""
        self._period = self._env.world.physics.control_period
        self._times = np.arange(len(self._trace.state)) * self._period

    def send(self) -> None:
        trace, times = self._trace, self._times
        self._scene()
        self._robot()
        for name, poses in self._moving().items():
            columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, 3:])
            self._stream.send_columns(f"{self._root}world/{name}", _columns(times), columns)
        expert = self._reference.state
        log_hands(self._stream, "executed", trace.state, times, self._root)
        log_hands(self._stream, "commanded", trace.action, times[:-1], self._root)
        log_hands(self._stream, "expert", expert, np.arange(len(expert)) * self._period, self._root)
        for lane in LANES:
            labels, names = getattr(trace, lane), self._env.task_spec.labels
            log_lane(self._stream, f"{self._root}primitive/{lane}", labels, names, times)
        self._explanations()
        self._scalars()
        self._verdict()

    def _moving(self) -> dict[str, NDArray[np.float64]]:
        """Poses (T + 1, 7) of the bodies that are observed or that move, as they were: observations may be late and noisy."""
        objects, poses = self._env.task_spec.objects, self._trace.poses
        return {name: rows for name, rows in poses.items() if name in objects or (rows != rows[0]).any()}

    def _log(self, entity: str, component, static: bool = False) -> None:
        self._stream.log(self._root + entity, component, static=static)

    def _log_at(self, frame: int, entity: str, component) -> None:
        self._stream.set_time(TIMELINE, duration=float(self._times[frame]))
        self._log(entity, component)

    def _curve(self, entity: str, values: NDArray[np.number], at: NDArray[np.floating]) -> None:
        columns = rr.Scalars.columns(scalars=np.asarray(values, dtype=np.float64))
        self._stream.send_columns(self._root + entity, _columns(at), columns)

    def _scene(self) -> None:
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for body in self._env.task_spec.bodies:
            shape = rr.Boxes3D(
                sizes=[box.size for box in body.boxes],
                centers=[box.centre for box in body.boxes],
                quaternions=[box.quaternion for box in body.boxes],
                colors=[[round(255 * c) for c in box.colour] for box in body.boxes],
                fill_mode="solid",
            )
            self._log(f"world/{body.name}/shape", shape, static=True)
            if body.name not in self._moving():
                pose = self._trace.poses[body.name][0]
                place = rr.Transform3D(translation=pose[:3], quaternion=pose[3:])
                self._log(f"world/{body.name}", place, static=True)

    def _robot(self) -> None:
        """The robot as the simulation has it, shapes that collide and no meshes: 16 MB less in every file."""
        spec = self._env.robot_spec
        tree = _robot_tree(str(spec.urdf(False)), self._root)
        tree.log_urdf_to_recording(self._stream)
        place = rr.Transform3D(
            translation=spec.base.position,
            quaternion=spec.base.quaternion.tolist(),
            # The frame that Rerun gives the entity "world"; the robot's own frames hang below it.
            parent_frame=f"tf#/{self._root}world",
            child_frame=f"{self._root}{tree.root_link().name}",
        )
        entity = robot_entity(self._root)
        self._stream.log(f"{entity}/base_in_world", place, static=True)
        for column, name in enumerate(self._env.controller.joint_names):
            joint = tree.get_joint_by_name(name)
            if joint is None:
                raise ValueError(f"{spec.name}'s URDF has no joint {name!r}")
            # A finger that is pressed leaves its limits by a hair: clamping would print a warning for every frame.
            columns = joint.compute_transform_columns(self._trace.joints[:, column].tolist(), clamp=False)
            self._stream.send_columns(f"{entity}/joints/{name}", _columns(self._times), columns)

    def _explanations(self) -> None:
        """The planner's probabilities, who receives the model's attention, and each plan as a trail that fades to its end."""
        explanations = {i: e for i, e in enumerate(self._trace.explanations) if e is not None}
        if not explanations:
            return
        at = self._times[list(explanations)]
        for label, name in enumerate(self._env.task_spec.labels):
            self._curve(f"planner/{name}", np.array([e.probabilities[label] for e in explanations.values()]), at)
        attention = [e.attention for e in explanations.values() if e.attention is not None]
        if len(attention) == len(explanations):
            for name in attention[0]:
                self._curve(f"attention/{name}", np.array([shares[name] for shares in attention]), at)
        for frame, explanation in explanations.items():
            if explanation.plan is None:
                continue
            # A plan leads from where the hands are.
            poses = np.concatenate([hand_poses(self._trace.state[frame : frame + 1]), hand_poses(explanation.plan)])
            fading = np.linspace(255, 50, len(poses) - 1).astype(int)
            for i, side in enumerate(SIDES):
                path = poses[:, i, :3]
                trail = rr.LineStrips3D(
                    np.stack([path[:-1], path[1:]], axis=1).astype(np.float32),
                    colors=[(*COLOURS["plan"][i], alpha) for alpha in fading],
                    radii=[0.007],
                )
                self._log_at(frame, f"world/hands/{side}/plan", trail)
        self._stream.reset_time()

    def _scalars(self) -> None:
        trace, times, expert = self._trace, self._times, self._reference.state
        frames = min(len(trace.state), len(expert))
        gaps = {
            "tracking_error_mm": (1e3, trace.action, trace.state[1:], times[1:]),
            "from_expert_cm": (1e2, trace.state[:frames], expert[:frames], times[:frames]),
        }
        for i, side in enumerate(SIDES):
            for name, (unit, ours, theirs, at) in gaps.items():
                apart = hand_poses(ours)[:, i, :3] - hand_poses(theirs)[:, i, :3]
                self._curve(f"{name}/{side}", unit * np.linalg.norm(apart, axis=-1), at)
            self._curve(f"gripper/{side}/commanded", openings(trace.action)[:, i], times[:-1])
            self._curve(f"gripper/{side}/measured", openings(trace.state)[:, i], times)
            self._curve(f"grip_force_N/{side}", trace.grip_force[:, i], times)
            self._curve(f"ik_error_mm/{side}", 1e3 * trace.ik_error[:, i], times[:-1])
        for pair, touching in trace.contacts.items():
            for frame in np.flatnonzero(np.diff(touching.astype(int), prepend=-1)):
                state = rr.StateChange(state="touch" if touching[frame] else "apart")
                self._log_at(frame, f"contact/{pair.replace(', ', '-')}", state)
        self._stream.reset_time()
        self._curve("reward", trace.reward, times[1:])
        self._curve("progress/stage", trace.stage, times)
        for measure, values in zip(self._env.task_spec.measures, trace.measures.T, strict=True):
            self._curve(f"progress/{measure.name}", values, times)

    def _verdict(self) -> None:
        """Events on the timeline, and the outcome in words."""
        outcome, times = self._outcome, self._times
        for frame, event in outcome.events:
            self._log_at(frame, "log", rr.TextLog(event, level="WARN"))
        for frame, words in outcome.noticed:
            self._log_at(frame, "log", rr.TextLog(words))
        for frame, failure in enumerate(self._trace.ik_failures):
            if failure:
                self._log_at(frame, "log", rr.TextLog(f"no inverse kinematics: {failure}", level="WARN"))
        left = ""
        if outcome.departed_frame >= 0:
            frame = outcome.departed_frame + 1
            where = f"more than 2 cm from the expert's path, in {outcome.departed_in}"
            self._log_at(frame, "log", rr.TextLog(where, level="WARN"))
            left = f"**At {times[frame]:.1f} s first {where}.**\n\n"
        period = self._env.task_spec.physics.control_period
        happened, noticed = in_words(outcome.events, period), in_words(outcome.noticed, period)
        happened = (f"**{happened}.**\n\n" if happened else "") + (f"Noticed: {noticed}.\n\n" if noticed else "")
        verdict = "success" if outcome.success else f"failure: {outcome.unmet}"
        level = "INFO" if outcome.success else "ERROR"
        self._log_at(len(times) - 1, "log", rr.TextLog(verdict, level=level))
        self._stream.reset_time()
        text = (
            f"**{self._env.task}, seed {outcome.seed}: {verdict}**\n\n{left}"
            f"{happened}Played: {' → '.join(outcome.primitives) or 'no primitives'}\n\n"
            f"Mean error against the expert: {outcome.position_error_cm:.2f} cm, {outcome.angle_error_rad:.3f} rad. "
            f"Inverse kinematics failed on {outcome.ik_failures} of {outcome.frames} frames."
        )
        if not outcome.expert_success:
            text += "\n\nThe expert itself fails on this seed: the errors against it say nothing about the policy."
        if self._identity is not None:
            text += f"\n\nPolicy: {self._identity.policy.summary}."
        self._log("summary", rr.TextDocument(text, media_type="text/markdown"), static=True)


def _columns(times: NDArray[np.floating]) -> list[rr.TimeColumn]:
    return [rr.TimeColumn(TIMELINE, duration=times)]


def log_hands(
    stream: rr.RecordingStream, kind: str, rows: NDArray[np.floating], times: NDArray[np.floating], root: str = ""
) -> None:
    """(T, 16) states or actions as the hands' paths, and as points that move along them."""
    poses = hand_poses(rows)
    for i, side in enumerate(SIDES):
        colour, path, hand = COLOURS[kind][i], poses[:, i, :3], f"{root}world/hands/{side}/{kind}"
        radius = 0.002 if kind == "expert" else 0.004
        stream.log(f"{hand}_path", rr.LineStrips3D([path], colors=[colour], radii=[radius]), static=True)
        stream.log(hand, rr.Points3D.from_fields(colors=[colour], radii=[0.012]), static=True)
        columns = rr.Points3D.columns(positions=path).partition([1] * len(path))
        stream.send_columns(hand, _columns(times), columns)


def _distinct_colours(count: int) -> list[tuple[int, int, int]]:
    """Colours around the wheel, neighbours far apart; Rerun's own choice gives some neighbours the same."""
    hues = np.arange(count) * 0.618034 % 1.0
    colours = (hsv_to_rgb(hue, 0.55, 0.8) for hue in hues)
    return [(round(255 * red), round(255 * green), round(255 * blue)) for red, green, blue in colours]


def log_lane(
    stream: rr.RecordingStream,
    entity: str,
    labels: NDArray[np.integer],
    names: tuple[str, ...],
    times: NDArray[np.floating],
) -> None:
    """Labels (T,) as a lane that changes where they do; -1 is nothing. Each label has the same colour in all lanes."""
    stream.log(entity, rr.StateConfiguration(values=names, colors=_distinct_colours(len(names))), static=True)
    for i in np.flatnonzero(np.diff(labels, prepend=-2)):
        if labels[i] >= 0:
            stream.set_time(TIMELINE, duration=float(times[i]))
            stream.log(entity, rr.StateChange(state=names[labels[i]]))
    stream.reset_time()
