"""Texture of an object class: a printed label with all faces in one image, an atlas.

The atlas of a box holds front and two sides, with the top above them; the back repeats the front,
the bottom the top. The atlas of a can holds the unrolled wrapper with the two ends above it.
Everything is drawn at a higher resolution and scaled down, which smooths the edges.
"""

import io
import math
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import matplotlib
from PIL import Image, ImageDraw, ImageFont

from drake_clutter.assets.motifs import MOTIFS, scatter_motif
from drake_clutter.assets.textured_mesh import Region
from drake_clutter.catalog import LabelDesign, ObjectClass, Shape, catalog_path
from drake_clutter.files import InputError

__all__ = ["MOTIFS", "Texture", "draw_texture", "encode_png"]

_TEXTURE_SIDE = 512
"""Longest side of an atlas [px]."""
_OVERSAMPLING = 3
"""Resolution of drawing, as a multiple of that of the atlas."""
_MAX_PIXELS_PER_MM = 6.0
"""Highest resolution of an atlas [px/mm]."""
_PALETTE_SIZE = 96
"""Number of colors of a PNG file."""
_MAX_TITLE_LENGTH = 24
"""Largest number of characters of a title."""
_METAL_COLOR, _DARK_METAL_COLOR, _LIGHT_METAL_COLOR = "#b4b8bd", "#8d9298", "#d6d9dc"
_INK_COLOR = "#1c1c1c"


@dataclass(frozen=True)
class Texture:
    """Texture of an object class.

    Attributes:
        image: The atlas: all faces in one image.
        regions: Regions of the atlas by face: front, back, right, left, top and bottom of a box;
            side, top and bottom of other shapes.
    """

    image: Image.Image
    regions: dict[str, Region]


@dataclass(frozen=True)
class _Panel:
    """One face while it is drawn.

    Attributes:
        image: The image.
        pixels_per_mm: Resolution [px/mm].
    """

    image: Image.Image
    pixels_per_mm: float

    @staticmethod
    def blank(width_mm: float, height_mm: float, pixels_per_mm: float, color: str) -> "_Panel":
        """Return a panel of one color."""
        return _Panel(
            Image.new(
                "RGB",
                (max(1, round(width_mm * pixels_per_mm)), max(1, round(height_mm * pixels_per_mm))),
                color,
            ),
            pixels_per_mm,
        )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.image.size

    def draw_rectangle(
        self, left: float, top: float, right: float, bottom: float, fill: str
    ) -> None:
        """Draw a rectangle of at least a pixel; the sides are fractions of width and height."""
        w, h = self.size
        ImageDraw.Draw(self.image).rectangle(
            (left * w, top * h, max(right * w - 1, left * w), max(bottom * h - 1, top * h)),
            fill=fill,
        )

    def draw_motif(
        self, name: str, accent: str, left: float, top: float, right: float, bottom: float
    ) -> None:
        """Draw a motif; the sides are fractions of the panel's width and height."""
        w, h = self.size
        area = Image.new(
            "RGB", (max(1, round((right - left) * w)), max(1, round((bottom - top) * h)))
        )
        scatter_motif(ImageDraw.Draw(area), area.size, MOTIFS[name], accent)
        self.image.paste(area, (round(left * w), round(top * h)))

    def draw_text(
        self,
        text: str,
        color: str,
        left: float,
        top: float,
        right: float,
        bottom: float,
        *,
        allow_rotation: bool = True,
    ) -> None:
        """Draw text as large as possible.

        It is set in one line, or with one word in each line, and rotated to read upwards where it
        is larger then. The sides of the area are fractions of the panel's width and height.
        """
        w, h = self.size
        box = ((right - left) * w, (bottom - top) * h)
        choices = [
            (lines, rotate)
            for lines in {text, text.replace(" ", "\n")}
            for rotate in ((False, True) if allow_rotation else (False,))
        ]
        size, lines, is_rotated = max(
            (
                (_font_size(lines, box[::-1] if rotate else box), lines, rotate)
                for lines, rotate in sorted(choices)
            )
        )
        if size < 4:
            return
        mask = _text_mask(lines, size)
        mask = mask.rotate(90, expand=True) if is_rotated else mask
        x, y = ((left + right) * w - mask.width) / 2, ((top + bottom) * h - mask.height) / 2
        self.image.paste(Image.new("RGB", mask.size, color), (round(x), round(y)), mask)


@lru_cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """Return the font of the labels in a size [px]."""
    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans-Bold.ttf"), size
    )


