"""A sheet of thumbnails: a batch of scenes at a glance."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from drake_clutter.files import atomic_write
from drake_clutter.reports.canvas import load_font

MAX_THUMBNAILS = 48
"""More would be too small to read."""
THUMBNAIL_SIDE = 240
CAPTION_HEIGHT = 46
_FRAME_WIDTH, _GAP, _FONT_SIZE = 5, 14, 16
_STABLE_COLOR, _UNSTABLE_COLOR, _BACKGROUND, _TEXT_COLOR = (
    "#2e9e5b",
    "#d23f31",
    "#ffffff",
    "#22272e",
)
TILE_SIZE = (
    THUMBNAIL_SIDE + 2 * _FRAME_WIDTH + _GAP,
    THUMBNAIL_SIDE + 2 * _FRAME_WIDTH + CAPTION_HEIGHT + _GAP,
)
"""Width and height of one thumbnail with frame, caption and gap, pixels; a sheet has one more gap at its left and top."""


def write_contact_sheet(path: Path, entries: Sequence[tuple[NDArray[np.uint8], str, bool]]) -> None:
    """Writes a PNG of thumbnails, row by row, each in a green frame (stable) or a red one.

    Args:
        path: the file.
        entries: (picture (height, width, 3), caption, whether it is stable) of each scene.

    Raises:
        ValueError: there are none, or more than `MAX_THUMBNAILS`.
    """
    if not 1 <= len(entries) <= MAX_THUMBNAILS:
        raise ValueError(f"{len(entries)} thumbnails; allowed are 1 to {MAX_THUMBNAILS}")
    columns = min(8, math.ceil(math.sqrt(1.4 * len(entries))))
    rows = math.ceil(len(entries) / columns)
    sheet = Image.new(
        "RGB", (columns * TILE_SIZE[0] + _GAP, rows * TILE_SIZE[1] + _GAP), _BACKGROUND
    )
    draw = ImageDraw.Draw(sheet)
    for index, (picture, caption, stable) in enumerate(entries):
        left, top = _GAP + index % columns * TILE_SIZE[0], _GAP + index // columns * TILE_SIZE[1]
        color, outer = (
            _STABLE_COLOR if stable else _UNSTABLE_COLOR,
            THUMBNAIL_SIDE + 2 * _FRAME_WIDTH,
        )
        draw.rectangle((left, top, left + outer - 1, top + outer + CAPTION_HEIGHT - 1), fill=color)
        draw.rectangle(
            (
                left + _FRAME_WIDTH,
                top + outer,
                left + outer - _FRAME_WIDTH - 1,
                top + outer + CAPTION_HEIGHT - 4,
            ),
            fill=_BACKGROUND,
        )
        thumbnail = Image.fromarray(picture)
        thumbnail.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE), Image.Resampling.LANCZOS)
        draw.rectangle(
            (
                left + _FRAME_WIDTH,
                top + _FRAME_WIDTH,
                left + outer - _FRAME_WIDTH - 1,
                top + outer - _FRAME_WIDTH - 1,
            ),
            fill=_BACKGROUND,
        )
        sheet.paste(
            thumbnail,
            (
                left + _FRAME_WIDTH + (THUMBNAIL_SIDE - thumbnail.width) // 2,
                top + _FRAME_WIDTH + (THUMBNAIL_SIDE - thumbnail.height) // 2,
            ),
        )
        _draw_caption(draw, caption, (left + outer / 2, top + outer + CAPTION_HEIGHT / 2 - 2))
    with atomic_write(path) as temporary:
        sheet.save(temporary)


def _draw_caption(draw: ImageDraw.ImageDraw, caption: str, center: tuple[float, float]) -> None:
    """One line, or two if it has a colon and is too long; smaller if that is still too long."""
    size, max_width = _FONT_SIZE, THUMBNAIL_SIDE - 6
    if load_font(size).getlength(caption) > max_width:
        caption = caption.replace(": ", ":\n", 1)
    while (
        size > 9
        and max(load_font(size).getlength(line) for line in caption.splitlines() or [""])
        > max_width
    ):
        size -= 1
    draw.multiline_text(center, caption, _TEXT_COLOR, load_font(size), anchor="mm", align="center")
