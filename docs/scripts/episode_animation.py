"""Render the animation of the README from a recorded closed-loop episode.

drake-clutter demo --seed 0 --out out/demo
python docs/scripts/episode_animation.py out/demo/trajectory.h5 docs/images/episode.gif
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from drake_clutter import load_catalog, read_trajectories
from drake_clutter.reports.filmstrip import render_filmstrip

STRIDE = 8
"""Samples of the recording, 25 ms apart, per picture."""
PICTURE_DURATION = 80
"""Time for which a picture is shown [ms]."""
LAST_DURATION = 1500
"""Time for which the last picture is shown [ms]."""
CROP = (40, 0, 440, 480)
"""Left, upper, right and lower edge of what is kept of a picture [px]."""
COLORS = 80
"""Size of the palette."""


def main(trajectory: Path, animation: Path) -> None:
    """Write a GIF of all moves of a recording."""
    scene, cell, moves = read_trajectories(trajectory, load_catalog())
    samples = [s for _, motion in moves for s in (*motion[::STRIDE], motion[-1])]
    strip = render_filmstrip(scene, samples, cell, 480)
    size = strip.shape[0]
    pictures = [
        Image.fromarray(strip[:, k * size : (k + 1) * size]).crop(CROP) for k in range(len(samples))
    ]
    # One palette for all pictures keeps what does not move free of flicker, and the file small.
    middle = np.hstack([np.asarray(p) for p in pictures[:: max(1, len(pictures) // 4)]])
    palette = Image.fromarray(middle).quantize(COLORS, dither=Image.Dither.NONE)
    frames = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    durations = [PICTURE_DURATION] * (len(frames) - 1) + [LAST_DURATION]
    frames[0].save(
        animation,
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        optimize=True,
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
