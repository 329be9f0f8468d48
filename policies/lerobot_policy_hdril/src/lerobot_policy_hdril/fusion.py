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

from lerobot_policy_hdril.coordinates import Origins, positive, unit
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
                f"objects: {', '.join(objects)}; actions: {', '.join(action_names)}. policy.preset=hdril needs none"
            )
        others = [[group for group in poses if group != frame] for frame in frames]
        rest = [i for i in range(len(action_names)) if not any(i in hand for hand in hands)]
        columns = {"frames": frames, "seen": others, "hands": hands, "rest": rest}
        for name, value in columns.items():
            self.register_buffer(name, torch.tensor(value, dtype=torch.long), persistent=False)
        self.seen = self.seen.reshape(len(frames), len(poses) - 1, 7)  # where an object has the only pose, too
        self.register_buffer("world", torch.eye(7)[6], persistent=False)
        self.dim = len(state_names) + 7 * sum(map(len, others))

    frames: Tensor  # (F, 7), columns of a state: poses of objects
    seen: Tensor  # (F, P - 1, 7), those of the poses that are seen from each
    hands: Tensor  # (G, 7), columns of an action
    rest: Tensor  # columns of an action that are no pose's
    world: Tensor  # (7,), its pose

    def origins(self, state: Tensor) -> Origins:
        """The frames (1 + F, B) of the world and of the objects in states (B, S)."""
        poses = torch.cat([self.world.to(state).expand(1, len(state), 7), state[:, self.frames].transpose(0, 1)])
        return Origins.at(poses[..., :3], unit(poses[..., 3:]))

    def features(self, state: Tensor, origins: Origins | None = None) -> Tensor:
        """States (B, S) and beside them (B, D - S) the poses of everything in every object's frame; w >= 0. ``origins`` are those
        of the states, if they are known."""
        origins = self.origins(state) if origins is None else origins
        seen = positive(origins[1:].see(state[:, self.seen].transpose(0, 1)))  # (F, B, P - 1, 7)
        return torch.cat([state, seen.transpose(0, 1).flatten(1)], dim=-1)

    def targets(self, action: Tensor, state: Tensor) -> Tensor:
        """Hands of actions (B, M, A) as seen from the world and from the objects of states (B, S): (1 + F, B, M, G, 7)."""
        return self.origins(state)[:, :, None].see(action[..., self.hands])


