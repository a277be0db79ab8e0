"""Compare installations of Drake: verdicts on the same scenes, and times.

Run `measure` with the Python interpreter of each installation. It writes a results file and, beside
it, a record file of the verdicts. `compare` prints a table of several installations:

    python benchmarks/drake_versions.py measure --out drake_1.51.json
    python benchmarks/drake_versions.py compare drake_1.51.json drake_1.58.json

PyTorch is not needed. The scenes are those of the random generator with 25 nodes; about half of
them are stable.
"""

import json
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from pydantic import BaseModel

from benchmarks.measurement import Stopwatch, describe_machine
from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.catalog import load_catalog
from drake_clutter.commands.explore_scene import explore_scene
from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json
from drake_clutter.records import read_jsonl, write_jsonl
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.station.station_simulation import TIME_STEP, StationSimulation
from drake_clutter.validation import Flag
from training.results_file import Row, provenance
from training.script import SCENES, print_table, progress, run_script

SEED = 3200
"""Seed of the generated scenes."""
NODES = 25
"""Number of nodes of the generated scene graphs."""
NUM_STEPS = 400
"""Number of steps of the station's plant that are timed."""
EPISODE_SET = "sg_star_15"
"""Scene dataset of the timed episodes, whose moves the arm carries out."""
EPISODE_SCENES = (1, 3, 5)
"""Indices of the timed scenes in `EPISODE_SET`."""
EXPLORER = "largest-clear"
"""Explorer of the timed episodes."""
MAX_MOVES = 20
"""Number of moves after which an episode ends."""


def load_scene_at_rest(number: int, config: ClutterConfig) -> Scene:
    """Return a scene of `EPISODE_SET` with its settled poses."""
    scenes = load_scene_dataset(SCENES / f"{EPISODE_SET}.json", load_catalog())
    return scenes.settled_scene(number, scenes.grammar, config)


def measure_steps(config: ClutterConfig) -> dict[str, float]:
    """Return the time of a step of the station's plant [ms], with all objects asleep and awake.

    The joints of sleeping objects are locked.
    """
    scene = load_scene_at_rest(EPISODE_SCENES[0], config)
    simulation = StationSimulation(config.cell, scene)
    milliseconds = dict[str, float]()
    for name, awake in (("asleep", set[str]()), ("awake", set(scene.names))):
        simulation._sleep.update(
            simulation.root, awake, simulation.gripper.status, expects_grasp=False
        )
        start_time = simulation.root.get_time()
        simulation.simulator.AdvanceTo(start_time + 0.1)
        start = time.perf_counter()
        simulation.simulator.AdvanceTo(start_time + 0.1 + NUM_STEPS * TIME_STEP)
        milliseconds[name] = 1000 * (time.perf_counter() - start) / NUM_STEPS
    return milliseconds


def measure(
    out: Annotated[Path, typer.Option(metavar="FILE", help="Results file to write (JSON).")],
    count: Annotated[int, typer.Option(min=1, help="Number of scenes to judge.")] = 300,
) -> None:
    """Judge scenes, and time settling and arm episodes, with this interpreter's Drake."""
    config = ClutterConfig()
    generator = SceneGenerator(GenerationJob("random", "ycb7", None, NODES, SEED, config))
    judge = DrakeJudge(config)
    stopwatch = Stopwatch()
    verdicts = list[dict[str, Any]]()
    for index in progress(range(count), "verdicts"):
        rng = item_rng(SEED, index)
        scene, _ = generator.lay_out(rng)
        verdict = stopwatch.measure("settle", partial(judge.judge, scene, rng))
        reason = verdict.instability.reason.value if verdict.instability else ""
        hidden = list(verdict.hidden)
        verdicts.append({"stable": verdict.stable, "reason": reason, "hidden": hidden})
    episodes = list[dict[str, Any]]()
    for number in progress(EPISODE_SCENES, "episodes"):
        scene = load_scene_at_rest(number, config)
        start = time.perf_counter()
        task = explore_scene(scene, EXPLORER, "arm", MAX_MOVES, number, config, lambda _: None)
        seconds = time.perf_counter() - start
        episodes.append({"scene": number, "moves": len(task.transitions), "seconds": seconds})
    settle_seconds = stopwatch.seconds["settle"]
    results = {
        **describe_machine("drake", "numpy"),
        **provenance(),
        "seed": SEED,
        "nodes": NODES,
        "count": count,
        "settle_seconds": {
            "median": float(np.median(settle_seconds)),
            "mean": float(np.mean(settle_seconds)),
        },
        "step_ms": measure_steps(config),
        "episodes": episodes,
        "episode_seconds_per_move": sum(e["seconds"] for e in episodes)
        / sum(e["moves"] for e in episodes),
    }
    write_json(out, results)
    header = {key: results[key] for key in ("drake", "python", "seed", "nodes", "count")}
    write_jsonl(verdicts_path(out), header, verdicts)


class VerdictRecord(BaseModel):
    """Record of a scene's verdict."""

    stable: Flag
    hidden: list[str]


def verdicts_path(results: Path) -> Path:
    """Return the record file of the verdicts that belong to a results file."""
    return results.with_suffix(".jsonl.gz")


def table_row(results: Row, reference: Row) -> dict[str, str]:
    """Return the results of an installation as cells of the printed table.

    Args:
        results: The results, with the `verdicts`.
        reference: Results of the installation that it is compared with.
    """
    pairs = list(zip(reference["verdicts"], results["verdicts"], strict=True))
    stable_pairs = [(a, b) for a, b in pairs if a["stable"] and b["stable"]]
    return {
        "Drake": results["drake"],
        "Python": results["python"],
        "stable": f"{np.mean([verdict['stable'] for verdict in results['verdicts']]):.3f}",
        "same stability": f"{np.mean([a['stable'] == b['stable'] for a, b in pairs]):.4f}",
        "same hidden": f"{np.mean([a['hidden'] == b['hidden'] for a, b in stable_pairs]):.4f}",
        "step, asleep (ms)": f"{results['step_ms']['asleep']:.2f}",
        "step, awake (ms)": f"{results['step_ms']['awake']:.2f}",
        "settle (s)": f"{results['settle_seconds']['median']:.3f}",
        "arm (s per move)": f"{results['episode_seconds_per_move']:.2f}",
    }


def compare(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", help="Files that `measure` wrote; the first is the reference."
        ),
    ],
) -> None:
    """Print the agreement of the verdicts with those of the first file, and the times."""
    results = [
        json.loads(path.read_text(encoding="utf-8"))
        | {"verdicts": read_jsonl(verdicts_path(path), VerdictRecord)[1:]}
        for path in files
    ]
    print_table([table_row(row, results[0]) for row in results])


if __name__ == "__main__":
    run_script(measure, compare)
