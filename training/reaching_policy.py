"""Policy that reaches for a pick: a network from what it observes to a waypoint.

Frames: T is the support, G is the tool, z out of it, O is the picked object.
"""

from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import BaseModel
from torch import Tensor, nn

from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import load_checkpoint, load_weights
from drake_clutter.validation import InRange, validate
from training.reaching_demonstrations import NEIGHBORHOOD

CHECKPOINT_KIND = "reaching policy"
"""Kind of the checkpoint."""
LOOKAHEAD = 0.2
"""Time to the waypoint that the policy predicts [s]."""


def _turn(vectors: Tensor, angle: Tensor) -> Tensor:
    """Return vectors (b, 3) that are turned about z by angles [rad] (b,)."""
    x, y, z = vectors.unbind(dim=1)
    c, s = angle.cos(), angle.sin()
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=1)


class ReachingPolicy(nn.Module):
    """Network from joint angles, tool pose and target to the change of the joint angles.

    The first joint turns the arm about the vertical, so positions are seen in a frame that turns
    with it: a demonstration shows how to reach targets at the same distance in all directions.

    Attributes:
        observation: `state` or `depth`.
    """

    def __init__(self, observation: str, num_joints: int) -> None:
        """Create the network.

        Args:
            observation: `state` or `depth`.
            num_joints: Number of joints of the arm.
        """
        super().__init__()
        self.observation = observation
        self.attention = nn.Sequential(
            nn.Conv2d(3, 8, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(8, 8, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(8, 1, 1),
        )
        size = 256
        self.head = nn.Sequential(
            nn.Linear(num_joints - 2 + 4 + 3 * 3 + 2 * 2, size),
            nn.SiLU(),
            nn.Linear(size, size),
            nn.SiLU(),
            nn.Linear(size, size),
            nn.SiLU(),
            nn.Linear(size, num_joints - 1),
        )
        self.action_scale: Tensor
        self.register_buffer("action_scale", torch.full((num_joints - 1,), 0.1))
        self.base: Tensor
        self.register_buffer("base", torch.zeros(3))

    def find_target(self, images: Tensor) -> Tensor:
        """Return the target, of which the point is attended to. Shape (b, 4).

        Args:
            images: See `crop_image`. Shape (b, 4, CROP, CROP).
        """
        points, mask = images[:, :3], images[:, 3:]
        visible = mask > 0
        height = points[:, 2:]
        lowest = torch.where(visible, height, torch.inf).amin(dim=(2, 3), keepdim=True)
        highest = torch.where(visible, height, -torch.inf).amax(dim=(2, 3), keepdim=True)
        shown = torch.cat([10 * (height - highest), 10 * (height - lowest), mask], dim=1)
        logits = self.attention(shown).masked_fill(~visible, -torch.inf)
        weights = logits.flatten(2).softmax(dim=2)
        target = (points.flatten(2) * weights).sum(dim=2)
        offsets = points - target.detach()[:, :, None, None]
        is_near = ~visible & (offsets[:, :2].norm(dim=1, keepdim=True) <= NEIGHBORHOOD)
        rise = torch.where(is_near, offsets[:, 2:], 0.0).amax(dim=(2, 3))
        return torch.cat([target, rise], dim=1)

    def forward(self, q: Tensor, p_TG: Tensor, axis: Tensor, target: Tensor) -> Tensor:
        """Return the change of all joints but the last within `LOOKAHEAD` [rad].

        Args:
            q: Joint angles [rad]. Shape (b, n).
            p_TG: Position of the tool [m]. Shape (b, 3).
            axis: Axis of the tool in T. Shape (b, 3).
            target: Point to reach and rise of its neighbors [m]. Shape (b, 4).
        """
        offset = _turn(target[:, :3] - p_TG, -q[:, 0])
        tilt = _turn(axis, -q[:, 0])[:, :2]
        features = [
            q[:, 1:-1] / 2,
            _turn(target[:, :3] - self.base, -q[:, 0]) / 0.3,
            target[:, 3:] / 0.3,
            offset / 0.5,
            torch.tanh(offset / 0.05),
            torch.tanh(offset / 0.01),
            tilt,
            torch.tanh(tilt / 0.05),
        ]
        change: Tensor = self.head(torch.cat(features, dim=1)) * self.action_scale
        return change

    @staticmethod
    def load(path: Path) -> "ReachingPolicy":
        """Read a checkpoint.

        Raises:
            InputError: The file cannot be read, or is not a policy's checkpoint.
        """
        checkpoint = load_checkpoint(path)
        if checkpoint.kind != CHECKPOINT_KIND:
            raise InputError(f"{path}: kind: {checkpoint.kind}; expected {CHECKPOINT_KIND}")
        source = str(path.with_suffix(".json"))
        metadata = validate(_PolicyMetadata, checkpoint.metadata, source)
        policy = ReachingPolicy(metadata.observation, metadata.num_joints)
        load_weights(policy, checkpoint.weights, path)
        return policy.eval()


class _PolicyMetadata(BaseModel):
    """What a policy needs of the metadata of its checkpoint."""

    observation: Literal["state", "depth"]
    num_joints: Annotated[int, InRange(2, 20)]
