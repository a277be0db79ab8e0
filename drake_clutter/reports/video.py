"""Videos of recorded motions as MP4."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_clutter.files import atomic_write

VIDEO_RATE = 25.0
"""Pictures per second of a video [Hz]."""
VIDEO_SIDE = 480
"""Side of the pictures of a video [px]."""


def write_video(path: Path, images: Iterable[NDArray[np.uint8]], times: Sequence[float]) -> None:
    """Write images of one size as an MP4 file, which appears when it is complete.

    Args:
        path: File to write.
        images: RGB images. Shape (height, width, 3) each, with even sizes.
        times: Time at which each image appears, to a period of `VIDEO_RATE` [s].
    """
    import av

    with atomic_write(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        stream = container.add_stream("libx264", Fraction(VIDEO_RATE))
        stream.pix_fmt = "yuv420p"
        last = -1
        for image, time in zip(images, times, strict=True):
            number = round(time * VIDEO_RATE)
            if number == last:
                continue
            if last < 0:
                stream.height, stream.width, _ = image.shape
            last = number
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = number, 1 / Fraction(VIDEO_RATE)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
