"""How recordings are laid out in Rerun's viewer."""

from __future__ import annotations

import rerun.blueprint as rrb

from hdril.env import BimanualEnv


def robot_entity(root: str) -> str:
    """Where a player's robot is: at the top, because Rerun's URDF reader takes one part of a path."""
    return f"{root.removesuffix('/')}_robot" if root else "robot"


def _scene_view(env: BimanualEnv, root: str, name: str) -> rrb.Spatial3DView:
    robot = robot_entity(root)
    hidden = f"- /{robot}/{env.robot_spec.name}/collision_geometries/**"
    return rrb.Spatial3DView(
        origin=f"{root}world",
        contents=[f"+ /{root}world/**", f"+ /{robot}/**", hidden],
        name=name,
        eye_controls=rrb.EyeControls3D(position=env.task_spec.camera.eye, look_target=env.task_spec.camera.target),
    )


def blueprint(env: BimanualEnv, players: list[str]) -> rrb.Blueprint:
    if players == [""]:
        return rrb.Blueprint(_alone(env), collapse_panels=True)
    return rrb.Blueprint(rrb.Horizontal(*(_beside(env, player) for player in players)), collapse_panels=True)


def _alone(env: BimanualEnv) -> rrb.Horizontal:
    return rrb.Horizontal(
        rrb.Vertical(
            _scene_view(env, "", env.task),
            rrb.StateTimelineView(origin="primitive", name="Primitives: scripted, predicted, executed"),
            rrb.StateTimelineView(origin="contact", name="Who touches whom"),
            row_shares=[4, 1.45, 1.3],
        ),
        rrb.Vertical(
            rrb.TextDocumentView(origin="summary", name="Outcome"),
            rrb.Tabs(
                rrb.TimeSeriesView(origin="planner", name="Planner's probabilities"),
                rrb.TimeSeriesView(origin="attention", name="Attention received"),
            ),
            rrb.Tabs(
                rrb.TimeSeriesView(origin="from_expert_cm", name="Hand to expert's, cm"),
                rrb.TimeSeriesView(origin="tracking_error_mm", name="Hand to command, mm"),
                rrb.TimeSeriesView(origin="ik_error_mm", name="Inverse kinematics, mm"),
            ),
            rrb.Tabs(
                rrb.TimeSeriesView(origin="grip_force_N", name="Grip, N"),
                rrb.TimeSeriesView(origin="gripper", name="Gripper opening"),
            ),
            rrb.Tabs(
                rrb.TimeSeriesView(origin="progress", name="Stage and measures"),
                rrb.TimeSeriesView(origin="reward", name="Reward"),
            ),
            rrb.TextLogView(origin="log", name="Events"),
        ),
        column_shares=[3, 1],
    )


def _beside(env: BimanualEnv, player: str) -> rrb.Vertical:
    return rrb.Vertical(
        rrb.TextDocumentView(origin=f"{player}/summary", name=f"{player}: outcome"),
        _scene_view(env, f"{player}/", f"{player}: {env.task}"),
        rrb.StateTimelineView(origin=f"{player}/primitive", name=f"{player}: primitives"),
        rrb.Tabs(
            rrb.TimeSeriesView(origin=f"{player}/from_expert_cm", name="Hand to expert's, cm"),
            rrb.TimeSeriesView(origin=f"{player}/planner", name="Planner's probabilities"),
            rrb.TimeSeriesView(origin=f"{player}/grip_force_N", name="Grip, N"),
        ),
        row_shares=[1.2, 4, 1.6, 1.6],
    )
