"""Instance segmentation by a network that classifies pixels and votes for object centers.

The network works on depth, or on depth and color. For every second pixel in both directions it
predicts the class of the object and the position of the object's center. Votes for the same center
belong to one object, as in Qi et al. 2019, "Deep Hough voting for 3D object detection in point
clouds". In contrast to centers of masks in the image, the centers of two objects never coincide,
even if one lies across the other.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, Field
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor, nn

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.support import Support
from drake_clutter.files import input_error
from drake_clutter.learning.checkpoint import load_checkpoint, load_weights
from drake_clutter.validation import Flag, NonEmptyText, Positive, validate

Scalar = TypeVar("Scalar", bound=np.generic)

CHECKPOINT_KIND = "detector"
"""Value of `kind` in the metadata of checkpoints."""
RENAMED_METADATA = {"looks_at_color": "use_color"}
"""Current keys of a checkpoint's metadata by earlier ones."""
RENAMED_MODULES = {"into": "stem", "middle": "bottleneck", "narrow": "lateral"}
"""Current names of the network's modules by earlier ones."""
OUTPUT_STRIDE = 2
"""Image pixels per output cell of the network, in both directions."""
WINDOW_MULTIPLE = 16
"""Total stride of the network, of which the side of a window is a multiple [px]."""
MAX_SCENE_HEIGHT = 0.5
"""Height up to which everything above the support is in the window [m]."""
CHANNELS = (24, 48, 96, 128)
"""Number of channels at each resolution of the network."""
HEIGHT_UNIT = 0.25
"""Height that corresponds to a network input of 1 [m]."""
VOTE_UNIT = 0.05
"""Offset that corresponds to a network output of 1 [m]."""
HAS_FAST_BFLOAT16 = any(
    torch.cpu.get_capabilities().get(name) for name in ("amx_bf16", "avx512_bf16")
)
"""Whether the CPU multiplies bfloat16 matrices in hardware, which is at least twice as fast."""
PIXEL_SIZE = 0.0025
"""Approximate distance of neighboring pixels on the tray, for slopes [m]."""


@dataclass(frozen=True)
class ImageWindow:
    """Square part of an image that contains the support.

    Attributes:
        rows: Rows of the image.
        columns: Columns of the image.
    """

    rows: slice
    columns: slice

    @staticmethod
    def around_support(camera: Camera, support: Support) -> "ImageWindow":
        """Return the smallest window of a camera that contains a support, if there is one."""
        size = np.array([camera.width, camera.height])
        center, required_side = camera.support_bounds(support, MAX_SCENE_HEIGHT) or (
            np.array(camera.principal_point),
            math.inf,
        )
        side = min(size) // WINDOW_MULTIPLE * WINDOW_MULTIPLE
        if required_side < side:
            side = WINDOW_MULTIPLE * math.ceil(required_side / WINDOW_MULTIPLE)
        corner = np.floor(center + 1 - side / 2 + 1e-6).astype(int)
        left, top = np.clip(corner, 0, size - side).tolist()
        return ImageWindow(slice(top, top + side), slice(left, left + side))

    @property
    def side(self) -> int:
        """Length of a side [px]."""
        return int(self.rows.stop - self.rows.start)


def backproject_window(
    depth: NDArray[np.float32], camera: Camera, window: ImageWindow
) -> NDArray[np.float32]:
    """Return the points of a window's pixels in the tray frame.

    Args:
        depth: Depth image [m]; 0 or infinite where there is no measurement. Shape (H, W).
        camera: Camera of the image.
        window: Part of the image.

    Returns:
        p_TP of each pixel [m]; NaN where there is no measurement. Shape (side, side, 3).
    """
    z = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)[window.rows, window.columns]
    row, column = np.mgrid[window.rows, window.columns].astype(np.float32)
    return camera.backproject(np.stack([column, row], axis=-1), z).astype(np.float32)


