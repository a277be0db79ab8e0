"""Motifs of product labels. A label is covered with the pieces of one motif."""

import math
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from PIL import ImageDraw

Point = tuple[float, float]
"""A point (x, y)."""


@dataclass(frozen=True)
class MotifPen:
    """Draws one piece in the unit circle, with x right and y down.

    Attributes:
        draw: The picture.
        center: Center of the piece [px].
        radius: Radius of the piece [px].
        angle: Rotation of the piece [rad].
        accent: Accent color of the label.
        rng: Random generator for differences between pieces.
    """

    draw: ImageDraw.ImageDraw
    center: Point
    radius: float
    angle: float
    accent: str
    rng: random.Random

    def _pixels(self, points: Iterable[Point]) -> list[Point]:
        """Return points of the piece in pixels of the picture."""
        c, s = math.cos(self.angle) * self.radius, math.sin(self.angle) * self.radius
        return [(self.center[0] + c * x - s * y, self.center[1] + s * x + c * y) for x, y in points]

    def polygon(self, points: Sequence[Point], fill: str) -> None:
        """Draw a filled polygon."""
        self.draw.polygon(self._pixels(points), fill=fill)

    def oval(self, x: float, y: float, a: float, b: float, fill: str) -> None:
        """Draw a filled ellipse with center (x, y) and half axes a and b."""
        turns = [2 * math.pi * i / 28 for i in range(28)]
        self.polygon([(x + a * math.cos(t), y + b * math.sin(t)) for t in turns], fill)

    def line(self, points: Sequence[Point], fill: str, width: float) -> None:
        """Draw an open line of a given width."""
        self.draw.line(
            self._pixels(points), fill=fill, width=max(1, round(width * self.radius)), joint="curve"
        )


def _dots(pen: MotifPen) -> None:
    pen.oval(0, 0, 0.6, 0.6, "#ffffff")


def _cracker(pen: MotifPen) -> None:
    notched = [(-0.72 + 0.18 * i, -0.72 + 0.05 * (i % 2)) for i in range(9)]
    outline = [
        (x * c - y * s, x * s + y * c)
        for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))
        for x, y in notched[:-1]
    ]
    pen.polygon([(1.08 * x, 1.08 * y) for x, y in outline], "#8a5320")
    pen.polygon(outline, "#e3a857")
    pen.oval(0, 0, 0.5, 0.5, "#ecb96d")
    for i in range(3):
        for j in range(3):
            pen.oval(0.4 * (i - 1), 0.4 * (j - 1), 0.08, 0.08, "#8a5320")


def _sugar_cube(pen: MotifPen) -> None:
    pen.polygon([(0, -0.95), (0.8, -0.5), (0, -0.05), (-0.8, -0.5)], "#ffffff")
    pen.polygon([(-0.8, -0.5), (0, -0.05), (0, 0.9), (-0.8, 0.45)], "#d7e0ee")
    pen.polygon([(0.8, -0.5), (0, -0.05), (0, 0.9), (0.8, 0.45)], "#b4c3dc")
    for _ in range(14):
        pen.oval(pen.rng.uniform(-0.7, 0.7), pen.rng.uniform(-0.35, 0.4), 0.03, 0.03, "#ffffff")


def _pudding_cup(pen: MotifPen) -> None:
    pen.oval(0, 0.82, 0.95, 0.14, "#c9b48c")
    pen.polygon([(-0.85, -0.2), (0.85, -0.2), (0.5, 0.8), (-0.5, 0.8)], "#6b3a1c")
    pen.polygon([(-0.85, -0.2), (-0.6, -0.2), (-0.35, 0.8), (-0.5, 0.8)], "#8a5230")
    pen.oval(0, -0.2, 0.85, 0.2, "#7d4524")
    for y, a in ((-0.3, 0.5), (-0.48, 0.38), (-0.64, 0.24)):
        pen.oval(0, y, a, 0.16, "#d9cdb8")
        pen.oval(0, y - 0.03, a, 0.14, "#fffaf0")
    pen.oval(0, -0.82, 0.13, 0.13, "#c2182b")


def _jelly(pen: MotifPen) -> None:
    pen.oval(0, 0.62, 0.98, 0.2, "#f7e9ef")
    scallops = [math.pi * i / 6 for i in range(7)]
    pen.polygon([(-0.85, 0.6), (-0.55, -0.5), (0.55, -0.5), (0.85, 0.6)], "#ff3d78")
    for t in scallops:
        pen.oval(-0.72 * math.cos(t), 0.6, 0.16, 0.14, "#ff3d78")
    for x in (-0.36, 0.0, 0.36):
        pen.polygon(
            [(x * 1.55 - 0.06, 0.6), (x - 0.04, -0.45), (x + 0.04, -0.45), (x * 1.55 + 0.06, 0.6)],
            "#d81f5c",
        )
    pen.oval(0, -0.5, 0.55, 0.16, "#ff86ad")
    pen.oval(-0.2, -0.54, 0.16, 0.05, "#ffffff")


