"""Random generators derived from a seed and the identity of what they are for."""

import numpy as np


def item_rng(seed: int, *path: int) -> np.random.Generator:
    """Return an independent random generator for each path under a seed.

    Args:
        seed: Seed of a run.
        path: Identity of the item, for example the numbers of an episode and a step.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=path))
