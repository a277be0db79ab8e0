"""Compare two installations of Drake: verdicts of the same scenes, and what a settle, a step and an episode cost.

Each installation writes its own file, with the interpreter of its environment; it needs no PyTorch. Then the files are
compared:

    python benchmarks/drake_versions.py measure --out benchmarks/results/drake_versions/1.51.json
    python benchmarks/drake_versions.py compare benchmarks/results/drake_versions/*.json

Scenes are laid out by the random generator under a fixed seed, 25 nodes each: about half of them are stable.
"""

import json
import platform
import time
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.catalog import load_catalog
from drake_clutter.commands.explore_scene import explore_scene
from drake_clutter.config import ClutterConfig
from drake_clutter.files import cli_error_handler, write_json
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.station.station_simulation import TIME_STEP, StationSimulation

SEED, NODES = 3200, 25
"""Of the generated scenes."""
STEPS = 400
"""Of the plant, that are timed."""
EPISODES = ("sg_star_15", (1, 3, 5), "largest-clear")
"""Frozen set, scenes in it, and the explorer of the timed episodes, which the arm carries out."""

app = typer.Typer(no_args_is_help=True)


def _frozen(number: int, config: ClutterConfig) -> Scene:
    held = load_scene_dataset(resource_path(f"training/scenes/{EPISODES[0]}.json"), load_catalog())
    return held.settled_scene(number, held.grammar, config)


def _step_milliseconds(config: ClutterConfig) -> dict[str, float]:
    """Return what a step of the station's plant takes, with all objects asleep and with all awake [ms]."""
    scene = _frozen(EPISODES[1][0], config)
    simulation = StationSimulation(config.cell, scene)
    taken = dict[str, float]()
    for name, awake in (("asleep", set[str]()), ("awake", set(scene.names))):
        simulation._sleep.update(
            simulation.root, awake, simulation.gripper.status, expects_grasp=False
        )
        begin = simulation.root.get_time()
        simulation.simulator.AdvanceTo(begin + 0.1)
        start = time.perf_counter()
        simulation.simulator.AdvanceTo(begin + 0.1 + STEPS * TIME_STEP)
        taken[name] = 1000 * (time.perf_counter() - start) / STEPS
    return taken


@app.command()
def measure(
    out: Annotated[Path, typer.Option(metavar="FILE", help="JSON to write.")],
    count: Annotated[int, typer.Option(min=1, help="Scenes to judge.")] = 300,
) -> None:
    """Judge scenes and time settles and arm episodes with the Drake of this interpreter."""
    config = ClutterConfig()
    generator = SceneGenerator(GenerationJob("random", "ycb7", None, NODES, SEED, config))
    judge = DrakeJudge(config)
    verdicts, seconds = list[dict[str, Any]](), list[float]()
    for index in track(range(count), "verdicts", console=Console(stderr=True)):
        rng = item_rng(SEED, index)
        scene, _ = generator.lay_out(rng)
        start = time.perf_counter()
        verdict = judge.judge(scene, rng)
        seconds.append(time.perf_counter() - start)
        why = verdict.instability.reason.value if verdict.instability else ""
        verdicts.append({"stable": verdict.stable, "reason": why, "hidden": list(verdict.hidden)})
    episodes = list[dict[str, Any]]()
    for number in track(EPISODES[1], "episodes", console=Console(stderr=True)):
        start = time.perf_counter()
        task = explore_scene(
            _frozen(number, config), EPISODES[2], "arm", 20, number, config, lambda _: None
        )
        episodes.append(
            {
                "scene": number,
                "moves": len(task.transitions),
                "seconds": time.perf_counter() - start,
            }
        )
    write_json(
        out,
        {
            "python": platform.python_version(),
            "drake": version("drake"),
            "numpy": version("numpy"),
            "seed": SEED,
            "nodes": NODES,
            "count": count,
            "settle_seconds": {
                "median": float(np.median(seconds)),
                "mean": float(np.mean(seconds)),
            },
            "step_ms": _step_milliseconds(config),
            "episodes": episodes,
            "episode_seconds_per_move": sum(e["seconds"] for e in episodes)
            / sum(e["moves"] for e in episodes),
            "verdicts": verdicts,
        },
    )


@app.command()
def compare(
    files: Annotated[
        list[Path], typer.Argument(help="Files that `measure` wrote; the first is the reference.")
    ],
) -> None:
    """Print how often verdicts agree with those of the first file, and what things cost."""
    found = [json.loads(path.read_text(encoding="utf-8")) for path in files]
    table = Table(
        "Drake",
        "Python",
        "stable",
        "same stable",
        "same hidden",
        "step, ms (asleep, awake)",
        "settle, s",
        "arm, s per move",
    )
    for one in found:
        pairs = list(zip(found[0]["verdicts"], one["verdicts"], strict=True))
        same = np.mean([a["stable"] == b["stable"] for a, b in pairs])
        both = [(a, b) for a, b in pairs if a["stable"] and b["stable"]]
        hidden = np.mean([a["hidden"] == b["hidden"] for a, b in both])
        stable = np.mean([verdict["stable"] for verdict in one["verdicts"]])
        numbers = (f"{stable:.3f}", f"{same:.4f}", f"{hidden:.4f}")
        step = f"{one['step_ms']['asleep']:.2f}, {one['step_ms']['awake']:.2f}"
        costs = (
            step,
            f"{one['settle_seconds']['median']:.3f}",
            f"{one['episode_seconds_per_move']:.2f}",
        )
        table.add_row(one["drake"], one["python"], *numbers, *costs)
    Console().print(table)


if __name__ == "__main__":
    with cli_error_handler():
        app()
