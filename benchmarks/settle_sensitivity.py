"""Measure how verdicts on random stacks depend on the settings of the settling simulation.

python benchmarks/settle_sensitivity.py --count 150 --out settle_sensitivity.json
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import typer

from drake_clutter.agents.generators import RandomGenerator
from drake_clutter.catalog import RestOrientation, Shape, load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json
from drake_clutter.grammar import NodeBudget, SceneGrammar
from drake_clutter.scenes.geometry import group_touching_objects
from drake_clutter.scenes.layout import LayoutFailure, lay_out
from drake_clutter.scenes.scene import SceneObject, perturb_poses
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import TOUCHING_MARGIN
from drake_clutter.simulation.settle import settle
from training.results_file import provenance
from training.script import (
    ResultsOption,
    SeedOption,
    print_table,
    progress,
    run_script,
)

NEVER = 1_000_000
"""Number of samples that is never reached: disables the early stop."""
OTHER_OFFSETS = "other random offsets"
"""Settings under which each stack has its second set of random offsets."""
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "no early stop, 2.5 s": {
        "early_stop_samples": NEVER,
        "chatter_displacement": 0.0,
        "max_time": 2.5,
    },
    "calm, or 2 s": {"chatter_displacement": 0.0},
    "1 ms steps": {"time_step": 0.001},
    "4 ms steps": {"time_step": 0.004},
    OTHER_OFFSETS: {},
}
"""Fields of the settle configuration by the name of the settings."""


@dataclass(frozen=True)
class Stack:
    """Two or more objects that may touch, with two sets of random offsets.

    Attributes:
        objects: The objects with the first offsets.
        other_objects: The objects with the second offsets.
    """

    objects: list[SceneObject]
    other_objects: list[SceneObject]


def sample_stacks(count: int, nodes: int, seed: int, config: ClutterConfig) -> list[Stack]:
    """Return stacks of the random generator.

    Args:
        count: Number of stacks.
        nodes: Number of nodes of the scene graphs.
        seed: Seed of the scene graphs.
        config: Configuration of the layout and the offsets.
    """
    grammar = SceneGrammar(load_catalog().object_set("ycb7"))
    stacks = list[Stack]()
    index = 0
    while len(stacks) < count:
        rng = item_rng(seed, index)
        index += 1
        derivation = RandomGenerator().derive(grammar, NodeBudget(nodes), rng)
        scene = lay_out(derivation, grammar.classes, config, rng)
        if isinstance(scene, LayoutFailure):
            continue
        for group in group_touching_objects(scene.objects, TOUCHING_MARGIN):
            if len(group) > 1:
                first = perturb_poses(group, config.settle.jitter, rng)
                second = perturb_poses(group, config.settle.jitter, rng)
                stacks.append(Stack(first, second))
    return stacks[:count]


def lying_support(objects: Sequence[SceneObject]) -> str:
    """Return on what kind of lying cylinders an object rests.

    Returns:
        "single" for one cylinder, "pair" for two side by side, "" for none.
    """
    kind = ""
    for o in objects:
        if (
            o.object_class.shape is not Shape.CYLINDER
            or o.object_class.only_rest is RestOrientation.UPRIGHT
        ):
            continue
        is_loaded = any(abs(other.bounds_T[0][2] - o.top_height) < 1e-6 for other in objects)
        is_in_pair = any(
            other is not o
            and other.object_class is o.object_class
            and abs(other.X_TO.p[2] - o.X_TO.p[2]) < 1e-6
            for other in objects
        )
        if is_loaded:
            kind = "pair" if is_in_pair and kind != "single" else "single"
    return kind


def main(
    count: Annotated[int, typer.Option(min=1, help="Number of stacks.")] = 150,
    nodes: Annotated[int, typer.Option(min=3, help="Number of nodes of the scene graphs.")] = 25,
    seed: SeedOption = 0,
    out: ResultsOption = None,
) -> None:
    """Compare verdicts under all settings with those under the defaults."""
    config = ClutterConfig()
    stacks = sample_stacks(count, nodes, seed, config)
    stable = dict[str, list[bool]]()
    for name, changes in SETTINGS.items():
        settle_config = replace(config.settle, **changes)
        groups = [s.other_objects if name == OTHER_OFFSETS else s.objects for s in stacks]
        stable[name] = [
            settle(group, config.cell.support, settle_config).instability is None
            for group in progress(groups, name)
        ]
    rows = [
        {
            "setting": name,
            "agreement": float(np.mean(np.equal(verdicts, stable["default"]))),
            "stable_fraction": float(np.mean(verdicts)),
        }
        for name, verdicts in stable.items()
    ]
    on_lying_markers = dict[str, dict[str, int]]()
    for kind in ("single", "pair"):
        verdicts = [
            is_stable
            for stack, is_stable in zip(stacks, stable["default"], strict=True)
            if lying_support(stack.objects) == kind
        ]
        on_lying_markers[kind] = {"stacks": len(verdicts), "stable": sum(verdicts)}
    print_table(
        [
            {
                "settings": row["setting"],
                "agreement with the default": f"{row['agreement']:.3f}",
                "stable": f"{row['stable_fraction']:.3f}",
            }
            for row in rows
        ]
    )
    for kind, counts in on_lying_markers.items():
        print(f"on a {kind} of lying markers: {counts['stable']} of {counts['stacks']} stable")
    if out is not None:
        results = {
            "count": count,
            "nodes": nodes,
            "seed": seed,
            **provenance(),
            "settings": rows,
            "on_lying_markers": on_lying_markers,
        }
        write_json(out, results)


if __name__ == "__main__":
    run_script(main)
