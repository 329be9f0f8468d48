"""In whose frame poses are given to the dynamics and come out of them (paper, Section 5.2: absolute and relational)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_policy_hdril.graph import pose_groups


def unit(quaternion: Tensor) -> Tensor:
    """Quaternions (..., 4) of unit length; zeros stay zeros. For one row, two thirds of the time of ``F.normalize``."""
    return quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True).clamp_min(1e-12)


# The numbers of a quaternion, and their signs, in the matrix L(a) of products a b, and in R(b): a b = L(a) b = R(b) a.
_NUMBERS = torch.tensor(((3, 2, 1, 0), (2, 3, 0, 1), (1, 0, 3, 2), (0, 1, 2, 3)))
_LEFT_SIGNS = torch.tensor(
    ((1.0, -1.0, 1.0, 1.0), (1.0, 1.0, -1.0, 1.0), (-1.0, 1.0, 1.0, 1.0), (-1.0, -1.0, -1.0, 1.0))
)
_RIGHT_SIGNS = torch.tensor(
    ((1.0, 1.0, -1.0, 1.0), (-1.0, 1.0, 1.0, 1.0), (1.0, -1.0, 1.0, 1.0))
)  # of its first three rows
_TURNS = torch.tensor([False] * 3 + [True] * 4)  # which numbers of a pose are its quaternion's


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Products (..., 4) of quaternions, xyzw: first b, then a."""
    return apply(a[..., _NUMBERS] * _LEFT_SIGNS.to(a), b)


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """Products (..., n) of matrices (..., n, n) and vectors (..., n), as exact as sums: mixed precision and TF32 change matrix
    products, and a pose would lose millimetres."""
    return (matrix * vector[..., None, :]).sum(-1)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Products (..., n, n) of matrices, as exact as :func:`apply`."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def positive(poses: Tensor) -> Tensor:
    """Poses (..., 7) whose quaternions have w >= 0: each rotation has one."""
    return torch.where((poses[..., 6:] < 0) & _TURNS.to(poses.device), -poses, poses)


def towards(quaternion: Tensor, reference: Tensor) -> Tensor:
    """Quaternions (..., 4), each with the sign that is nearer to ``reference``."""
    return torch.where((quaternion * reference).sum(-1, keepdim=True) < 0, -quaternion, quaternion)


@dataclass(frozen=True, eq=False)
class Origins:
    """Where frames are, as the matrices that turn vectors and quaternions. For one running episode, they take a third of the time
    that the formulas by components take."""

    position: Tensor  # (..., 3)
    rotation: Tensor  # (..., 3, 3), its columns are a frame's axes
    left: Tensor  # (..., 4, 4), of products with the frame's quaternion from the left

    @classmethod
    def at(cls, position: Tensor, quaternion: Tensor) -> Origins:
        """Frames at positions (..., 3), turned by unit quaternions (..., 4), xyzw."""
        numbers = quaternion[..., _NUMBERS]
        left, right = numbers * _LEFT_SIGNS.to(numbers), numbers[..., :3, :] * _RIGHT_SIGNS.to(numbers)
        rotation = apply(right[..., None, :, :], left[..., :3, :])  # q v q* = L(q) R(q)^T v
        return cls(position, rotation, left)

    def __getitem__(self, index: Any) -> Origins:
        return Origins(self.position[index], self.rotation[index], self.left[index])

    def see(self, poses: Tensor) -> Tensor:
        """Poses (..., P, 7) of the world, P for each frame, as seen from the frames."""
        offset = poses[..., :3] - self.position[..., None, :]
        rotation, left = self.rotation.mT[..., None, :, :], self.left.mT[..., None, :, :]
        return torch.cat([apply(rotation, offset), apply(left, poses[..., 3:])], dim=-1)

    def place(self, seen: Tensor) -> Tensor:
        """The inverse of :meth:`see`."""
        position = apply(self.rotation[..., None, :, :], seen[..., :3]) + self.position[..., None, :]
        return torch.cat([position, apply(self.left[..., None, :, :], seen[..., 3:])], dim=-1)


class RelationalCoordinates(nn.Module):
    """Poses in the frame of the first object, as it stands when a plan is made; that object itself stays in the world.

    Args:
        state_names: names of the state's numbers, hands and objects.
        objects: which of them are objects'; the first pose among these is the frame.
        output_names: names of the numbers that a plan predicts. All their poses are given in the frame.

    Raises:
        ValueError: no object has a pose.
    """

    def __init__(self, state_names: list[str], objects: list[str], output_names: list[str]) -> None:
        super().__init__()
        frames = [group for group in pose_groups(state_names) if state_names[group[0]] in objects]
        if not frames:
            raise ValueError(
                f"policy.coordinates=relational needs an object with a pose; objects: {', '.join(objects)}"
            )
        inputs = [group for group in pose_groups(state_names) if group != frames[0]]
        for name, value in (("frame", frames[0]), ("inputs", inputs), ("outputs", pose_groups(output_names))):
            self.register_buffer(name, torch.tensor(value, dtype=torch.long), persistent=False)
        # Of encoded states, over the demonstrations.
        self.register_buffer("state_mean", torch.zeros(len(state_names)))
        self.register_buffer("state_std", torch.ones(len(state_names)))

    state_mean: Tensor
    state_std: Tensor
    frame: Tensor
    inputs: Tensor
    outputs: Tensor

    def _origin(self, state: Tensor) -> Origins:
        pose = positive(state[..., self.frame])
        return Origins.at(pose[..., :3], unit(pose[..., 3:]))

    def encode_state(self, state: Tensor) -> Tensor:
        """States (..., S) with hands and other objects seen from the frame."""
        result = state.clone()
        result[..., self.inputs] = self._origin(state).see(state[..., self.inputs])
        return result

    def encode_output(self, output: Tensor, state: Tensor) -> Tensor:
        """Predictions (B, M, W) seen from the frame of ``state`` (B, S)."""
        result = output.clone()
        result[..., self.outputs] = self._origin(state)[:, None].see(output[..., self.outputs])
        return result

    def decode_output(self, output: Tensor, state: Tensor) -> Tensor:
        """The inverse of :meth:`encode_output`."""
        result = output.clone()
        result[..., self.outputs] = self._origin(state)[:, None].place(output[..., self.outputs])
        return result
