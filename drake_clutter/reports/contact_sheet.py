"""Contact sheet: the thumbnails of many scenes in one image."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from drake_clutter.files import atomic_write
from drake_clutter.reports.canvas import load_font

MAX_THUMBNAILS = 48
"""Largest number of thumbnails that remain legible in one image."""
THUMBNAIL_SIDE = 240
"""Side of a thumbnail in pixels."""
CAPTION_HEIGHT = 46
"""Height of the caption below a thumbnail in pixels."""
_FRAME_WIDTH = 5
_GAP = 14
_FONT_SIZE = 16
_MIN_FONT_SIZE = 9
_STABLE_COLOR = "#2e9e5b"
_UNSTABLE_COLOR = "#d23f31"
_BACKGROUND = "#ffffff"
_TEXT_COLOR = "#22272e"
TILE_SIZE = (
    THUMBNAIL_SIDE + 2 * _FRAME_WIDTH + _GAP,
    THUMBNAIL_SIDE + 2 * _FRAME_WIDTH + CAPTION_HEIGHT + _GAP,
)
"""Width and height of a thumbnail with frame, caption and gap, in pixels.

A sheet has one more gap at its left and top.
"""


def write_contact_sheet(path: Path, entries: Sequence[tuple[NDArray[np.uint8], str, bool]]) -> None:
    """Write a PNG of thumbnails, row by row, in green (stable) or red (unstable) frames.

    Args:
        path: The file.
        entries: Image (height, width, 3), caption, and whether the scene is stable, of each scene.

    Raises:
        ValueError: There are no entries, or more than `MAX_THUMBNAILS`.
    """
    if not 1 <= len(entries) <= MAX_THUMBNAILS:
        raise ValueError(f"{len(entries)} thumbnails; expected 1 to {MAX_THUMBNAILS}")
    columns = min(8, math.ceil(math.sqrt(1.4 * len(entries))))
    rows = math.ceil(len(entries) / columns)
    sheet = Image.new(
        "RGB", (columns * TILE_SIZE[0] + _GAP, rows * TILE_SIZE[1] + _GAP), _BACKGROUND
    )
    draw = ImageDraw.Draw(sheet)
    outer = THUMBNAIL_SIDE + 2 * _FRAME_WIDTH
    for index, (image, caption, stable) in enumerate(entries):
        left = _GAP + index % columns * TILE_SIZE[0]
        top = _GAP + index // columns * TILE_SIZE[1]
        inner_left = left + _FRAME_WIDTH
        inner_top = top + _FRAME_WIDTH
        inner_right = left + outer - _FRAME_WIDTH - 1
        bottom = top + outer + CAPTION_HEIGHT
        color = _STABLE_COLOR if stable else _UNSTABLE_COLOR
        draw.rectangle((left, top, left + outer - 1, bottom - 1), fill=color)
        draw.rectangle((inner_left, top + outer, inner_right, bottom - 4), fill=_BACKGROUND)
        draw.rectangle(
            (inner_left, inner_top, inner_right, top + outer - _FRAME_WIDTH - 1), fill=_BACKGROUND
        )
        thumbnail = Image.fromarray(image)
        thumbnail.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE), Image.Resampling.LANCZOS)
        margin_x = (THUMBNAIL_SIDE - thumbnail.width) // 2
        margin_y = (THUMBNAIL_SIDE - thumbnail.height) // 2
        sheet.paste(thumbnail, (inner_left + margin_x, inner_top + margin_y))
        _draw_caption(draw, caption, (left + outer / 2, top + outer + CAPTION_HEIGHT / 2 - 2))
    with atomic_write(path) as temporary:
        sheet.save(temporary)


def _draw_caption(draw: ImageDraw.ImageDraw, caption: str, center: tuple[float, float]) -> None:
    """Draw a caption of one line, or of two if it is too long and contains a colon.

    The font is reduced where that is still too long.
    """
    size = _FONT_SIZE
    max_width = THUMBNAIL_SIDE - 6
    if load_font(size).getlength(caption) > max_width:
        caption = caption.replace(": ", ":\n", 1)
    lines = caption.splitlines() or [""]
    while size > _MIN_FONT_SIZE and max(load_font(size).getlength(s) for s in lines) > max_width:
        size -= 1
    draw.multiline_text(center, caption, _TEXT_COLOR, load_font(size), anchor="mm", align="center")