class FusedMaps(nn.Module):
    """Linear maps from what is seen to the next actions, in every frame, and their fusion.

    In frame f a map predicts a hand's pose y_f; the demonstrations' leave-one-out errors of it have the covariance S_f, to which
    noise of what is seen adds. With the frame's origin t_f and rotation R_f in the world, the position is

        x = (sum_f P_f)^-1 sum_f P_f (R_f y_f + t_f)        P_f = R_f S_f^-1 R_f^T

    and the orientation is the mean of the frames' quaternions, weighted by the inverse of their variances. What is no pose,
    such as the opening of a hand, has a map of its own.

    Args:
        features: numbers that are seen.
        frames: the frames, and what of an action is a pose.
        starts: frames of a primitive at which plans are made.
        ahead: frames that a plan predicts.
    """

    def __init__(self, features: int, frames: ObjectFrames, starts: int, ahead: int) -> None:
        super().__init__()
        count, hands, grid = 1 + len(frames.frames), len(frames.hands), (starts, ahead)
        self.register_buffer("weight", torch.zeros(count, *grid, 7 * hands, features + 1))
        self.register_buffer("plain", torch.zeros(*grid, len(frames.rest), features + 1))
        self.register_buffer("precision", torch.eye(3).expand(count, *grid, hands, 3, 3).clone())
        self.register_buffer("variance", torch.ones(count, *grid, hands))

    weight: Tensor
    plain: Tensor
    precision: Tensor
    variance: Tensor

    @torch.no_grad()
    def fit(
        self,
        seen: Tensor,
        start: Tensor,
        frames: ObjectFrames,
        state: Tensor,
        action: Tensor,
        mask: Tensor,
        ridge: float,
        robust: bool,
        noise: Tensor,
    ) -> None:
        """Solve the maps, in float64, see :func:`~lerobot_policy_hdril.dynamics.solve_ridge`.

        Args:
            seen: features (N, D).
            start: which of the starts a window has (N,).
            frames: the frames of the states.
            state: states (N, S) at which windows start.
            action: (N, M, A).
            mask: (N, M), True where there is an action.
            ridge: weight of the penalty.
            robust: leave out windows that are far off a first fit.
            noise: covariance (D, D) of noise on the features that the maps are to bear; 0 for none. The penalty grows as if every
                window were seen with such noise, and the covariance of a frame's errors by what the noise adds to them.
        """
        for buffer, value in ((self.weight, 0.0), (self.plain, 0.0), (self.variance, 1.0)):
            buffer.fill_(value)
        self.precision.copy_(torch.eye(3).expand_as(self.precision))
        inputs = torch.cat([seen, torch.ones_like(seen[:, :1])], dim=-1).double()
        poses, rest = frames.targets(action, state).double(), action[..., frames.rest].double()
        least, noise = ridge_penalty(inputs, ridge), F.pad(noise.double(), (0, 1, 0, 1))
        for first in start.unique().tolist():
            rows = (start == first) & mask[:, 0]
            penalty = least + rows.sum() * noise
            if robust:
                rows = usual_windows(inputs, action[:, 0].double(), rows, penalty)
            for step in range(mask.shape[1]):
                here = rows & mask[:, step]
                if here.any():
                    x, y = inputs[here], poses[:, here, step]
                    self._fit_step(first, step, x, y, rest[here, step], penalty, noise)

    def _fit_step(
        self, first: int, step: int, x: Tensor, poses: Tensor, rest: Tensor, penalty: Tensor, noise: Tensor
    ) -> None:
        """Poses (1 + F, N, G, 7) and the rest of the actions (N, A - 7 G) from x (N, D + 1)."""
        outputs = _same_signs(poses).transpose(0, 1).flatten(1)  # (N, (1 + F) G 7)
        solution, errors = solve_ridge(x, torch.cat([rest, outputs], dim=-1), penalty)
        count = rest.shape[1]
        self.plain[first, step] = solution[:count].to(self.plain)
        self.weight[:, first, step] = solution[count:].unflatten(0, (len(poses), -1)).to(self.weight)
        far = errors[:, count:].unflatten(1, (len(poses), -1, 7))  # (N, 1 + F, G, 7)
        second = torch.einsum("nfgi,nfgj->fgij", far, far) / len(far)
        weight = solution[count:].unflatten(0, (len(poses), -1, 7))
        second += torch.einsum("fgid,de,fgje->fgij", weight, noise, weight)
        position, turn = second[..., :3, :3], second[..., 3:, 3:].diagonal(dim1=-2, dim2=-1).sum(-1)
        self.precision[:, first, step] = torch.linalg.inv(position + _FLOOR * torch.eye(3).to(second)).to(
            self.precision
        )
        self.variance[:, first, step] = (turn + _FLOOR).to(self.variance)

    def forward(self, seen: Tensor, start: Tensor, frames: ObjectFrames, origins: Origins) -> Tensor:
        """Features (B, D) at starts (B,) of plans, and the frames' origins there (1 + F, B), to actions (B, M, A) in the
        world."""
        inputs = F.pad(seen, (0, 1), value=1.0)[:, None, None]
        told = (self.weight.index_select(1, start) * inputs).sum(-1).unflatten(-1, (-1, 7))  # (1 + F, B, M, G, 7)
        poses = origins[:, :, None].place(told)
        means, axes = poses[..., :3], origins.rotation[:, :, None, None]
        precision = axes @ self.precision.index_select(1, start) @ axes.mT
        # Of the differences from the world's mean, which are small: precisions may differ by five orders of magnitude, and mixed
        # precision may round them.
        far = (precision @ (means - means[:1])[..., None]).sum(0)
        position = means[0] + torch.linalg.solve(precision.sum(0), far)[..., 0]
        rotations = unit(poses[..., 3:])
        quaternion = (_towards(rotations, rotations[:1]) / self.variance.index_select(1, start)[..., None]).sum(0)
        rest = (self.plain.index_select(0, start) * inputs).sum(-1)
        action = rest.new_empty(*rest.shape[:2], len(frames.rest) + frames.hands.numel())
        action[..., frames.rest] = rest
        action[..., frames.hands] = torch.cat([position, unit(quaternion)], dim=-1)
        return action


def _same_signs(poses: Tensor) -> Tensor:
    """Poses (F, N, G, 7) whose quaternions have the sign that is nearer to those of the other windows."""
    quaternion = _towards(poses[..., 3:], poses[:, :1, :, 3:])  # so that they have a mean
    return torch.cat([poses[..., :3], _towards(quaternion, quaternion.mean(1, keepdim=True))], dim=-1)


def _towards(quaternion: Tensor, reference: Tensor) -> Tensor:
    return torch.where((quaternion * reference).sum(-1, keepdim=True) < 0, -quaternion, quaternion)
