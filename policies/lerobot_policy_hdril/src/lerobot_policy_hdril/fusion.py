"""Predictions in the frame of the world and of every object, fused by their precision.

A movement is often simple in the frame of the object that it is about: a grasp ends at the same place of the object, wherever
that is. Which object counts, and when, is learned: the frame in which demonstrations agree predicts with little variance, and
weighs most. Source of the idea: task-parameterised Gaussian mixtures (Calinon, A tutorial on task-parameterized movement
learning and retrieval, 2016). Here the Gaussian of each frame comes from a linear map of what is seen.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_policy_hdril.coordinates import conjugate, multiply, rotate
from lerobot_policy_hdril.dynamics import ridge_penalty, solve_ridge, usual_windows
from lerobot_policy_hdril.graph import pose_groups

_FLOOR = 1e-7
"""Least variance, m² and of a quaternion's numbers: no frame is trusted further than a third of a millimetre."""


class ObjectFrames(nn.Module):
    """Poses of a state as they are seen from the world and from every object with a pose.

    Args:
        state_names: names of the state's numbers, hands and objects.
        objects: which of them are objects'.
        action_names: names of an action's numbers.

    Raises:
        ValueError: no object has a pose, or the actions have none.
    """

    def __init__(self, state_names: list[str], objects: list[str], action_names: list[str]) -> None:
        super().__init__()
        poses, hands = pose_groups(state_names), pose_groups(action_names)
        frames = [group for group in poses if state_names[group[0]] in objects]
        if not frames or not hands:
            raise ValueError(
                "policy.coordinates=fused needs poses of objects and poses in the actions; "
                f"objects: {', '.join(objects)}; actions: {', '.join(action_names)}"
            )
        others = [[place for place, group in enumerate(poses) if group != frame] for frame in frames]
        for name, value in (("poses", poses), ("frames", frames), ("others", others), ("hands", hands)):
            self.register_buffer(name, torch.tensor(value, dtype=torch.long), persistent=False)
        self.dim = len(state_names) + 7 * sum(map(len, others))

    poses: Tensor  # (P, 7), columns of the state
    frames: Tensor  # (F, 7), those of objects
    others: Tensor  # (F, P - 1), which poses are seen from each
    hands: Tensor  # (G, 7), columns of an action

    def origins(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (B, F, 3) and unit quaternions (B, F, 4) of the objects in states (B, S)."""
        poses = state[:, self.frames]
        return poses[..., :3], F.normalize(poses[..., 3:], dim=-1)

    def features(self, state: Tensor) -> Tensor:
        """States (B, S) and beside them (B, D - S) the poses of everything in every object's frame; w >= 0."""
        position, quaternion = self.origins(state)
        poses = state[:, self.poses][:, self.others]  # (B, F, P - 1, 7)
        seen = _into(poses, position[:, :, None], quaternion[:, :, None])
        seen = torch.cat([seen[..., :3], torch.where(seen[..., 6:] < 0, -seen[..., 3:], seen[..., 3:])], dim=-1)
        return torch.cat([state, seen.flatten(1)], dim=-1)

    def targets(self, action: Tensor, state: Tensor) -> Tensor:
        """Hands of actions (B, M, A) as seen from the world and from the objects of states (B, S): (1 + F, B, M, G, 7)."""
        hands = action[..., self.hands]
        position, quaternion = self.origins(state)
        seen = [_into(hands, position[:, f, None, None], quaternion[:, f, None, None]) for f in range(len(self.frames))]
        return torch.stack([hands, *seen])


def _into(poses: Tensor, position: Tensor, quaternion: Tensor) -> Tensor:
    inverse = conjugate(quaternion).expand(*poses.shape[:-1], 4)
    return torch.cat([rotate(inverse, poses[..., :3] - position), multiply(inverse, poses[..., 3:])], dim=-1)


class FusedMaps(nn.Module):
    """Linear maps from what is seen to the next actions, in every frame, and their fusion.

    In frame f a map predicts a hand's pose y_f; the demonstrations' leave-one-out errors of it have the covariance S_f. With
    the frame's origin t_f and rotation R_f in the world, the position is

        x = (sum_f P_f)^-1 sum_f P_f (R_f y_f + t_f)        P_f = R_f S_f^-1 R_f^T

    and the orientation is the mean of the frames' quaternions, weighted by the inverse of their variances. What is no pose,
    such as the opening of a hand, is predicted by a map of the world's frame.

    Args:
        features: numbers that are seen.
        actions: numbers of an action.
        frames: frames beside the world.
        hands: poses in an action.
        starts: frames of a primitive at which plans are made.
        ahead: frames that a plan predicts.
    """

    def __init__(self, features: int, actions: int, frames: int, hands: int, starts: int, ahead: int) -> None:
        super().__init__()
        grid, width = (starts, ahead), 7 * hands
        self.register_buffer("weight", torch.zeros(1 + frames, *grid, width, features + 1))
        self.register_buffer("plain", torch.zeros(*grid, actions, features + 1))
        self.register_buffer("covariance", torch.eye(3).expand(1 + frames, *grid, hands, 3, 3).clone())
        self.register_buffer("variance", torch.ones(1 + frames, *grid, hands))

    weight: Tensor
    plain: Tensor
    covariance: Tensor
    variance: Tensor

    @torch.no_grad()
    def fit(
        self, seen: Tensor, start: Tensor, action: Tensor, poses: Tensor, mask: Tensor, ridge: float, robust: bool
    ) -> None:
        """Solve the maps, in float64, see :func:`~lerobot_policy_hdril.dynamics.solve_ridge`.

        Args:
            seen: features (N, D).
            start: which of the starts a window has (N,).
            action: (N, M, A).
            poses: the actions' hands in every frame (1 + F, N, M, G, 7).
            mask: (N, M), True where there is an action.
            ridge: weight of the penalty.
            robust: leave out windows that are far off a first fit.
        """
        for buffer in (self.weight, self.plain):
            buffer.zero_()
        self.covariance.copy_(torch.eye(3).expand_as(self.covariance))
        self.variance.fill_(1.0)
        inputs = torch.cat([seen, torch.ones_like(seen[:, :1])], dim=-1).double()
        penalty = ridge_penalty(inputs, ridge)
        for first in start.unique().tolist():
            rows = (start == first) & mask[:, 0]
            if robust:
                rows = usual_windows(inputs, action[:, 0].double(), rows, penalty)
            for step in range(mask.shape[1]):
                here = rows & mask[:, step]
                if here.any():
                    self._fit_step(first, step, inputs[here], action[here, step], poses[:, here, step], penalty)

    def _fit_step(self, first: int, step: int, x: Tensor, action: Tensor, poses: Tensor, penalty: Tensor) -> None:
        poses = _same_signs(poses.double())
        outputs = torch.cat([action.double(), *poses.flatten(2)], dim=-1)
        solution, errors = solve_ridge(x, outputs, penalty)
        width = poses[0].flatten(1).shape[1]
        self.plain[first, step] = solution[: action.shape[1]].to(self.plain)
        for f, (maps, far) in enumerate(
            zip(solution[action.shape[1] :].split(width), errors[:, action.shape[1] :].split(width, dim=1), strict=True)
        ):
            far = far.unflatten(1, (-1, 7))  # (N, G, 7)
            self.weight[f, first, step] = maps.to(self.weight)
            second = torch.einsum("ngi,ngj->gij", far[..., :3], far[..., :3]) / len(far)
            self.covariance[f, first, step] = (second + _FLOOR * torch.eye(3).to(second)).to(self.covariance)
            self.variance[f, first, step] = far[..., 3:].square().sum(-1).mean(0).add(_FLOOR).to(self.variance)

    def forward(self, seen: Tensor, start: Tensor, frames: ObjectFrames, state: Tensor) -> Tensor:
        """Features (B, D) at starts (B,) of plans, and the states (B, S) there, to actions (B, M, A) in the world."""
        inputs = torch.cat([seen, torch.ones_like(seen[:, :1])], dim=-1)
        action = torch.einsum("bmad,bd->bma", self.plain[start], inputs)
        poses = torch.einsum("fbmwd,bd->fbmw", self.weight[:, start], inputs).unflatten(-1, (-1, 7))
        position, quaternion = frames.origins(state)
        position, quaternion = position.transpose(0, 1)[:, :, None, None], quaternion.transpose(0, 1)[:, :, None, None]
        count = (*poses.shape[:-1], 4)
        turns = torch.cat([_identity(poses).expand(count)[:1], quaternion.expand(len(quaternion), *count[1:])])
        origins = torch.cat([torch.zeros_like(poses[:1, ..., :3]), position.expand(*turns[1:, ..., :3].shape)])
        means = rotate(turns, poses[..., :3]) + origins  # (1 + F, B, M, G, 3)
        axes = rotate(turns[..., None, :].expand(*count[:-1], 3, 4), torch.eye(3).to(poses).expand(*count[:-1], 3, 3))
        precision = torch.linalg.inv(axes.mT @ self.covariance[:, start] @ axes)
        total = precision.sum(0)
        fused = torch.linalg.solve(total, (precision @ means[..., None]).sum(0))[..., 0]
        rotations = multiply(turns, F.normalize(poses[..., 3:], dim=-1))
        sign = torch.where((rotations * rotations[:1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        mean = (sign * rotations / self.variance[:, start][..., None]).sum(0)
        action[..., frames.hands] = torch.cat([fused, F.normalize(mean, dim=-1)], dim=-1)
        return action


def _identity(like: Tensor) -> Tensor:
    return torch.tensor((0.0, 0.0, 0.0, 1.0), dtype=like.dtype, device=like.device)


def _same_signs(poses: Tensor) -> Tensor:
    """Poses (F, N, G, 7) whose quaternions have the sign that is nearer to those of the other windows."""
    quaternion = poses[..., 3:]
    for reference in (quaternion[:, :1], None):
        near = quaternion.mean(1, keepdim=True) if reference is None else reference
        quaternion = torch.where((quaternion * near).sum(-1, keepdim=True) < 0, -quaternion, quaternion)
    return torch.cat([poses[..., :3], quaternion], dim=-1)
