"""Is the judge's settling its own truth? Verdicts under finer and coarser steps and without the early stop, on RG stacks.

python benchmarks/settle_sensitivity.py --count 150 --out benchmarks/results/settle_settings.json
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from drake_clutter.agents.generators import RandomGenerator
from drake_clutter.catalog import RestOrientation, Shape, load_catalog
from drake_clutter.config import ClutterConfig, SettleConfig
from drake_clutter.files import write_json
from drake_clutter.grammar import NodeBudget, SceneGrammar
from drake_clutter.resources import git_commit
from drake_clutter.scenes.geometry import group_touching_objects
from drake_clutter.scenes.layout import LayoutFailure, lay_out
from drake_clutter.scenes.scene import SceneObject, perturb_poses
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import TOUCHING_MARGIN
from drake_clutter.simulation.settle import settle

NEVER = 1_000_000
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
    "other random offsets": {},
}


def stacks(
    count: int, nodes: int, seed: int, config: ClutterConfig
) -> list[tuple[list[SceneObject], list[SceneObject]]]:
    """RG stacks of two objects or more, each with two draws of its random offsets."""
    grammar = SceneGrammar(load_catalog().object_set("ycb7"))
    found: list[tuple[list[SceneObject], list[SceneObject]]] = []
    index = 0
    while len(found) < count:
        rng = item_rng(seed, index)
        index += 1
        scene = lay_out(
            RandomGenerator().derive(grammar, NodeBudget(nodes), rng), grammar.classes, config, rng
        )
        if isinstance(scene, LayoutFailure):
            continue
        for group in group_touching_objects(scene.objects, TOUCHING_MARGIN):
            if len(group) > 1:
                found.append(
                    (
                        perturb_poses(group, config.settle.jitter, rng),
                        perturb_poses(group, config.settle.jitter, rng),
                    )
                )
    return found[:count]


def rests_on_lying(group: list[SceneObject]) -> str:
    """ "single" or "pair" if something rests on a lying cylinder or on two side by side, else ""."""
    found = ""
    for o in group:
        if (
            o.object_class.shape is not Shape.CYLINDER
            or o.object_class.only_rest is RestOrientation.UPRIGHT
        ):
            continue
        loaded = any(abs(other.bounds_T[0][2] - o.top_height) < 1e-6 for other in group)
        beside = any(
            other is not o
            and other.object_class is o.object_class
            and abs(other.X_TO.p[2] - o.X_TO.p[2]) < 1e-6
            for other in group
        )
        if loaded:
            found = "pair" if beside and found != "single" else "single"
    return found


def main(
    count: Annotated[int, typer.Option(help="Stacks of two objects or more.")] = 150,
    nodes: int = 25,
    seed: int = 0,
    out: Annotated[Path | None, typer.Option(help="JSON to write.")] = None,
) -> None:
    """Prints and writes how often each setting agrees with the default, and how stacks on lying markers fare."""
    config = ClutterConfig()
    groups = stacks(count, nodes, seed, config)
    stable: dict[str, list[bool]] = {}
    for name, changes in SETTINGS.items():
        settle_config: SettleConfig = replace(config.settle, **changes)
        chosen = [second if name.startswith("other") else first for first, second in groups]
        stable[name] = [
            settle(group, config.cell.support, settle_config).instability is None
            for group in track(chosen, name, console=Console(stderr=True))
        ]
    table = Table("setting", "agrees with the default", "stable")
    rows: list[dict[str, Any]] = []
    for name, verdicts in stable.items():
        agreement = float(np.mean(np.equal(verdicts, stable["default"])))
        rows.append(
            {"setting": name, "agreement": agreement, "stable_share": float(np.mean(verdicts))}
        )
        table.add_row(name, f"{agreement:.3f}", f"{np.mean(verdicts):.3f}")
    lying = {}
    for kind in ("single", "pair"):
        fates = [
            held
            for (group, _), held in zip(groups, stable["default"], strict=True)
            if rests_on_lying(group) == kind
        ]
        lying[kind] = {"stacks": len(fates), "stable": sum(fates)}
        table.add_row(f"on a {kind} of lying markers", "", f"{sum(fates)} of {len(fates)}")
    Console().print(table)
    if out is not None:
        result = {
            "count": count,
            "nodes": nodes,
            "seed": seed,
            "commit": git_commit(),
            "settings": rows,
            "on_lying_markers": lying,
        }
        write_json(out, result)


if __name__ == "__main__":
    typer.run(main)
