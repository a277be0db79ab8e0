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

Element = TypeVar("Element", bound=np.generic)

DETECTOR = "detector"
"""Kind of its checkpoints."""
COARSE = 2
"""Pixels, each way, for one answer."""
_MULTIPLE = 16
_HIGHEST = 0.5
"""m, that objects reach: at the tray's edge they must be in the window."""
_WIDTHS = (24, 48, 96, 128)
_HEIGHT_UNIT, _VOTE_UNIT = 0.25, 0.05
"""m, in which the network is given heights, and answers with votes."""
_FAST_BFLOAT16 = bool(torch.cpu.get_capabilities().get("amx_bf16"))
"""Whether the processor multiplies matrices of such numbers by itself: then the network takes a third of the time."""
_PIXEL = 0.0025
"""m, about, from pixel to pixel: for slopes."""


@dataclass(frozen=True)
class Window:
    """The square part of the image that holds the tray.

    Attributes:
        rows, columns: of the image.
    """

    rows: slice
    columns: slice

    @staticmethod
    def of(camera: Camera, support: Support) -> "Window":
        """Of a camera that looks at a support."""
        size = np.array([camera.width, camera.height])
        middle, wanted = camera.support_bounds(support, _HIGHEST) or (
            np.array(camera.principal_point),
            math.inf,
        )
        side = min(size) // _MULTIPLE * _MULTIPLE
        if wanted < side:
            side = _MULTIPLE * math.ceil(wanted / _MULTIPLE)
        left, top = np.clip(
            np.floor(middle + 1 - side / 2 + 1e-6).astype(int), 0, size - side
        ).tolist()
        return Window(slice(top, top + side), slice(left, left + side))

    @property
    def side(self) -> int:
        """Pixels."""
        return int(self.rows.stop - self.rows.start)


def points(depth: NDArray[np.float32], camera: Camera, window: Window) -> NDArray[np.float32]:
    """(side, side, 3) p_TP, m, of what the pixels of a window show; NaN where nothing is measured.

    Args:
        depth: (height, width) m along the camera's axis; 0 or infinite where nothing is measured.
    """
    z = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)[window.rows, window.columns]
    row, column = np.mgrid[window.rows, window.columns].astype(np.float32)
    return camera.backproject(np.stack([column, row], axis=-1), z).astype(np.float32)


def coarse(array: NDArray[Element]) -> NDArray[Element]:
    """Of (side, side, ...) what belongs to the network's answers."""
    return array[::COARSE, ::COARSE]