@lru_cache
def _text_extent(lines: str, size: int) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom of text in a font size [px]."""
    return ImageDraw.Draw(Image.new("L", (1, 1))).multiline_textbbox(
        (0, 0), lines, font=_font(size), align="center", spacing=size * 0.1
    )


def _font_size(lines: str, box: tuple[float, float]) -> int:
    """Return the largest font size in which text fits into a box [px].

    Args:
        lines: The text.
        box: Width and height of the box [px].
    """
    left, top, right, bottom = _text_extent(lines, 100)
    return int(100 * min(box[0] / max(1, right - left), box[1] / max(1, bottom - top)))


def _text_mask(lines: str, size: int) -> Image.Image:
    """Return an image of text, to be used as a mask."""
    left, top, right, bottom = _text_extent(lines, size)
    mask = Image.new("L", (max(1, math.ceil(right - left)), max(1, math.ceil(bottom - top))))
    ImageDraw.Draw(mask).multiline_text(
        (-left, -top), lines, fill=255, font=_font(size), align="center", spacing=size * 0.1
    )
    return mask


def _draw_nutrition_table(width: int, height: int) -> Image.Image:
    """Return a white table: heading, rule, rows of gray text and numbers."""
    table = Image.new("RGB", (max(8, width), max(8, height)), "white")
    draw = ImageDraw.Draw(table)
    w, h = table.size
    draw.rectangle((0, 0, w - 1, h - 1), outline=_INK_COLOR, width=max(1, w // 60))
    draw.rectangle((w * 0.08, h * 0.06, w * 0.8, h * 0.13), fill=_INK_COLOR)
    draw.rectangle((w * 0.06, h * 0.18, w * 0.94, h * 0.205), fill=_INK_COLOR)
    for row in range(8):
        y = h * (0.25 + 0.09 * row)
        draw.rectangle(
            (w * 0.08, y, w * (0.35 + 0.05 * (row * 3 % 5)), y + h * 0.03), fill="#6d6d6d"
        )
        draw.rectangle((w * 0.8, y, w * 0.92, y + h * 0.03), fill="#6d6d6d")
    return table


def _draw_barcode(width: int, height: int) -> Image.Image:
    """Return an image of a bar code."""
    code = Image.new("RGB", (max(8, width), max(8, height)), "white")
    draw = ImageDraw.Draw(code)
    w, h = code.size
    x, step = w * 0.08, w * 0.84 / 59
    for index in range(30):
        bar = 1 + (index * 7 + index // 3) % 3
        if x + bar * step > w * 0.92:
            break
        draw.rectangle(
            (x, h * 0.1, x + bar * step * 0.9, h * (0.9 if index % 14 < 2 else 0.78)),
            fill=_INK_COLOR,
        )
        x += (bar + 1) * step
    return code


def _draw_front(panel: _Panel, label: LabelDesign, title: str, mass: float) -> None:
    """Draw the title on top, the motif below, and the weight at the bottom."""
    panel.draw_rectangle(0, 0, 1, 0.035, label.accent)
    slim = panel.size[1] > 2.5 * panel.size[0]
    motif_top = 0.42 if slim else 0.36
    panel.draw_text(title, label.accent, 0.07, 0.06, 0.93, motif_top - 0.02)
    panel.draw_motif(label.motif, label.accent, 0, motif_top, 1, 0.90)
    panel.draw_text(
        f"NET WT {1000 * mass:.0f} g", label.accent, 0.06, 0.925, 0.94, 0.975, allow_rotation=False
    )


def _draw_side(panel: _Panel, label: LabelDesign, title: str, *, nutrition: bool) -> None:
    """Draw a side of a box, with the nutrition table or the bar code."""
    w, h = panel.size
    panel.draw_rectangle(0, 0, 1, 0.035, label.accent)
    panel.draw_rectangle(0, 0.90, 1, 1, label.accent)
    panel.draw_text(title, label.accent, 0.15, 0.06, 0.85, 0.52)
    info_width = round(0.8 * w)
    if nutrition:
        info = _draw_nutrition_table(info_width, min(round(0.33 * h), round(1.6 * info_width)))
    else:
        info = _draw_barcode(info_width, min(round(0.25 * h), info_width))
    panel.image.paste(info, (round(0.1 * w), round(0.72 * h - info.height / 2)))


def _box_panels(object_class: ObjectClass, title: str, pixels_per_mm: float) -> dict[str, _Panel]:
    """Return the faces of a box."""
    label = object_class.label
    depth, width, height = (1000 * side for side in object_class.size)
    front = _Panel.blank(width, height, pixels_per_mm, label.base)
    _draw_front(front, label, title, object_class.mass)
    sides = [_Panel.blank(depth, height, pixels_per_mm, label.base) for _ in range(2)]
    for side, nutrition in zip(sides, (True, False), strict=True):
        _draw_side(side, label, title, nutrition=nutrition)
    top = _Panel.blank(width, depth, pixels_per_mm, label.base)
    top.draw_rectangle(0, 0, 0.05, 1, label.accent)
    top.draw_rectangle(0.95, 0, 1, 1, label.accent)
    top.draw_text(title, label.accent, 0.1, 0.12, 0.9, 0.88)
    return {"front": front, "right": sides[0], "left": sides[1], "top": top}


def _draw_wrapper(panel: _Panel, label: LabelDesign, title: str, mass: float) -> None:
    """Draw two fronts, and between them the nutrition table and the bar code."""
    w, h = panel.size
    panel.draw_motif(label.motif, label.accent, 0, 0.5, 1, 0.92)
    panel.draw_rectangle(0, 0.47, 1, 0.5, label.accent)
    for half in (0.0, 0.5):
        panel.draw_text(title, label.accent, half + 0.12, 0.08, half + 0.38, 0.46)
        panel.draw_text(
            f"NET WT {1000 * mass:.0f} g",
            label.accent,
            half + 0.14,
            0.94,
            half + 0.36,
            0.975,
            allow_rotation=False,
        )
    table = _draw_nutrition_table(round(0.11 * w), min(round(0.5 * h), round(0.2 * w)))
    panel.image.paste(table, (round(0.445 * w), round(0.5 * h - table.height / 2)))
    code = _draw_barcode(round(0.11 * w), round(0.08 * w))
    panel.image.paste(code, (round(0.885 * w), round(0.5 * h - code.height / 2)))


def _draw_metal_end(panel: _Panel) -> None:
    """Draw concentric pressed rings."""
    draw = ImageDraw.Draw(panel.image)
    w = panel.size[0]
    rings = (
        (1.0, _DARK_METAL_COLOR),
        (0.96, _LIGHT_METAL_COLOR),
        (0.88, _DARK_METAL_COLOR),
        (0.85, _METAL_COLOR),
        (0.7, _LIGHT_METAL_COLOR),
        (0.67, _METAL_COLOR),
        (0.5, _DARK_METAL_COLOR),
        (0.48, _METAL_COLOR),
    )
    for fraction, color in rings:
        inset = w * (1 - fraction) / 2
        draw.ellipse((inset, inset, w - inset, w - inset), fill=color)


def _draw_plastic_lid(panel: _Panel, label: LabelDesign, title: str) -> None:
    """Draw a plastic lid with the title."""
    draw = ImageDraw.Draw(panel.image)
    w = panel.size[0]
    for fraction, color in (
        (1.0, label.base),
        (0.86, label.accent),
        (0.82, label.base),
        (0.80, label.accent),
    ):
        inset = w * (1 - fraction) / 2
        draw.ellipse((inset, inset, w - inset, w - inset), fill=color)
    panel.draw_text(title, label.base, 0.2, 0.3, 0.8, 0.7, allow_rotation=False)


def _can_panels(object_class: ObjectClass, title: str, pixels_per_mm: float) -> dict[str, _Panel]:
    """Return the faces of a can."""
    label = object_class.label
    diameter, _, height = (1000 * side for side in object_class.size)
    side = _Panel.blank(math.pi * diameter, height, pixels_per_mm, label.base)
    _draw_wrapper(side, label, title, object_class.mass)
    rim = min(0.03, 3 / height)
    side.draw_rectangle(0, 1 - rim, 1, 1, _METAL_COLOR)
    top, bottom = (_Panel.blank(diameter, diameter, pixels_per_mm, _METAL_COLOR) for _ in range(2))
    _draw_metal_end(bottom)
    if MOTIFS[label.motif].plastic_lid:
        _draw_plastic_lid(top, label, title)
        side.draw_rectangle(0, 0, 1, 0.05, label.accent)
    else:
        _draw_metal_end(top)
        side.draw_rectangle(0, 0, 1, rim, _METAL_COLOR)
    return {"side": side, "top": top, "bottom": bottom}


def _marker_panels(
    object_class: ObjectClass, title: str, pixels_per_mm: float
) -> dict[str, _Panel]:
    """Return the faces of a marker.

    The barrel has the title along it, a cap on the upper third, and a plug at the bottom.
    """
    label = object_class.label
    diameter, _, height = (1000 * side for side in object_class.size)
    side = _Panel.blank(math.pi * diameter, height, pixels_per_mm, label.base)
    side.draw_rectangle(0, 0, 1, 0.36, label.accent)
    side.draw_rectangle(0, 0.375, 1, 0.39, label.accent)
    side.draw_rectangle(0, 0.94, 1, 1, label.accent)
    for third in range(3):
        side.draw_text(title, label.accent, third / 3 + 0.06, 0.44, third / 3 + 0.27, 0.88)
    top, bottom = (_Panel.blank(diameter, diameter, pixels_per_mm, label.accent) for _ in range(2))
    return {"side": side, "top": top, "bottom": bottom}


def _mesh_panels(object_class: ObjectClass, pixels_per_mm: float) -> dict[str, _Panel]:
    """Return the faces of a mesh object: a strip with a band in the accent color."""
    side = _Panel.blank(20, 200, pixels_per_mm, object_class.label.base)
    side.draw_rectangle(0, 0.12, 1, 0.30, object_class.label.accent)
    return {"side": side, "top": side, "bottom": side}


def _check_label(object_class: ObjectClass) -> tuple[LabelDesign, str]:
    """Return the label of a class, and the title to draw.

    Raises:
        InputError: A field of the label cannot be drawn.
    """
    label = object_class.label
    where = f"{catalog_path(object_class.folder.parent)}: classes.{object_class.name}.label"
    for field in ("base", "accent"):
        if not re.fullmatch(r"#[0-9a-fA-F]{6}", getattr(label, field)):
            raise InputError(
                f'{where}.{field}: {getattr(label, field)!r}; expected a color such as "#c8102e"'
            )
    if label.motif not in MOTIFS:
        raise InputError(f"{where}.motif: {label.motif!r}; expected {', '.join(MOTIFS)}")
    if len(label.title) > _MAX_TITLE_LENGTH:
        raise InputError(
            f"{where}.title: {label.title!r}; expected at most {_MAX_TITLE_LENGTH} characters"
        )
    return label, label.title.strip() or object_class.name.replace("_", " ")


def _atlas_size(object_class: ObjectClass) -> tuple[float, float]:
    """Return the width and height of all faces together [mm]."""
    x, y, z = (1000 * side for side in object_class.size)
    if object_class.shape is Shape.BOX:
        return y + 2 * x, z + x
    if object_class.shape is Shape.CYLINDER:
        return max(math.pi * x, 2 * x), z + x
    return 20, 200


def draw_texture(object_class: ObjectClass) -> Texture:
    """Return the texture of a class. The result is deterministic.

    Raises:
        InputError: A field of the label cannot be drawn.
    """
    label, title = _check_label(object_class)
    scale = min(_MAX_PIXELS_PER_MM, _TEXTURE_SIDE / max(_atlas_size(object_class)))
    pixels_per_mm = scale * _OVERSAMPLING
    if object_class.shape is Shape.BOX:
        panels = _box_panels(object_class, title, pixels_per_mm)
        rows = [["top"], ["front", "right", "left"]]
        copies = {"back": "front", "bottom": "top"}
    elif object_class.shape is Shape.CYLINDER:
        panels = (_marker_panels if label.motif == "marker" else _can_panels)(
            object_class, title, pixels_per_mm
        )
        rows, copies = [["top", "bottom"], ["side"]], {}
    else:
        panels = _mesh_panels(object_class, pixels_per_mm)
        rows, copies = [["side"]], {}
    width = max(sum(panels[name].size[0] for name in row) for row in rows)
    height = sum(panels[row[0]].size[1] for row in rows)
    atlas = Image.new("RGB", (width, height), label.base)
    regions: dict[str, Region] = {}
    y = 0
    for row in rows:
        x = 0
        for name in row:
            image = panels[name].image
            atlas.paste(image, (x, y))
            # Half a final pixel inside of the edge, so that colors of neighbors do not bleed in.
            inset = _OVERSAMPLING / 2
            edges = (x + inset, y + inset, x + image.width - inset, y + image.height - inset)
            regions[name] = (
                edges[0] / width,
                edges[1] / height,
                edges[2] / width,
                edges[3] / height,
            )
            x += image.width
        y += panels[row[0]].size[1]
    regions |= {copy: regions[original] for copy, original in copies.items()}
    final = (round(width / _OVERSAMPLING), round(height / _OVERSAMPLING))
    return Texture(atlas.resize(final, Image.Resampling.LANCZOS), regions)


def encode_png(image: Image.Image) -> bytes:
    """Return an image as a PNG file with a palette, which keeps it small."""
    buffer = io.BytesIO()
    image.quantize(_PALETTE_SIZE, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
