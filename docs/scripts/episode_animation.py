"""Render the animation of the README from a recorded closed-loop episode.

drake-clutter demo --seed 0 --out out/demo
python docs/scripts/episode_animation.py out/demo/trajectory.h5 docs/images/episode.gif
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from drake_clutter import load_catalog, load_episode
from drake_clutter.reports.filmstrip import render_filmstrip
from drake_clutter.reports.recording import motion_frames

RATE = 5.0
"""Pictures per second of the recording."""
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
    episode = load_episode(trajectory, load_catalog())
    scene = episode.initial_scene
    motions = [action.samples for action in episode.actions if action.samples is not None]
    samples = [s for motion in motions for s in motion_frames(motion, scene.names, RATE)]
    strip = render_filmstrip(scene, samples, episode.cell, 480)
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