def _coffee_bean(pen: MotifPen) -> None:
    pen.oval(0, 0, 0.95, 0.62, "#2b1509")
    pen.oval(0, -0.03, 0.88, 0.54, "#5f3516")
    pen.line([(-0.85, 0.05), (-0.4, 0.14), (0, 0), (0.4, -0.14), (0.85, -0.05)], "#2b1509", 0.13)


def _tomato(pen: MotifPen) -> None:
    pen.oval(0, 0.1, 0.92, 0.8, "#8f1410")
    pen.oval(-0.03, 0.07, 0.85, 0.74, "#df2b1f")
    pen.oval(-0.4, -0.18, 0.2, 0.13, "#ff9a85")
    for turn in range(5):
        t = math.radians(72 * turn - 90)
        tip = (0.5 * math.cos(t), -0.45 + 0.3 * math.sin(t))
        pen.polygon(
            [
                (-0.1 * math.sin(t), -0.45 + 0.1 * math.cos(t)),
                tip,
                (0.1 * math.sin(t), -0.45 - 0.1 * math.cos(t)),
            ],
            "#2f7d32",
        )
    pen.line([(0, -0.45), (0.08, -0.85)], "#2f7d32", 0.12)


def _flake(pen: MotifPen) -> None:
    turns = [2 * math.pi * i / 9 for i in range(9)]
    edge = [
        (r * math.cos(t), 0.8 * r * math.sin(t))
        for t in turns
        for r in (pen.rng.uniform(0.75, 1.0),)
    ]
    pen.polygon(edge, "#a85a12")
    pen.polygon(
        [(0.86 * x - 0.03, 0.86 * y - 0.04) for x, y in edge],
        pen.rng.choice(["#f6b73c", "#efa42e", "#f9c65a"]),
    )
    pen.oval(-0.1, -0.1, 0.32, 0.2, "#fbd988")


def _ring(pen: MotifPen) -> None:
    color = pen.rng.choice(["#e8413c", "#f08a24", "#7cc142", "#8e4bb5", "#f7f7f2"])
    turns = [2 * math.pi * i / 24 for i in range(25)]
    for radius, width, fill in ((0.66, 0.62, "#40526a"), (0.66, 0.48, color)):
        pen.line([(radius * math.cos(t), radius * math.sin(t)) for t in turns], fill, width)


def _oat(pen: MotifPen) -> None:
    kind = pen.rng.random()
    if kind < 0.2:
        pen.oval(0, 0, 0.6, 0.45, "#4a1c2e")
        pen.line([(-0.35, -0.1), (0.3, 0.1)], "#7b3a52", 0.1)
    elif kind < 0.35:
        pen.oval(0, 0, 0.95, 0.5, "#8a4f20")
        pen.line([(-0.8, 0), (0.8, 0)], "#b9793f", 0.12)
    else:
        pen.oval(0, 0, 0.9, 0.62, "#9c7434")
        pen.oval(-0.03, -0.04, 0.82, 0.54, pen.rng.choice(["#dcb878", "#e8c98d", "#d1a55e"]))
        pen.line([(-0.6, 0), (0.6, 0)], "#9c7434", 0.09)


def _spaghetti(pen: MotifPen) -> None:
    for i in range(-13, 14):
        low, high = (
            0.075 * i + pen.rng.uniform(-0.06, 0.06),
            0.075 * i + pen.rng.uniform(-0.06, 0.06),
        )
        pen.line(
            [(low, -1.2), (high, 1.2)], pen.rng.choice(["#c98f2b", "#e2b04a", "#b67a1c"]), 0.05
        )


def _lasagna_slice(pen: MotifPen) -> None:
    pen.oval(0, 0.72, 1.0, 0.16, "#ffffff")
    for i, color in enumerate(
        ["#f4cf73", "#c8321f", "#fff3cf", "#f4cf73", "#c8321f", "#fff3cf", "#f4cf73"]
    ):
        y = 0.62 - 0.16 * i
        wave = [(-0.8 + 0.1 * k, y + (0.04 if k % 2 else -0.04)) for k in range(17)]
        pen.polygon([*wave, *((x, below - 0.2) for x, below in reversed(wave))], color)
    pen.oval(0, -0.55, 0.8, 0.12, "#e6a83a")
    for x in (-0.45, 0.05, 0.5):
        pen.oval(x, -0.56, 0.12, 0.05, "#2f7d32")


