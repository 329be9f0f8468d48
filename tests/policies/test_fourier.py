"""Fused maps that bend with where an object stands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot_policy_hdril import HDRILConfig
from lerobot_policy_hdril.dynamics import solve_ridge
from lerobot_policy_hdril.fourier import REACH, SPREAD, TURN, FourierFeatures
from lerobot_policy_hdril.fusion import BENDS, RIDGES, SHUT_OUT, FusedMaps, ObjectFrames
from torch import Tensor
from torch.nn import functional as F

from tests.policies.test_checkpoint import load, without
from tests.policies.test_reactive import ACTION, CUP, SHELF, SHRINKAGE, STATE, at_cup, generator, scenes
from tests.policies.tools import FRAMES, build, edit, observation, read

OBJECTS = [*CUP, *SHELF, "cup.size"]
SIZE = STATE.index("cup.size")


def features(count: int) -> FourierFeatures:
    """Of cup and shelf."""
    made = ObjectFrames(STATE, OBJECTS, ACTION, 1, count).double().fourier
    assert made is not None
    return made


@pytest.mark.parametrize(
    ("name", "scale", "objects"), [("cup.x", REACH, [0]), ("shelf.qz", TURN, [1]), ("cup.size", SPREAD * 0.3, [0, 1])]
)
def test_the_features_of_two_states_agree_as_a_gaussian_of_their_distance_says(
    name: str, scale: float, objects: list[int]
) -> None:
    made, states = features(4000), scenes(1, 5).repeat(3, 1)
    states[:, SIZE] = torch.tensor([0.0, 0.6, 0.3], dtype=torch.float64)
    made.fit(states[:2], 0.01)  # its deviation is 0.3
    states[:, SIZE] = 0.1
    states[1, STATE.index(name)] += scale
    states[2, STATE.index(name)] += 3.0 * scale
    seen = made(states).unflatten(1, (2, -1))
    for k in range(2):
        near, far = (float((seen[0, k] * seen[i, k]).sum()) for i in (1, 2))
        expected = (0.607, 0.011) if k in objects else (1.0, 1.0)
        assert (near / 32.0, far / 32.0) == pytest.approx(expected, abs=0.08)


def test_a_pose_has_the_same_features_whatever_the_sign_of_its_quaternion() -> None:
    made, states = features(8), scenes(5, 6)
    other = states.clone()
    other[:, 10:14] *= -1.0
    torch.testing.assert_close(made(other), made(states))


def test_the_hand_and_its_opening_are_not_among_them() -> None:
    frames = ObjectFrames([*STATE, "left_gripper.pos"], OBJECTS, ACTION, 1, 8).double()
    states = torch.cat([scenes(5, 7), torch.rand(5, 1).double()], dim=-1)
    other = states.clone()
    other[:, :7], other[:, -1] = scenes(5, 8)[:, :7], 0.0
    assert frames.fourier is not None
    torch.testing.assert_close(frames.fourier(other), frames.fourier(states))


def test_mixed_precision_does_not_touch_them() -> None:
    made, states = features(32).float(), scenes(20, 11).float()
    with torch.autocast("cpu", torch.bfloat16):
        coarse = made(states)
    assert torch.equal(coarse, made(states))


def test_a_size_that_hardly_varies_does_not_count() -> None:
    made, states = features(8), scenes(50, 9)
    states[:, SIZE] = 0.3 + 1e-6 * torch.rand(50, generator=generator(1), dtype=torch.float64)
    made.fit(states, 0.01)
    same = states.clone()
    same[:, SIZE] = 0.3
    torch.testing.assert_close(made(same), made(states), atol=1e-3, rtol=0)


def test_more_features_are_no_other_kernel() -> None:
    states = scenes(2, 12)
    sizes = [float(features(count)(states).square().sum(-1).mean()) for count in (64, 4096)]
    assert sizes == pytest.approx([64.0, 64.0], rel=0.2)  # of two objects


def told(count: int, fourier: int, straight: bool, seed: int = 2) -> tuple[Tensor, Tensor]:
    """Where maps of ``count`` demonstrations send the hand in 200 other scenes, and where it belongs: beside the cup and,
    unless the way is straight, further to the side of a cup that is far away."""
    train, test = scenes(count, seed), scenes(200, 3)
    for states in (train, test):
        states[:, 7:10] *= 0.4
        states[:, 10:14] = torch.tensor([0.0, 0.0, 0.0, 1.0])

    def action(states: Tensor) -> Tensor:
        goal = at_cup(states)
        goal[:, 1] += (0.0 if straight else 1.0) * (states[:, 7] - 0.2).clamp_min(0.0)
        return torch.cat([goal, states[:, -1:]], dim=-1)[:, None]

    frames = ObjectFrames(STATE, OBJECTS, ACTION, 1, fourier).double()
    maps = FusedMaps(frames, 1, 1).double()
    if frames.fourier is not None:
        frames.fourier.fit(train, 0.01)

    def see(states: Tensor) -> Tensor:
        plain = (frames.features(states[:, None]) - mean) / std
        return plain if frames.fourier is None else torch.cat([plain, frames.fourier(states)], dim=-1)

    mean = frames.features(train[:, None]).mean(0)
    std = frames.features(train[:, None]).std(0).clamp_min(0.01)
    start, mask = torch.zeros(count, dtype=torch.long), torch.ones(count, 1, dtype=torch.bool)
    noisy = action(train)
    noisy[..., :3] += 0.003 * torch.randn(count, 1, 3, generator=generator(seed), dtype=torch.float64)
    noise, ridges = torch.zeros(frames.width, frames.width), [(*ridge, 300.0) for ridge in RIDGES]
    maps.fit(see(train), start, frames, train[:, None], noisy, mask, ridges, False, noise, SHRINKAGE)
    origins = frames.origins(test[:, None])
    place = maps(see(test), torch.zeros(200, dtype=torch.long), frames, origins)[:, 0, :3]
    return place, action(test)[:, 0, :3]


def off(count: int, fourier: int, straight: bool) -> float:
    """By how much, in the mean, m."""
    place, goal = told(count, fourier, straight)
    return float((place - goal).norm(dim=-1).mean())


def test_maps_bend_with_where_an_object_stands() -> None:
    assert off(400, 32, straight=False) < 0.6 * off(400, 0, straight=False)


def test_each_frame_bends_by_its_own_errors() -> None:
    """Each frame, solved alone: the penalties by the errors of straight maps, then the bent map if its error is no larger."""
    frames, draw = ObjectFrames(STATE, OBJECTS, ACTION, 1, 6).double(), generator(50)
    seen, ridges = scenes(150, 40)[:, None], [(10.0, 10.0, 10.0), (1e-2, 1.0, 10.0)]
    target = at_cup(seen[:, 0])
    target[:, :3] += 2.0 * (seen[:, 0, 7:10] - 0.5).clamp_min(0.0) + 0.02 * torch.randn(150, 3, generator=draw).double()
    action = torch.cat([target, torch.rand(150, 1, generator=draw).double()], dim=-1)[:, None]
    plain = frames.features(seen)
    assert frames.fourier is not None
    features = torch.cat([(plain - plain.mean(0)) / plain.std(0), frames.fourier(seen[:, 0])], dim=-1)
    noise = torch.diag(1e-3 * torch.rand(frames.width, generator=draw).double())
    maps, start, mask = FusedMaps(frames, 1, 1).double(), torch.zeros(150).long(), torch.ones(150, 1, dtype=torch.bool)
    maps.fit(features, start, frames, seen, action, mask, ridges, False, noise, SHRINKAGE)
    x, noise = torch.cat([features, torch.ones(150, 1).double()], dim=-1), F.pad(noise, (0, 1, 0, 1))
    poses, moved, bent = frames.targets(action, seen)[:, :, 0, 0, :3], frames.moved(seen), []
    for frame in range(frames.count):

        def solve(ridge: tuple[float, float, float], bend: bool, frame: int = frame) -> tuple[float, Tensor, Tensor]:
            penalty = F.pad(frames.penalties(moved, *ridge, bend)[frame], (0, 1), value=1e-6)
            solved, far = solve_ridge(x, poses[frame], torch.diag(penalty) + 150 * noise)
            spread = far.T @ far / 150 + solved @ noise @ solved.T
            return float(spread.trace()), solved, spread

        straight = [solve(ridge, False) for ridge in ridges]
        best = next(c for c in range(2) if straight[c][0] <= 2.0 * min(score for score, _, _ in straight))
        other = solve(ridges[best], True)
        bent.append((best, other[0] < BENDS * straight[best][0] and other[0] != straight[best][0]))
        _, solved, spread = other if bent[-1][1] else straight[best]
        torch.testing.assert_close(maps.weight[frame, 0, 0, :3], solved)
        root = maps.whitening[frame, 0, 0, 0]
        torch.testing.assert_close(root @ root, torch.linalg.inv(spread + 1e-7 * torch.eye(3)))
    assert {yes for _, yes in bent[1:]} == {True, False}


@pytest.mark.parametrize(("count", "straight", "most"), [(15, True, 1.05), (15, False, 1.05), (400, True, 1.05)])
def test_what_may_bend_costs_little_where_nothing_does_or_few_demonstrations_show_it(
    count: int, straight: bool, most: float
) -> None:
    assert off(count, 32, straight) < most * off(count, 0, straight)


def test_only_what_stands_still_bends_the_maps_of_its_own_frames() -> None:
    frames = ObjectFrames(STATE, OBJECTS, ACTION, 3, 4).double()
    penalties = frames.penalties(torch.tensor([False, True]), 1.0, 30.0, 300.0, bend=True)
    assert penalties.shape == (1 + 3 * 2, frames.width) == (7, frames.dim + 2 * 4)
    bent = (penalties[:, frames.dim :] == 30.0).unflatten(1, (2, 4))
    assert (penalties[:, frames.dim :][~bent.flatten(1)] == SHUT_OUT).all()
    assert bent.all(-1).tolist() == bent.any(-1).tolist()
    # Frames: the world, then cup and shelf in each of three views.
    assert bent.any(-1).tolist() == [[False, False], *([[True, False], [False, False]] * 3)]
    straight = frames.penalties(torch.tensor([False, True]), 1.0, 30.0, 300.0)
    assert (straight[:, frames.dim :] == SHUT_OUT).all()
    assert torch.equal(straight[:, : frames.dim], penalties[:, : frames.dim])


def test_a_policy_sees_them_where_objects_rest(metadata) -> None:
    """That is, in the longest mean."""
    policy = build(metadata, preset="hdril_reactive", hidden_dim=32, fourier_features=5).eval()
    assert policy.frames is not None
    assert policy.frames.fourier is not None
    names = [*policy.config.state_names, *policy.config.environment_names]
    seen = torch.rand(4, 3, len(names), generator=generator(3))
    added = policy.features(seen)[0][:, policy.frames.dim :]
    assert added.shape == (4, 5 * len(policy.frames.objects))
    torch.testing.assert_close(added, policy.frames.fourier(seen[:, 2]))
    other = seen.clone()
    other[:, :2] += 0.1
    torch.testing.assert_close(policy.features(other)[0][:, policy.frames.dim :], added)


def sized(copy: Path) -> LeRobotDatasetMetadata:
    """The dataset with a size beside the table's pose: 0.1 m larger in each episode, and far larger in the last one."""
    name = "observation.environment_state"
    info = json.loads((copy / "meta/info.json").read_text())
    feature = info["features"][name]
    feature["names"] = [*feature["names"], "table.size"]
    feature["shape"] = [len(feature["names"])]
    longer = pa.list_(pa.float32(), len(feature["names"]))
    edit(copy, name, lambda episode, frame, value: [*value, (0.1 * episode if episode < 5 else 9.0)], longer)
    (copy / "meta/info.json").write_text(json.dumps(info))
    return read(copy)


