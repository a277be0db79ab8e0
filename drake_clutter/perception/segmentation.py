"""A network that tells, from depth or from depth and colour, what stands where (SPEC section 4, "Sensing").

For every second pixel each way it says of which class the object there is, and where the middle of that object is. What votes
for the same place is one object (as in Qi et al. 2019, "Deep Hough voting for 3D object detection in point clouds"): unlike the
middles of masks in the image, the middles of two objects never coincide, also when one lies across the other.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor, nn

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.support import Support
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import load_checkpoint

Scalar = TypeVar("Scalar", bound=np.generic)

CHECKPOINT_KIND = "detector"
"""Kind of its checkpoints."""
RENAMED_METADATA = {"looks_at_color": "use_color"}
"""Current keys of a checkpoint's metadata by earlier ones."""
RENAMED_MODULES = {"into": "stem", "middle": "bottleneck", "narrow": "lateral"}
"""Current names of the network's modules by earlier ones."""
OUTPUT_STRIDE = 2
"""Pixels, each way, for one answer."""
WINDOW_MULTIPLE = 16
MAX_SCENE_HEIGHT = 0.5
"""m, that objects reach: at the tray's edge they must be in the window."""
CHANNELS = (24, 48, 96, 128)
HEIGHT_UNIT, VOTE_UNIT = 0.25, 0.05
"""m, in which the network is given heights, and answers with votes."""
HAS_FAST_BFLOAT16 = bool(torch.cpu.get_capabilities().get("amx_bf16"))
"""Whether the processor multiplies matrices of such numbers by itself: then the network takes a third of the time."""
PIXEL_SIZE = 0.0025
"""m, about, from pixel to pixel: for slopes."""


@dataclass(frozen=True)
class ImageWindow:
    """The square part of the image that holds the tray.

    Attributes:
        rows, columns: of the image.
    """

    rows: slice
    columns: slice

    @staticmethod
    def around_support(camera: Camera, support: Support) -> "ImageWindow":
        """Of a camera that looks at a support."""
        size = np.array([camera.width, camera.height])
        middle, wanted = camera.support_bounds(support, MAX_SCENE_HEIGHT) or (
            np.array(camera.principal_point),
            math.inf,
        )
        side = min(size) // WINDOW_MULTIPLE * WINDOW_MULTIPLE
        if wanted < side:
            side = WINDOW_MULTIPLE * math.ceil(wanted / WINDOW_MULTIPLE)
        left, top = np.clip(
            np.floor(middle + 1 - side / 2 + 1e-6).astype(int), 0, size - side
        ).tolist()
        return ImageWindow(slice(top, top + side), slice(left, left + side))

    @property
    def side(self) -> int:
        """Pixels."""
        return int(self.rows.stop - self.rows.start)


def backproject_window(
    depth: NDArray[np.float32], camera: Camera, window: ImageWindow
) -> NDArray[np.float32]:
    """(side, side, 3) p_TP, m, of what the pixels of a window show; NaN where nothing is measured.

    Args:
        depth: (height, width) m along the camera's axis; 0 or infinite where nothing is measured.
    """
    z = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)[window.rows, window.columns]
    row, column = np.mgrid[window.rows, window.columns].astype(np.float32)
    return camera.backproject(np.stack([column, row], axis=-1), z).astype(np.float32)