def _tortilla_chip(pen: MotifPen) -> None:
    corner = [(0.95, 0.1), (-0.55, 0.8), (-0.5, -0.82)]
    pen.polygon(corner, "#8a4a08")
    pen.polygon([(0.88 * x, 0.88 * y) for x, y in corner], pen.rng.choice(["#f2b63d", "#eaa52a"]))
    for _ in range(7):
        pen.oval(pen.rng.uniform(-0.4, 0.3), pen.rng.uniform(-0.3, 0.3), 0.06, 0.06, "#b5651d")


def _crisp(pen: MotifPen) -> None:
    pen.oval(0, 0, 1.0, 0.68, "#a9791c")
    pen.oval(-0.03, -0.05, 0.93, 0.6, "#f4cf62")
    pen.oval(0, -0.15, 0.6, 0.28, "#fbe59b")
    for _ in range(6):
        pen.oval(pen.rng.uniform(-0.6, 0.6), pen.rng.uniform(-0.3, 0.35), 0.05, 0.05, "#3f7d2a")


def _marker_stroke(pen: MotifPen) -> None:
    pen.line([(-0.8, 0.3), (-0.3, -0.3), (0.1, 0.3), (0.6, -0.3)], pen.accent, 0.2)


@dataclass(frozen=True)
class Motif:
    """What a label is covered with.

    Attributes:
        draw_piece: Draws one piece.
        radius: Radius of a piece, as a fraction of the shorter side of the picture.
        random_orientation: Whether pieces are scattered with random rotations, or upright in rows.
        background: Color behind the pieces; the label's accent color when empty.
        plastic_lid: Whether a can has a plastic lid with its title instead of a metal end.
    """

    draw_piece: Callable[[MotifPen], None]
    radius: float
    random_orientation: bool = True
    background: str = ""
    plastic_lid: bool = False


MOTIFS: dict[str, Motif] = {
    "dots": Motif(_dots, 0.12),
    "crackers": Motif(_cracker, 0.30),
    "cubes": Motif(_sugar_cube, 0.20, random_orientation=False),
    "pudding": Motif(_pudding_cup, 0.46, random_orientation=False),
    "jelly": Motif(_jelly, 0.46, random_orientation=False),
    "beans": Motif(_coffee_bean, 0.15, plastic_lid=True),
    "tomato": Motif(_tomato, 0.40, random_orientation=False),
    "flakes": Motif(_flake, 0.15),
    "rings": Motif(_ring, 0.17),
    "oats": Motif(_oat, 0.12),
    "spaghetti": Motif(_spaghetti, 0.55, random_orientation=False, background="#8a5a12"),
    "layers": Motif(_lasagna_slice, 0.46, random_orientation=False),
    "chips": Motif(_tortilla_chip, 0.19, background="#a3202a"),
    "crisps": Motif(_crisp, 0.22, plastic_lid=True),
    "marker": Motif(_marker_stroke, 0.30, random_orientation=False),
}
"""The motifs by name."""


def scatter_motif(
    draw: ImageDraw.ImageDraw, size: tuple[int, int], motif: Motif, accent: str
) -> None:
    """Fill a picture with the pieces of a motif. The result is deterministic.

    Args:
        draw: The picture.
        size: Width and height of the picture [px].
        motif: The motif.
        accent: Accent color of the label.
    """
    width, height = size
    draw.rectangle((0, 0, width, height), fill=motif.background or accent)
    radius = motif.radius * min(size)
    columns, rows = (max(1, math.ceil(side / (1.75 * radius) - 0.5)) for side in size)
    rng = random.Random(0)
    cells = [
        (i + (0.5 if motif.random_orientation and j % 2 else 0), j)
        for j in range(rows + motif.random_orientation)
        for i in range(columns + motif.random_orientation)
    ]
    if motif.random_orientation:
        rng.shuffle(cells)  # so that pieces overlap in random order
    for i, j in cells:
        jitter = 0.18 * radius if motif.random_orientation else 0.0
        # Scattered pieces run over the edge; upright ones are centered in their cells.
        offset = 0.0 if motif.random_orientation else 0.5
        center = (
            (i + offset) * width / columns + rng.uniform(-jitter, jitter),
            (j + offset) * height / rows + rng.uniform(-jitter, jitter),
        )
        angle = rng.uniform(0, 2 * math.pi) if motif.random_orientation else 0.0
        motif.draw_piece(MotifPen(draw, center, radius, angle, accent, rng))
