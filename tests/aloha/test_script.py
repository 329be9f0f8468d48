"""The scripts, and what happens without gym-aloha: no extra is needed here."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env

from hdril.aloha import record
from hdril.aloha.env import AlohaPosesEnv
from hdril.aloha.expert import script
from hdril.aloha.lerobot_env import AlohaPosesConfig
from hdril.aloha.physics import MissingExtraError
from hdril.aloha.tasks import MEETING, START, TASKS, AlohaTask
from hdril.geometry import POSE_AXES, geodesic_distance
from hdril.simulation.actions import hand_poses, openings
from hdril.simulation.robots.spec import SIDES

each_task = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)


def somewhere(task: AlohaTask, shift: float = 0.0) -> dict[str, np.ndarray]:
    """A first observation; only the objects count."""
    poses = np.tile([0.12 + shift, 0.5 - shift, 0.05, 0.0, 0.0, 0.0, 1.0], (len(task.objects), 1))
    poses[1:, 0] *= -1.0
    return {"agent_pos": np.zeros(16, np.float32), "environment_state": poses.ravel().astype(np.float32)}


@each_task
def test_a_script_is_sound(task: AlohaTask) -> None:
    assert set(task.script) == set(SIDES)
    for points in task.script.values():
        steps = [point.step for point in points]
        assert steps[0] == 0
        assert steps[-1] == 400
        assert steps == sorted(set(steps))
        assert not any(step % 5 for step in steps)
        assert {point.anchor for point in points} <= {START, MEETING, *task.objects}
    ends = list(task.phases.values())
    assert ends == sorted(set(ends))
    assert ends[-1] == 400


@each_task
def test_every_waypoint_is_commanded_when_it_is_due(task: AlohaTask) -> None:
    seen = somewhere(task)
    actions, _ = script(task, seen)
    objects = seen["environment_state"].reshape(-1, len(POSE_AXES))
    anchors = dict(zip(task.objects, objects[:, :3], strict=True)) | {MEETING: np.array(task.meeting)}
    for index, side in enumerate(SIDES):
        for point in task.script[side][1:]:
            frame = point.step // 5 - 1
            pose = hand_poses(actions)[frame, index]
            np.testing.assert_allclose(pose[:3], anchors[point.anchor] + point.offset, atol=1e-6)
            assert openings(actions)[frame, index] == pytest.approx(point.opening, abs=1e-6)
            turned = geodesic_distance(pose[3:], [0.0, 0.0, 0.0, 1.0])
            assert np.degrees(turned) == pytest.approx(abs(point.degrees), abs=1e-3)
            assert np.sign(pose["xyz".index(point.axis) + 3]) == np.sign(point.degrees)


@each_task
def test_the_grasp_follows_its_object_and_the_meeting_does_not(task: AlohaTask) -> None:
    (before, _), (after, _) = script(task, somewhere(task)), script(task, somewhere(task, 0.04))
    moved = np.linalg.norm(hand_poses(after)[..., :3] - hand_poses(before)[..., :3], axis=-1)  # (80, 2)
    grasp = list(task.phases.values())[1] // 5 - 1
    assert moved[grasp, 1] == pytest.approx(np.hypot(0.04, 0.04), abs=1e-6)
    assert moved[-1].max() < 1e-6


@each_task
def test_each_primitive_is_one_stretch_in_its_order(task: AlohaTask) -> None:
    _, labels = script(task, somewhere(task))
    assert len(labels) == 80
    assert np.unique(labels).tolist() == list(range(len(task.labels)))
    assert (np.diff(labels) >= 0).all()
    ends = np.flatnonzero(np.diff(labels, append=len(task.labels))) + 1
    assert (5 * ends).tolist() == list(task.phases.values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task=chess"], "unknown task 'chess'; choose from: transfer_cube, insertion"),
        (["--num_episodes=0"], "num_episodes must be at least 1, got 0"),
        (["--seed=-1"], "seed must be from 0 to "),
        ([], "this needs gym-aloha, the extra aloha of hdril: pip install -e '.[aloha]'"),
    ],
)
def test_refusals_are_one_line(arguments: list[str], message: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "gym_aloha", None)
    monkeypatch.setattr(sys, "argv", ["record", *arguments, f"--root={tmp_path / 'out'}"])
    with pytest.raises(SystemExit) as caught:
        record.main()
    assert caught.value.code == 2
    text = capsys.readouterr().err
    last = text.strip().splitlines()[-1]
    assert last.startswith("python -m hdril.aloha.record: error: ")
    assert message in last
    assert "Traceback" not in text
    assert not list(tmp_path.iterdir())


def test_an_existing_folder_is_refused(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["record", f"--root={tmp_path}"])
    with pytest.raises(SystemExit):
        record.main()
    assert f"{tmp_path} exists; choose another root or delete it" in capsys.readouterr().err


def test_without_the_extra_an_environment_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gym_aloha", None)
    with pytest.raises(MissingExtraError, match=r"pip install -e '\.\[aloha\]'"):
        AlohaPosesEnv()
    with pytest.raises(MissingExtraError):
        make_env(AlohaPosesConfig())


def test_the_policy_brings_the_environment_type_and_not_the_simulator() -> None:
    program = (
        "import sys, lerobot_policy_hdril; from lerobot.envs.configs import EnvConfig; "
        "EnvConfig.get_choice_class('aloha_poses'); "
        "print(*({'gym_aloha', 'dm_control', 'mujoco'} & set(sys.modules)))"
    )
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert loaded.splitlines()[-1] == ""


def test_unknown_choices_are_named() -> None:
    assert EnvConfig.get_choice_class("aloha_poses") is AlohaPosesConfig
    with pytest.raises(ValueError, match="unknown task 'chess'; choose from: transfer_cube, insertion"):
        make_env(AlohaPosesConfig(task="chess"))
    with pytest.raises(ValueError, match="unknown render mode 'human'; choose from: rgb_array"):
        AlohaPosesEnv(render_mode="human")
