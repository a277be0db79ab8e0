"""Videos of recorded motions as MP4."""

import importlib.util
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_clutter.files import InputError, atomic_write

VIDEO_RATE = 25.0
"""Pictures per second of a video [Hz]."""
VIDEO_SIDE = 480
"""Side of the pictures of a video [px]."""


def check_video() -> None:
    """Check that videos can be written.

    Raises:
        InputError: The package that encodes them is missing.
    """
    if importlib.util.find_spec("av") is None:
        raise InputError("--mp4: needs av; install drake_clutter with [data]")


def write_video(path: Path, images: Iterable[NDArray[np.uint8]]) -> None:
    """Write images of one size as an MP4 file, which appears when it is complete.

    Args:
        path: File to write.
        images: RGB images. Shape (height, width, 3) each, with even sizes.
    """
    import av

    with atomic_write(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        stream = container.add_stream("libx264", Fraction(VIDEO_RATE))
        stream.pix_fmt = "yuv420p"
        for image in images:
            stream.height, stream.width, _ = image.shape
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
