"""Check that objects of random scene graphs do not penetrate each other after the layout.

python benchmarks/layout_penetration.py --count 10000
"""

from collections import Counter
from typing import Annotated

import numpy as np
import typer

from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.grammar import NodeBudget, SceneGrammar, uniform_choice
from drake_clutter.scenes.geometry import max_penetration
from drake_clutter.scenes.layout import LayoutFailure, lay_out
from drake_clutter.seeding import item_rng
from drake_clutter.workers.parallel_map import map_ordered
from training.script import WorkersOption, run_script

TOLERANCE = 1e-9
"""Penetration of objects in contact that is due to rounding [m]."""
SEED = 2022
"""Seed of the scene graphs."""


class LayoutTester:
    """Lays out random graphs of 3 to 30 nodes; a worker for `map_ordered`."""

    def __init__(self) -> None:
        """Load the grammars of both object sets, which take turns."""
        catalog = load_catalog()
        self._grammars = [SceneGrammar(catalog.object_set(name)) for name in ("ycb7", "pantry14")]

    def __call__(self, index: int) -> tuple[str, float]:
        """Return the result for the graph of an index, and its deepest penetration [m]."""
        rng = item_rng(SEED, index)
        grammar = self._grammars[index % 2]
        derivation = grammar.derive(NodeBudget(int(rng.integers(3, 31))), uniform_choice(rng))
        scene = lay_out(derivation, grammar.classes, ClutterConfig(), rng)
        if isinstance(scene, LayoutFailure):
            return scene.reason.value, -np.inf
        return "laid out", max_penetration(scene.objects)[0]


def main(
    count: Annotated[int, typer.Option(min=1, help="Number of scene graphs.")] = 10_000,
    workers: WorkersOption = 1,
) -> None:
    """Print the number of layouts and the deepest penetration.

    The exit code is 1 if any two objects penetrate each other.
    """
    results = Counter[str]()
    deepest = -np.inf
    for result, depth in map_ordered(LayoutTester, range(count), workers=workers):
        results[result] += 1
        deepest = max(deepest, depth)
    print(f"{dict(results)}; deepest penetration {1000 * deepest:.3g} mm")
    if deepest > TOLERANCE:
        raise typer.Exit(1)


if __name__ == "__main__":
    run_script(main)
