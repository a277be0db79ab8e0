"""A sheet of thumbnails: a batch of scenes at a glance."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from drake_clutter.files import atomic_write
from drake_clutter.reports.drawing import font

MAX_THUMBNAILS = 48
"""More would be too small to read."""
THUMBNAIL_SIDE = 240
CAPTION_HEIGHT = 46
_FRAME, _GAP, _FONT_SIZE = 5, 14, 16
_STABLE, _UNSTABLE, _PAPER, _INK = "#2e9e5b", "#d23f31", "#ffffff", "#22272e"
TILE = (THUMBNAIL_SIDE + 2 * _FRAME + _GAP, THUMBNAIL_SIDE + 2 * _FRAME + CAPTION_HEIGHT + _GAP)
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
    sheet = Image.new("RGB", (columns * TILE[0] + _GAP, rows * TILE[1] + _GAP), _PAPER)
    draw = ImageDraw.Draw(sheet)
    for index, (picture, caption, stable) in enumerate(entries):
        left, top = _GAP + index % columns * TILE[0], _GAP + index // columns * TILE[1]
        colour, outer = _STABLE if stable else _UNSTABLE, THUMBNAIL_SIDE + 2 * _FRAME
        draw.rectangle((left, top, left + outer - 1, top + outer + CAPTION_HEIGHT - 1), fill=colour)
        draw.rectangle(
            (
                left + _FRAME,
                top + outer,
                left + outer - _FRAME - 1,
                top + outer + CAPTION_HEIGHT - 4,
            ),
            fill=_PAPER,
        )
        thumbnail = Image.fromarray(picture)
        thumbnail.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE), Image.Resampling.LANCZOS)
        draw.rectangle(
            (left + _FRAME, top + _FRAME, left + outer - _FRAME - 1, top + outer - _FRAME - 1),
            fill=_PAPER,
        )
        sheet.paste(
            thumbnail,
            (
                left + _FRAME + (THUMBNAIL_SIDE - thumbnail.width) // 2,
                top + _FRAME + (THUMBNAIL_SIDE - thumbnail.height) // 2,
            ),
        )
        _caption(draw, caption, (left + outer / 2, top + outer + CAPTION_HEIGHT / 2 - 2))
    with atomic_write(path) as temporary:
        sheet.save(temporary)


def _caption(draw: ImageDraw.ImageDraw, caption: str, middle: tuple[float, float]) -> None:
    """One line, or two if it has a colon and is too long; smaller if that is still too long."""
    size, room = _FONT_SIZE, THUMBNAIL_SIDE - 6
    if font(size).getlength(caption) > room:
        caption = caption.replace(": ", ":\n", 1)
    while (
        size > 9 and max(font(size).getlength(line) for line in caption.splitlines() or [""]) > room
    ):
        size -= 1
    draw.multiline_text(middle, caption, _INK, font(size), anchor="mm", align="center")