def downsample(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return every second pixel of a window, one for each output cell of the network.

    Args:
        array: Shape (side, side, ...).

    Returns:
        Shape (side / 2, side / 2, ...).
    """
    return array[::OUTPUT_STRIDE, ::OUTPUT_STRIDE]


def upsample(
    mask: NDArray[np.bool_], window: ImageWindow, image_shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Return a mask of the network's output cells as a mask of the image.

    Args:
        mask: Mask of cells. Shape (side / 2, side / 2).
        window: Part of the image that the cells cover.
        image_shape: Height and width of the image.
    """
    image_mask = np.zeros(image_shape, bool)
    window_mask = mask.repeat(OUTPUT_STRIDE, axis=0).repeat(OUTPUT_STRIDE, axis=1)
    image_mask[window.rows, window.columns] = window_mask
    return image_mask


def fill_holes(image: NDArray[np.floating]) -> NDArray[np.floating]:
    """Replace values that are not finite by that of the nearest finite pixel.

    Args:
        image: Shape (H, W).
    """
    holes = ~np.isfinite(image)
    if not holes.any() or holes.all():
        return image
    nearest = distance_transform_edt(holes, return_distances=False, return_indices=True)
    return np.asarray(image[tuple(nearest)])


def make_network_input(
    p_TP: NDArray[np.floating], color: NDArray[np.number] | None
) -> NDArray[np.float32]:
    """Return the input channels of the network.

    The channels are height, whether it was measured, two slopes, and optionally color. The slopes
    make steps of a few millimeters visible, which are tiny compared to the height of a stack.

    Args:
        p_TP: Points of a window, see `backproject_window` [m]. Shape (side, side, 3).
        color: Color of the window; None: without. Shape (side, side, 3).

    Returns:
        Shape (channels, side, side).
    """
    height = p_TP[..., 2]
    is_measured = np.isfinite(height)
    filled = np.clip(np.nan_to_num(fill_holes(height)), -0.1, 0.9)
    slopes = np.gradient(gaussian_filter(filled, 1.0))
    angles = [np.arctan(slope / PIXEL_SIZE) for slope in slopes]
    channels = [filled / HEIGHT_UNIT, is_measured, *angles]
    if color is not None:
        channels += [color[..., k] / 127.5 - 1.0 for k in range(3)]
    return np.stack(channels).astype(np.float32)


def _current_name(parameter: str) -> str:
    """Return the name of a parameter that a checkpoint may hold under an earlier name."""
    module, dot, rest = parameter.partition(".")
    return RENAMED_MODULES.get(module, module) + dot + rest


def _conv_block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class SegmentationNetwork(nn.Module):
    """U-Net (Ronneberger et al. 2015) with additive skip connections.

    Attributes:
        classes: Names of the object classes.
        use_color: Whether the input has color channels.
        temperature: Calibrates the class probabilities of detections, see
            `drake_clutter.perception.calibration`.
        use_bfloat16: Whether convolutions on the CPU are computed in bfloat16.
    """

    def __init__(self, classes: Sequence[str], use_color: bool, temperature: float = 1.0) -> None:
        super().__init__()
        self.classes = tuple(classes)
        self.use_color = use_color
        self.temperature = temperature
        self.use_bfloat16 = HAS_FAST_BFLOAT16
        in_channels = OUTPUT_STRIDE**2 * (7 if use_color else 4)
        steps = list(pairwise(CHANNELS))
        self.stem = nn.Sequential(
            nn.PixelUnshuffle(OUTPUT_STRIDE), _conv_block(in_channels, CHANNELS[0])
        )
        self.down = nn.ModuleList(
            nn.Sequential(_conv_block(a, b, 2), _conv_block(b, b)) for a, b in steps
        )
        self.bottleneck = _conv_block(CHANNELS[-1], CHANNELS[-1])
        self.lateral = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in reversed(steps))
        self.up = nn.ModuleList(_conv_block(a, a) for a, _ in reversed(steps))
        self.out = nn.Conv2d(CHANNELS[0], 1 + len(classes) + 3, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return class logits and votes of each cell.

        Args:
            image: Input channels, see `make_network_input`. Shape (B, channels, side, side).

        Returns:
            Logits, of no object and of each class, shape (B, 1 + classes, side / 2, side / 2), and
            votes, the offsets of the object's center from the cell's point [m], shape
            (B, 3, side / 2, side / 2).
        """
        with torch.autocast(
            image.device.type, torch.bfloat16, enabled=image.is_cuda or self.use_bfloat16
        ):
            x = self.stem(image)
            skipped = []
            for down in self.down:
                skipped.append(x)
                x = down(x)
            x = self.bottleneck(x)
            for lateral, up in zip(self.lateral, self.up, strict=True):
                x = up(nn.functional.interpolate(lateral(x), scale_factor=2.0) + skipped.pop())
            output = self.out(x).float()
        return output[:, :-3], output[:, -3:] * VOTE_UNIT

    def warm_start(self, pretrained: "SegmentationNetwork") -> None:
        """Copy weights of another network, as far as both networks have them.

        Weights of new input channels are zero, so the outputs for common classes are those of the
        other network, whatever the color is.
        """
        first_layer = "stem.1.0.weight"
        shared = {
            name: value
            for name, value in pretrained.state_dict().items()
            if not name.startswith((first_layer, "out."))
        }
        self.load_state_dict(shared, strict=False)
        first = self.get_parameter(first_layer)
        pretrained_first = pretrained.get_parameter(first_layer)
        # The channels of depth come first.
        num_shared_channels = min(first.shape[1], pretrained_first.shape[1])
        rows, pretrained_rows = self._output_rows(), pretrained._output_rows()
        with torch.no_grad():
            first.zero_()
            first[:, :num_shared_channels] = pretrained_first[:, :num_shared_channels]
            for name in rows.keys() & pretrained_rows.keys():
                for parameter, pretrained_parameter in zip(
                    self.out.parameters(), pretrained.out.parameters(), strict=True
                ):
                    parameter[rows[name]] = pretrained_parameter[pretrained_rows[name]]

    def _output_rows(self) -> dict[str | int, int]:
        """Return the output channel of no object (""), of each class and of each vote axis."""
        names: tuple[str | int, ...] = ("", *self.classes, 0, 1, 2)
        return {name: row for row, name in enumerate(names)}

    @staticmethod
    def load(path: Path) -> "SegmentationNetwork":
        """Return the network of a checkpoint of `training/train_detector.py` in evaluation mode.

        Raises:
            InputError: The file cannot be read or is not a detector's checkpoint.
        """
        checkpoint = load_checkpoint(path)
        metadata = {RENAMED_METADATA.get(key, key): v for key, v in checkpoint.metadata.items()}
        if checkpoint.kind != CHECKPOINT_KIND:
            raise input_error(
                str(path),
                f"is a checkpoint of a {checkpoint.kind}; expected one of a {CHECKPOINT_KIND}",
            )
        known = validate(_DetectorMetadata, metadata, str(path.with_suffix(".json")))
        network = SegmentationNetwork(known.classes, known.use_color, known.temperature)
        weights = {_current_name(name): value for name, value in checkpoint.weights.items()}
        load_weights(network, weights, path)
        return network.eval()


class _DetectorMetadata(BaseModel):
    """What a detector needs of the metadata of its checkpoint."""

    classes: Annotated[tuple[NonEmptyText, ...], Field(min_length=1)]
    use_color: Flag
    temperature: Positive = 1.0


def class_weights(class_maps: Sequence[NDArray[np.int64]], num_classes: int) -> Tensor:
    """Return the class weights of the cross entropy.

    A weight is inversely proportional to the square root of the class's share of the cells, and the
    mean weight over all cells is 1. With equal weights the network would learn the tray first,
    which covers nine tenths of an image, and small objects very late.

    Args:
        class_maps: Class maps of images, see `segmentation_loss`.
        num_classes: Number of classes without that of no object.

    Returns:
        Shape (1 + num_classes,).
    """
    known = np.concatenate([class_map[class_map >= 0] for class_map in class_maps])
    counts = np.bincount(known, minlength=1 + num_classes)
    fractions = np.maximum(counts / max(1, len(known)), 1e-4)
    return torch.from_numpy(fractions**-0.5 / (fractions**0.5).sum()).float()


def segmentation_loss(
    logits: Tensor, votes: Tensor, class_map: Tensor, center_offsets: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the cross entropy of the classes and the mean L1 error of the votes [m].

    Args:
        logits: See `SegmentationNetwork.forward`.
        votes: See `SegmentationNetwork.forward` [m].
        class_map: True class of each cell plus 1; 0: no object, -1: unknown. Shape (B, h, w).
        center_offsets: True offset of the object's center from the cell's point [m]; NaN: unknown.
            Shape (B, 3, h, w).
        weights: Class weights. Shape (1 + classes,).
    """
    cross_entropy = nn.functional.cross_entropy(logits, class_map, weights, ignore_index=-1)
    has_vote = torch.isfinite(center_offsets).all(dim=1) & (class_map > 0)
    error = (votes - torch.nan_to_num(center_offsets)).abs().sum(dim=1)[has_vote]
    return cross_entropy, error.mean() if len(error) else votes.sum() * 0