def test_the_scale_of_a_size_is_of_what_was_learned_from_and_in_the_checkpoint(copy: Path, tmp_path: Path) -> None:
    data = sized(copy)
    policy = build(data, learned=False, preset="hdril_reactive", hidden_dim=32)
    policy.forward({"index": FRAMES * torch.arange(5)})
    assert policy.frames is not None
    made = policy.frames.fourier
    assert made is not None
    assert float(made.scale[7]) == pytest.approx(SPREAD * 0.1 * 2.0**0.5, rel=1e-4)  # of 0 to 4
    assert float(made.middle[7]) == pytest.approx(0.2, rel=1e-4)
    with torch.no_grad():
        made.frequency.mul_(1.5)
        made.phase.add_(0.2)
    policy.save_pretrained(tmp_path / "saved")
    again = load(tmp_path / "saved").frames
    states = torch.rand(5, len(policy.config.state_names) + 8, generator=generator(4))
    assert torch.equal(again.fourier(states), made(states))


def test_checkpoint_from_before_them_has_none(metadata, tmp_path: Path) -> None:
    saved = build(metadata, preset="hdril_reactive", hidden_dim=32, fourier_features=0).eval()
    saved.save_pretrained(tmp_path)
    without(tmp_path, ["fourier_features"])
    older = load(tmp_path)
    assert older.config.fourier_features == 0
    first = observation(metadata, [0])
    saved.reset()
    assert torch.equal(older.select_action(first), saved.select_action(first))


@pytest.mark.parametrize(("count", "coordinates"), [(-1, "fused"), (8, "absolute")])
def test_there_are_none_or_more_where_predictions_are_fused(count: int, coordinates: Any) -> None:
    told = rf"^policy\.fourier_features must be 0 \(none\) or more, and is for .*; got {count} and {coordinates}$"
    with pytest.raises(ValueError, match=told):
        HDRILConfig(device="cpu", push_to_hub=False, coordinates=coordinates, fourier_features=count)
    assert HDRILConfig(device="cpu", push_to_hub=False, coordinates="absolute").fourier_features == 0
