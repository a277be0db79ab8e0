"""Lays out random graphs of both object sets and measures the deepest penetration of any two objects.

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

ROUNDING = 1e-9
"""m; objects that touch may overlap by this much."""


class _Layouts:
    """Lays out the random graph of an index: 3 to 30 nodes, either object set."""

    def __init__(self) -> None:
        catalog = load_catalog()
        self._grammars = [SceneGrammar(catalog.object_set(name)) for name in ("ycb7", "pantry14")]

    def __call__(self, index: int) -> tuple[str, float]:
        """What came of it, and the deepest penetration, m."""
        rng = item_rng(2022, index)
        grammar = self._grammars[index % 2]
        derivation = grammar.derive(NodeBudget(int(rng.integers(3, 31))), uniform_choice(rng))
        scene = lay_out(derivation, grammar.classes, ClutterConfig(), rng)
        if isinstance(scene, LayoutFailure):
            return scene.reason.value, -np.inf
        return "laid out", max_penetration(scene.objects)[0]


def main(
    count: Annotated[int, typer.Option(help="Graphs to lay out.")] = 10_000, workers: int = 1
) -> None:
    """Prints how many were laid out and the deepest penetration among them; fails if any two objects overlap."""
    results: Counter[str] = Counter()
    deepest = -np.inf
    for result, depth in map_ordered(_Layouts, range(count), workers=workers):
        results[result] += 1
        deepest = max(deepest, depth)
    print(f"{dict(results)}; deepest penetration {1000 * deepest:.3g} mm")
    if deepest > ROUNDING:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