def fine(mask: NDArray[np.bool_], window: Window, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask of the network's answers as one of the image, of a shape."""
    found = np.zeros(shape, bool)
    found[window.rows, window.columns] = mask.repeat(COARSE, axis=0).repeat(COARSE, axis=1)
    return found


def without_holes(image: NDArray[np.floating]) -> NDArray[np.floating]:
    """An image (height, width), where it is not finite the value of the nearest pixel that is."""
    holes = ~np.isfinite(image)
    if not holes.any() or holes.all():
        return image
    nearest = distance_transform_edt(holes, return_distances=False, return_indices=True)
    return np.asarray(image[tuple(nearest)])


def network_input(
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
    filled = np.clip(np.nan_to_num(without_holes(height)), -0.1, 0.9)
    slopes = np.gradient(gaussian_filter(filled, 1.0))
    channels = [filled / _HEIGHT_UNIT, known, *(np.arctan(slope / _PIXEL) for slope in slopes)]
    if color is not None:
        channels += [color[..., k] / 127.5 - 1.0 for k in range(3)]
    return np.stack(channels).astype(np.float32)


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class SegmentationNetwork(nn.Module):
    """A U-Net (Ronneberger et al. 2015) whose halves are joined by addition.

    Attributes:
        classes: names of what it knows.
        looks_at_color: whether it is given colour beside depth.
    """

    def __init__(self, classes: Sequence[str], looks_at_color: bool) -> None:
        super().__init__()
        self.classes, self.looks_at_color = tuple(classes), looks_at_color
        channels = COARSE**2 * (7 if looks_at_color else 4)
        self.into = nn.Sequential(nn.PixelUnshuffle(COARSE), _block(channels, _WIDTHS[0]))
        steps = list(pairwise(_WIDTHS))
        self.down = nn.ModuleList(nn.Sequential(_block(a, b, 2), _block(b, b)) for a, b in steps)
        self.middle = _block(_WIDTHS[-1], _WIDTHS[-1])
        self.narrow = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in reversed(steps))
        self.up = nn.ModuleList(_block(a, a) for a, _ in reversed(steps))
        self.out = nn.Conv2d(_WIDTHS[0], 1 + len(classes) + 3, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B, 1 + classes, side / 2, side / 2), the first of no object, and votes (B, 3, ...), m, from the pixel's point.

        Args:
            image: (B, channels, side, side), see `network_input`.
        """
        with torch.autocast(
            image.device.type, torch.bfloat16, enabled=image.is_cuda or _FAST_BFLOAT16
        ):
            x = self.into(image)
            kept = []
            for down in self.down:
                kept.append(x)
                x = down(x)
            x = self.middle(x)
            for narrow, up in zip(self.narrow, self.up, strict=True):
                x = up(nn.functional.interpolate(narrow(x), scale_factor=2.0) + kept.pop())
            found = self.out(x).float()
        return found[:, :-3], found[:, -3:] * _VOTE_UNIT

    def begin_with(self, learned: "SegmentationNetwork") -> None:
        """Takes over what another has learned: answers as it does of the classes that both know, whatever the colours are."""
        first = "into.1.0.weight"
        kept = {
            name: value
            for name, value in learned.state_dict().items()
            if not name.startswith((first, "out."))
        }
        self.load_state_dict(kept, strict=False)
        mine, theirs = (
            self.get_parameter(first),
            learned.get_parameter(first),
        )  # channels of depth come first
        both = min(mine.shape[1], theirs.shape[1])
        rows, other_rows = self._rows(), learned._rows()
        with torch.no_grad():
            mine.zero_()
            mine[:, :both] = theirs[:, :both]
            for name in rows.keys() & other_rows.keys():
                for own, others in zip(
                    self.out.parameters(), learned.out.parameters(), strict=True
                ):
                    own[rows[name]] = others[other_rows[name]]

    def _rows(self) -> dict[str | int, int]:
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
        kind = checkpoint.about.get("kind")
        if kind != DETECTOR:
            raise InputError(f"{path}: is a checkpoint of a {kind}; allowed is one of a {DETECTOR}")
        network = SegmentationNetwork(
            checkpoint.about["classes"], checkpoint.about["looks_at_color"]
        )
        network.load_state_dict(checkpoint.weights)
        return network.eval()


def class_weights(kinds: Sequence[NDArray[np.int64]], classes: int) -> Tensor:
    """(1 + classes,) of the cross entropy: one over the root of a class's share of the pixels, and one on the mean of pixels.

    With equal weights nothing is learned for long but the tray, nine tenths of an image, and then the largest boxes.

    Args:
        kinds: of images, see `loss`.
        classes: how many there are, beside that of no object.
    """
    shown = np.concatenate([kind[kind >= 0] for kind in kinds])
    share = np.maximum(np.bincount(shown, minlength=1 + classes) / max(1, len(shown)), 1e-4)
    return torch.from_numpy(share**-0.5 / (share**0.5).sum()).float()


def loss(
    logits: Tensor, votes: Tensor, kind: Tensor, to_middle: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Cross entropy of the classes, and the mean error of the votes, m.

    Args:
        logits, votes: see `SegmentationNetwork.forward`.
        kind: (B, h, w) 0 where there is no object, -1 where it is not known.
        to_middle: (B, 3, h, w) m, from the pixel's point to the object's middle; NaN where it is not known.
        weights: (1 + classes,) of the classes.
    """
    of_classes = nn.functional.cross_entropy(logits, kind, weights, ignore_index=-1)
    known = torch.isfinite(to_middle).all(dim=1) & (kind > 0)
    error = (votes - torch.nan_to_num(to_middle)).abs().sum(dim=1)[known]
    return of_classes, error.mean() if len(error) else votes.sum() * 0


@njit(cache=True)
def _densest(votes, free, cell):  # type: ignore[no-untyped-def]
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
def gathered(votes, radius, least):  # type: ignore[no-untyped-def]
    """(n,) for each of (n, 3) votes the number of the object that it is for; -1 for none.

    Again and again the place with most votes is taken, moved to their mean, and given all votes within `radius`, m, of it; one
    with fewer than `least` votes is no object.
    """
    number = np.full(len(votes), -1)
    free = np.ones(len(votes), np.bool_)
    found = 0
    while True:
        first = _densest(votes, free, radius)
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
        if total < least:
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


def segments(
    kind: NDArray[np.int64],
    votes_T: NDArray[np.float32],
    radii: Sequence[float],
    names: Sequence[str],
    window: Window,
    shape: tuple[int, int],
    least: int,
) -> list[Segment]:
    """Objects from the network's answers.

    Args:
        kind: (h, w) 0 for no object, else number of the class + 1.
        votes_T: (h, w, 3) m, where the object's middle is; NaN where no depth is measured.
        radii: m, by class, within which votes are for the same object. names: of the classes.
        window: that was looked at. shape: of the image.
        least: votes for an object.
    """
    found = []
    known = np.isfinite(votes_T).all(axis=2)
    for k, (name, radius) in enumerate(zip(names, radii, strict=True), start=1):
        rows, columns = np.nonzero((kind == k) & known)
        if len(rows) < least:
            continue
        votes = votes_T[rows, columns].astype(np.float64)
        number = gathered(votes, radius, least)
        for each in range(number.max() + 1):
            mine = number == each
            small = np.zeros(kind.shape, bool)
            small[rows[mine], columns[mine]] = True
            found.append(Segment(name, fine(small, window, shape), np.median(votes[mine], axis=0)))
    return found
