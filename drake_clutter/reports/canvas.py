"""Drawing on images: outlines, dashed lines, arrows and labels that avoid each other.

Positions are pixels (x, y).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import binary_erosion, distance_transform_edt
from scipy.spatial import ConvexHull

_HALO = "#ffffff"
"""Color of the border around lines, arrows and labels."""


Rectangle = tuple[float, float, float, float]
"""Left, top, right and bottom [px]."""


@lru_cache
def load_font(size: int) -> ImageFont.FreeTypeFont:
    """Return a bold sans-serif font of a given height [px]."""
    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans-Bold.ttf"), size
    )


@dataclass(frozen=True)
class TextLabel:
    """Short text about a region of an image.

    Attributes:
        text: The text.
        anchor: Point (x, y) that the label is about.
        target: Region (left, top, right, bottom) that the label should not cover.
        color: Color of its box, or of its text if `subtle`.
        size: Height of the font [px].
        subtle: Draw dark text on a pale box, without a line to the anchor.
    """

    text: str
    anchor: tuple[float, float]
    target: Rectangle
    color: str
    size: int
    subtle: bool = False


@dataclass
class Canvas:
    """Image to draw on.

    Attributes:
        image: The RGB image.
        occupied: Rectangles (left, top, right, bottom) that labels avoid.
    """

    image: Image.Image
    occupied: list[Rectangle] = field(default_factory=list)

    @property
    def _draw(self) -> ImageDraw.ImageDraw:
        return ImageDraw.Draw(self.image, "RGBA")

    def draw_outline(
        self, mask: NDArray[np.bool_], corner: tuple[int, int], color: str, width: int
    ) -> None:
        """Draw the inner edge of a region.

        Args:
            mask: Pixels of the region. Shape (height, width).
            corner: Upper left corner of the mask in the image.
            color: Color of the line.
            width: Width of the line.
        """
        edge = mask & ~binary_erosion(mask, iterations=width)
        self.image.paste(Image.new("RGB", edge.shape[::-1], color), corner, Image.fromarray(edge))

    def draw_dashed_hull(self, points: NDArray[np.float64], color: str, width: int) -> None:
        """Draw the convex hull of points as a dashed line on a pale one.

        Args:
            points: The points. Shape (n, 2).
            color: Color of the line.
            width: Width of the line.
        """
        hull = points[ConvexHull(points).vertices]
        outline = [(float(x), float(y)) for x, y in (*hull, hull[0])]
        self._draw.line(outline, fill=_HALO + "a0", width=width + 4, joint="curve")
        dash = 5.0 * width
        remaining = dash
        drawing = True
        for (x0, y0), (x1, y1) in itertools.pairwise(outline):
            length = math.hypot(x1 - x0, y1 - y0)
            done = 0.0
            while done < length:
                step = min(remaining, length - done)
                a = done / length
                b = (done + step) / length
                if drawing:
                    ends = [
                        (x0 + a * (x1 - x0), y0 + a * (y1 - y0)),
                        (x0 + b * (x1 - x0), y0 + b * (y1 - y0)),
                    ]
                    self._draw.line(ends, fill=color, width=width)
                done += step
                remaining -= step
                if remaining <= 0:
                    remaining = 0.6 * dash if drawing else dash
                    drawing = not drawing

    def draw_arrow(
        self, start: tuple[float, float], end: tuple[float, float], color: str, width: int
    ) -> None:
        """Draw a slightly bent arrow; nothing if it would be shorter than its head.

        Args:
            start: Start of the shaft.
            end: Tip of the arrow.
            color: Color of the arrow.
            width: Width of the shaft.
        """
        a = np.asarray(start)
        b = np.asarray(end)
        along = b - a
        length = float(np.hypot(*along))
        head = 4.5 * width
        if length < 1.5 * head:
            return
        bend = (a + b) / 2 + 0.12 * np.array([along[1], -along[0]])
        t = np.linspace(0, 1, 40)[:, None]
        curve = (1 - t) ** 2 * a + 2 * t * (1 - t) * bend + t**2 * b
        direction = (b - bend) / np.hypot(*(b - bend))
        across = np.array([-direction[1], direction[0]])
        shaft = [(float(x), float(y)) for x, y in curve if np.hypot(*(b - [x, y])) > 0.8 * head]
        for fill, margin in ((_HALO, 4), (color, 0)):
            tip = b + 1.5 * margin * direction
            back = b - (head + margin) * direction
            wings = [back + side * (0.55 * head + 1.3 * margin) * across for side in (-1, 1)]
            self._draw.line(shaft, fill=fill, width=width + 2 * margin, joint="curve")
            self._draw.polygon([(float(x), float(y)) for x, y in (tip, *wings)], fill=fill)
        self.occupied += [(x - width, y - width, x + width, y + width) for x, y in shaft]

    def draw_labels(self, labels: Sequence[TextLabel]) -> None:
        """Draw labels near their anchors without overlap; earlier ones have priority."""
        placed_labels = []
        for label in labels:
            box = self._place_label(label)
            self.occupied.append(box)
            placed_labels.append((label, box))
        for label, (left, top, right, bottom) in placed_labels:
            x, y = label.anchor
            if not label.subtle and not (left <= x <= right and top <= y <= bottom):
                end = (min(max(x, left), right), min(max(y, top), bottom))
                self._draw.line([label.anchor, end], fill=_HALO, width=8)
                self._draw.line([label.anchor, end], fill=label.color, width=4)
                self._draw.ellipse(
                    (x - 7, y - 7, x + 7, y + 7), fill=label.color, outline=_HALO, width=2
                )
        for label, box in placed_labels:
            fill = "#ffffffd8" if label.subtle else label.color
            text_color = label.color if label.subtle else "#ffffff"
            self._draw.rounded_rectangle(
                box, label.size * 0.35, fill=fill, outline=None if label.subtle else _HALO, width=2
            )
            self._draw.text(
                ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2),
                label.text,
                text_color,
                load_font(label.size),
                anchor="mm",
            )

    def _place_label(self, label: TextLabel) -> Rectangle:
        """Return the rectangle of a label.

        Candidates lie on circles around the anchor. The cost is the area of overlap with occupied
        rectangles and the target, plus the distance from the anchor.
        """
        width = load_font(label.size).getlength(label.text) + 0.7 * label.size
        height = 1.4 * label.size
        target_area = max(1.0, _intersection_area(label.target, label.target))
        occlusion_weight = 0.0 if label.subtle else 16 * height / target_area
        best = (0.0, 0.0, width, height)
        best_cost = math.inf
        for radius, angle in itertools.product(
            np.arange(0, 12) * 0.8 * height, np.arange(12) * (math.pi / 6)
        ):
            distance_cost = 0.02 * height * radius
            if distance_cost >= best_cost:
                break
            x = label.anchor[0] + radius * math.cos(angle) * 1.5
            y = label.anchor[1] - radius * math.sin(angle)
            x = min(max(x, width / 2 + 4), self.image.width - width / 2 - 4)
            y = min(max(y, height / 2 + 4), self.image.height - height / 2 - 4)
            box = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
            cost = (
                distance_cost
                + occlusion_weight * _intersection_area(box, label.target)
                + sum(_intersection_area(box, other) for other in self.occupied)
            )
            if cost < best_cost:
                best = box
                best_cost = cost
        return best


def innermost_point(mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the point (x, y) of a region (height, width) farthest from its edge."""
    row, column = np.unravel_index(
        int(np.argmax(distance_transform_edt(np.pad(mask, 1)))), np.add(mask.shape, 2)
    )
    return float(column - 1), float(row - 1)


def _intersection_area(a: Rectangle, b: Rectangle) -> float:
    """Return the common area of two rectangles [px^2]."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return max(0.0, width) * max(0.0, height)
