"""Random generators that depend on a seed and on what they are for."""

import numpy as np


def item_rng(seed: int, *path: int) -> np.random.Generator:
    """A random generator of its own for every path under a seed, e.g. ``item_rng(seed, episode, step)``."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=path))
