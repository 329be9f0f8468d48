"""In whose frame poses are given to the dynamics and come out of them (paper, Section 5.2: absolute and relational)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lerobot_policy_hdril.graph import pose_groups


def unit(quaternion: Tensor) -> Tensor:
    """Quaternions (..., 4) of unit length; zeros stay zeros. For one row, two thirds of the time of ``F.normalize``."""
    return quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True).clamp_min(1e-12)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Vectors (..., 3) turned by unit quaternions (..., 4), xyzw."""
    axis = quaternion[..., :3]
    twice = 2.0 * torch.cross(axis, vector, dim=-1)
    return vector + quaternion[..., 3:] * twice + torch.cross(axis, twice, dim=-1)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Products (..., 4) of quaternions, xyzw: first b, then a."""
    vector = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + torch.cross(a[..., :3], b[..., :3], dim=-1)
    return torch.cat([vector, a[..., 3:] * b[..., 3:] - (a[..., :3] * b[..., :3]).sum(-1, keepdim=True)], dim=-1)


def conjugate(quaternion: Tensor) -> Tensor:
    """The inverse of unit quaternions (..., 4), xyzw."""
    return torch.cat([-quaternion[..., :3], quaternion[..., 3:]], dim=-1)


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

    def _frame(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Position (..., 3) and unit quaternion (..., 4), w >= 0 so that it has one sign, of the frame."""
        pose = state[..., self.frame]
        quaternion = unit(pose[..., 3:])
        return pose[..., :3], torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)

    def encode_state(self, state: Tensor) -> Tensor:
        """States (..., S) with hands and other objects seen from the frame."""
        return self._into(state, self.inputs, *self._frame(state))

    def encode_output(self, output: Tensor, state: Tensor) -> Tensor:
        """Predictions (B, M, W) seen from the frame of ``state`` (B, S)."""
        position, quaternion = self._frame(state)
        return self._into(output, self.outputs, position[:, None], quaternion[:, None])

    def decode_output(self, output: Tensor, state: Tensor) -> Tensor:
        """The inverse of :meth:`encode_output`."""
        position, quaternion = (part[:, None, None] for part in self._frame(state))
        poses = output[..., self.outputs]  # (B, M, G, 7)
        shape = poses.shape[:-1]
        quaternion = quaternion.expand(*shape, 4)
        moved = rotate(quaternion, poses[..., :3]) + position
        result = output.clone()
        result[..., self.outputs] = torch.cat([moved, multiply(quaternion, poses[..., 3:])], dim=-1)
        return result

    @staticmethod
    def _into(values: Tensor, groups: Tensor, position: Tensor, quaternion: Tensor) -> Tensor:
        poses = values[..., groups]  # (..., G, 7)
        inverse = conjugate(quaternion)[..., None, :].expand(*poses.shape[:-1], 4)
        seen = rotate(inverse, poses[..., :3] - position[..., None, :])
        result = values.clone()
        result[..., groups] = torch.cat([seen, multiply(inverse, poses[..., 3:])], dim=-1)
        return result