def downsample(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Of (side, side, ...) what belongs to the network's answers."""
    return array[::OUTPUT_STRIDE, ::OUTPUT_STRIDE]


def upsample(
    mask: NDArray[np.bool_], window: ImageWindow, image_shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """A mask of the network's answers as one of the image, of a shape."""
    found = np.zeros(image_shape, bool)
    found[window.rows, window.columns] = mask.repeat(OUTPUT_STRIDE, axis=0).repeat(
        OUTPUT_STRIDE, axis=1
    )
    return found


def fill_holes(image: NDArray[np.floating]) -> NDArray[np.floating]:
    """An image (height, width), where it is not finite the value of the nearest pixel that is."""
    holes = ~np.isfinite(image)
    if not holes.any() or holes.all():
        return image
    nearest = distance_transform_edt(holes, return_distances=False, return_indices=True)
    return np.asarray(image[tuple(nearest)])


def make_network_input(
    points_T: NDArray[np.floating], color: NDArray[np.number] | None
) -> NDArray[np.float32]:
    """(channels, side, side) what the network is given: heights, where they are known, slopes, and colour if it looks at that.

    Slopes are given because a few millimetres, which tell a lid from a wall, are nothing beside a stack's height.

    Args:
        points_T: see `points`.
        color: (side, side, 3), of the window.
    """
    height = points_T[..., 2]
    known = np.isfinite(height)
    filled = np.clip(np.nan_to_num(fill_holes(height)), -0.1, 0.9)
    slopes = np.gradient(gaussian_filter(filled, 1.0))
    channels = [filled / HEIGHT_UNIT, known, *(np.arctan(slope / PIXEL_SIZE) for slope in slopes)]
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
    """A U-Net (Ronneberger et al. 2015) whose halves are joined by addition.

    Attributes:
        classes: names of what it knows.
        use_color: whether it is given colour beside depth.
    """

    def __init__(self, classes: Sequence[str], use_color: bool) -> None:
        super().__init__()
        self.classes, self.use_color = tuple(classes), use_color
        channels = OUTPUT_STRIDE**2 * (7 if use_color else 4)
        self.stem = nn.Sequential(
            nn.PixelUnshuffle(OUTPUT_STRIDE), _conv_block(channels, CHANNELS[0])
        )
        steps = list(pairwise(CHANNELS))
        self.down = nn.ModuleList(
            nn.Sequential(_conv_block(a, b, 2), _conv_block(b, b)) for a, b in steps
        )
        self.bottleneck = _conv_block(CHANNELS[-1], CHANNELS[-1])
        self.lateral = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in reversed(steps))
        self.up = nn.ModuleList(_conv_block(a, a) for a, _ in reversed(steps))
        self.out = nn.Conv2d(CHANNELS[0], 1 + len(classes) + 3, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B, 1 + classes, side / 2, side / 2), the first of no object, and votes (B, 3, ...), m, from the pixel's point.

        Args:
            image: (B, channels, side, side), see `network_input`.
        """
        with torch.autocast(
            image.device.type, torch.bfloat16, enabled=image.is_cuda or HAS_FAST_BFLOAT16
        ):
            x = self.stem(image)
            kept = []
            for down in self.down:
                kept.append(x)
                x = down(x)
            x = self.bottleneck(x)
            for lateral, up in zip(self.lateral, self.up, strict=True):
                x = up(nn.functional.interpolate(lateral(x), scale_factor=2.0) + kept.pop())
            found = self.out(x).float()
        return found[:, :-3], found[:, -3:] * VOTE_UNIT

    def warm_start(self, pretrained: "SegmentationNetwork") -> None:
        """Takes over what another has learned: answers as it does of the classes that both know, whatever the colours are."""
        first = "stem.1.0.weight"
        kept = {
            name: value
            for name, value in pretrained.state_dict().items()
            if not name.startswith((first, "out."))
        }
        self.load_state_dict(kept, strict=False)
        mine, theirs = (
            self.get_parameter(first),
            pretrained.get_parameter(first),
        )  # channels of depth come first
        both = min(mine.shape[1], theirs.shape[1])
        rows, other_rows = self._output_rows(), pretrained._output_rows()
        with torch.no_grad():
            mine.zero_()
            mine[:, :both] = theirs[:, :both]
            for name in rows.keys() & other_rows.keys():
                for own, others in zip(
                    self.out.parameters(), pretrained.out.parameters(), strict=True
                ):
                    own[rows[name]] = others[other_rows[name]]

    def _output_rows(self) -> dict[str | int, int]:
        """Which of the last layer's answers is about what: no object, each class, and the votes' x, y, z."""
        names: tuple[str | int, ...] = ("", *self.classes, 0, 1, 2)
        return {name: row for row, name in enumerate(names)}

    @staticmethod
    def load(path: Path) -> "SegmentationNetwork":
        """From a checkpoint of training/train_detector.py, ready to be asked.

        Raises:
            InputError: it cannot be read, or is none of a detector.
        """
        checkpoint = load_checkpoint(path)
        metadata = {RENAMED_METADATA.get(key, key): v for key, v in checkpoint.metadata.items()}
        kind = metadata.get("kind")
        if kind != CHECKPOINT_KIND:
            raise InputError(
                f"{path}: is a checkpoint of a {kind}; allowed is one of a {CHECKPOINT_KIND}"
            )
        network = SegmentationNetwork(metadata["classes"], metadata["use_color"])
        weights = {_current_name(name): value for name, value in checkpoint.weights.items()}
        network.load_state_dict(weights)
        return network.eval()


def class_weights(class_maps: Sequence[NDArray[np.int64]], num_classes: int) -> Tensor:
    """(1 + classes,) of the cross entropy: one over the root of a class's share of the pixels, and one on the mean of pixels.

    With equal weights nothing is learned for long but the tray, nine tenths of an image, and then the largest boxes.

    Args:
        class_maps: of images, see `loss`.
        num_classes: how many there are, beside that of no object.
    """
    shown = np.concatenate([kind[kind >= 0] for kind in class_maps])
    share = np.maximum(np.bincount(shown, minlength=1 + num_classes) / max(1, len(shown)), 1e-4)
    return torch.from_numpy(share**-0.5 / (share**0.5).sum()).float()


def segmentation_loss(
    logits: Tensor, votes: Tensor, class_map: Tensor, center_offsets: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Cross entropy of the classes, and the mean error of the votes, m.

    Args:
        logits, votes: see `SegmentationNetwork.forward`.
        class_map: (B, h, w) 0 where there is no object, -1 where it is not known.
        center_offsets: (B, 3, h, w) m, from the pixel's point to the object's middle; NaN where it is not known.
        weights: (1 + classes,) of the classes.
    """
    of_classes = nn.functional.cross_entropy(logits, class_map, weights, ignore_index=-1)
    known = torch.isfinite(center_offsets).all(dim=1) & (class_map > 0)
    error = (votes - torch.nan_to_num(center_offsets)).abs().sum(dim=1)[known]
    return of_classes, error.mean() if len(error) else votes.sum() * 0


@njit(cache=True)
def _densest_vote(votes, free, cell):  # type: ignore[no-untyped-def]
    """Of the votes that are free, or of every so many if they are many, that with most others near it; -1 if there is none."""
    left = np.flatnonzero(free)
    left = left[:: max(1, len(left) // 300)]
    best, found = 0, -1
    for n in range(len(left)):
        i, count = left[n], 0
        for j in left:
            x, y, z = (
                votes[i, 0] - votes[j, 0],
                votes[i, 1] - votes[j, 1],
                votes[i, 2] - votes[j, 2],
            )
            count += x * x + y * y + z * z < cell * cell
        if count > best:
            best, found = count, int(i)
    return found


@njit(cache=True)
def cluster_votes(votes, radius, min_votes):  # type: ignore[no-untyped-def]
    """(n,) for each of (n, 3) votes the number of the object that it is for; -1 for none.

    Again and again the place with most votes is taken, moved to their mean, and given all votes within `radius`, m, of it; one
    with fewer than `min_votes` votes is no object.
    """
    number = np.full(len(votes), -1)
    free = np.ones(len(votes), np.bool_)
    found = 0
    while True:
        first = _densest_vote(votes, free, radius)
        if first < 0:
            return number
        x, y, z = votes[first]
        for _ in range(3):
            total, sx, sy, sz = 0, 0.0, 0.0, 0.0
            for j in range(len(votes)):
                a, b, c = votes[j, 0] - x, votes[j, 1] - y, votes[j, 2] - z
                if free[j] and a * a + b * b + c * c < radius * radius:
                    total, sx, sy, sz = (
                        total + 1,
                        sx + votes[j, 0],
                        sy + votes[j, 1],
                        sz + votes[j, 2],
                    )
            if total > 0:
                x, y, z = sx / total, sy / total, sz / total
        total = 0
        for j in range(len(votes)):
            a, b, c = votes[j, 0] - x, votes[j, 1] - y, votes[j, 2] - z
            if free[j] and (j == first or a * a + b * b + c * c < radius * radius):
                free[j] = False
                number[j] = found
                total += 1
        if total < min_votes:
            number[number == found] = -2  # no object: it is not asked again
        else:
            found += 1


@dataclass(frozen=True)
class Segment:
    """Pixels that belong together.

    Attributes:
        name: of the class.
        mask: (height, width) bool.
        p_TO: (3,) m, where the middle of the object is said to be.
    """

    name: str
    mask: NDArray[np.bool_]
    p_TO: NDArray[np.float64]


def extract_segments(
    class_map: NDArray[np.int64],
    votes_T: NDArray[np.float32],
    radii: Sequence[float],
    names: Sequence[str],
    window: ImageWindow,
    image_shape: tuple[int, int],
    min_votes: int,
) -> list[Segment]:
    """Objects from the network's answers.

    Args:
        class_map: (h, w) 0 for no object, else number of the class + 1.
        votes_T: (h, w, 3) m, where the object's middle is; NaN where no depth is measured.
        radii: m, by class, within which votes are for the same object. names: of the classes.
        window: that was looked at. shape: of the image.
        min_votes: votes for an object.
    """
    found = []
    known = np.isfinite(votes_T).all(axis=2)
    for k, (name, radius) in enumerate(zip(names, radii, strict=True), start=1):
        rows, columns = np.nonzero((class_map == k) & known)
        if len(rows) < min_votes:
            continue
        votes = votes_T[rows, columns].astype(np.float64)
        number = cluster_votes(votes, radius, min_votes)
        for each in range(number.max() + 1):
            mine = number == each
            small = np.zeros(class_map.shape, bool)
            small[rows[mine], columns[mine]] = True
            found.append(
                Segment(name, upsample(small, window, image_shape), np.median(votes[mine], axis=0))
            )
    return found
