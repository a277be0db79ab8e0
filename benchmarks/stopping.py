"""Measure how well explorers know that nothing is left to be found.

    python benchmarks/stopping.py rates --out benchmarks/results/hidden_rates.json
    python benchmarks/stopping.py episodes --out benchmarks/results/stopping.json

`rates` counts, in training scenes, the hidden objects that carry nothing, and the area in which
they could stand unseen: `exploration.belief.covered_rate` and `shadow_rate`. `episodes` runs
explorers that stop by their belief. Every episode is a record in the folder beside the results
file; an interrupted run is resumed by the same command.

Scenes 160 to 259 of sg_star_25 are left out.
"""

from functools import partial
from typing import Annotated

import numpy as np
import typer
from pydantic import BaseModel

from drake_clutter.agents.backend_factory import FIDELITIES, make_backend_factory
from drake_clutter.agents.explorers import PolicyFactory, make_policy_factory
from drake_clutter.belief.hidden_belief import estimate_hidden
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.perception.ray_detector import RayDetector
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_dataset import SceneDataset, load_scene_dataset, relayout
from drake_clutter.seeding import item_rng
from drake_clutter.statistics import wilson_interval
from drake_clutter.systems.image_backend import ImageBackend
from drake_clutter.systems.perception_system import with_image_tolerances
from drake_clutter.systems.scenario import PRETRAINED_DETECTORS, Scenario, make_perception
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import StopCriterion, TerminationReason
from drake_clutter.tasks.stopping import StoppingPolicy
from drake_clutter.validation import CountOrZero, Flag, NonEmptyText, to_plain
from training.results_file import ResultsFile, Row, collect_records, provenance
from training.script import (
    SCENES,
    ResultsOption,
    SeedOption,
    WorkersOption,
    format_number,
    print_table,
    progress,
    run_script,
)

MAX_SCENES = 160
"""Number of scenes of a set that may be used."""
PERFECT = "labels"
"""Name of the detector that uses the ground truth."""


class StoppingRecord(BaseModel):
    """Record of an episode.

    Attributes:
        ended: Value of the `TerminationReason`.
        found_all: Whether every object has been in view.
        moves: Number of moves.
        unneeded_moves: Number of moves after every object had been in view.
        nothing_left: Probability that every object is known, at each decision.
    """

    ended: NonEmptyText
    found_all: Flag
    moves: CountOrZero
    unneeded_moves: CountOrZero
    nothing_left: list[float]
    commit: str


def load_scene(scenes: SceneDataset, index: int, config: ClutterConfig, seed: int) -> Scene:
    """Return a scene of a dataset, laid out anew if the dataset has no poses."""
    if scenes.scenes[index].settled_poses is not None:
        return scenes.settled_scene(index, scenes.grammar, config)
    grammar = scenes.grammar
    return relayout(scenes.derivation(index, grammar), grammar, config, item_rng(seed, index))


class StoppingRunner:
    """Runs episodes; a worker for `map_ordered`."""

    def __init__(
        self, dataset: str, agent: str, fidelity: str, perception: str, seed: int, max_moves: int
    ) -> None:
        """Load the scenes.

        Args:
            dataset: Name of the scene dataset.
            agent: See `make_policy_factory`.
            fidelity: See `make_backend_factory`.
            perception: `PERFECT`, or a learned detector.
            seed: Seed of the episodes.
            max_moves: Maximum number of moves.
        """
        self._scenes = load_scene_dataset(SCENES / f"{dataset}.json", load_catalog())
        self._config = ClutterConfig()
        self._fidelity = fidelity
        self._perception = perception
        self._seed = seed
        self._max_moves = max_moves
        self._make_policy: PolicyFactory = make_policy_factory(agent, self._config)
        self._make_backend = make_backend_factory(fidelity, self._config)

    def __call__(self, index: int) -> Row:
        """Return the record of an episode, without its commit.

        Args:
            index: Index of the scene, from which the random generator is seeded.
        """
        config = self._config
        scene = load_scene(self._scenes, index, config, self._seed)
        if self._perception == PERFECT:
            backend = self._make_backend(scene, item_rng(self._seed, index))
        else:
            seed = int(item_rng(self._seed, index).integers(2**31))
            objects = self._scenes.metadata["objects"]
            scenario = Scenario(objects=objects, perception=self._perception, seed=seed)
            perceive = make_perception(scenario, scene)
            assert perceive is not None
            config = with_image_tolerances(config)
            backend = ImageBackend(scene, perceive, seed=seed, config=config)
        policy = StoppingPolicy(
            self._make_policy(backend),
            self._scenes.classes,
            backend.empty_depth,
            config.exploration.belief,
        )
        task = run_episode(backend, policy, max_moves=self._max_moves, until=StopCriterion.BELIEF)
        num_found = len(scene.objects) - len(task.initially_hidden)
        unneeded = 0
        decisions = []
        for transition in task.transitions:
            unneeded += num_found == len(scene.objects)
            num_found += len(transition.newly_found)
            decisions.append(transition.decision)
        if task.last_decision is not None:
            decisions.append(task.last_decision)
        assert task.termination is not None
        return {
            "ended": task.termination.value,
            "found_all": task.has_found_all,
            "moves": len(task.transitions),
            "unneeded_moves": unneeded,
            "nothing_left": [round(d.hidden.nothing_left, 6) for d in decisions if d.hidden],
        }


def summarize(records: list[Row]) -> Row:
    """Return the statistics of episodes."""
    count = len(records)
    stopped = [r for r in records if r["ended"] == TerminationReason.NOTHING_LEFT.value]
    right = [r for r in stopped if r["found_all"]]
    found = [r for r in records if r["found_all"]]
    unneeded = [r["unneeded_moves"] for r in found]
    return {
        "episodes": count,
        "right": len(right) / count,
        "right_ci95": wilson_interval(len(right), count),
        "found_all": len(found) / count,
        "stopped": len(stopped) / count,
        "right_of_stops": len(right) / len(stopped) if stopped else None,
        "right_of_stops_ci95": wilson_interval(len(right), len(stopped)) if stopped else None,
        "not_stopped_though_found": len(found) - len(right),
        "unneeded_moves": sum(unneeded) / len(unneeded) if unneeded else None,
        "most_unneeded_moves": max(unneeded, default=None),
        "commits": list(dict.fromkeys(record["commit"] for record in records)),
    }


def table_row(row: Row) -> dict[str, str]:
    """Return a row of the results as cells of the printed table."""
    return {
        **{key: str(row[key]) for key in ("set", "agent", "perception", "fidelity", "episodes")},
        "right": format_number(row["right"]),
        "all found": format_number(row["found_all"]),
        "stopped": format_number(row["stopped"]),
        "right of stops": format_number(row["right_of_stops"]),
        "unneeded moves": format_number(row["unneeded_moves"], 2),
    }


def episodes(
    out: ResultsOption,
    name: Annotated[str, typer.Option("--set", help="Scene dataset.")] = "sg_star_25",
    agent: Annotated[str, typer.Option(help="Explorer.")] = "student",
    fidelity: Annotated[
        str, typer.Option(help=f"Model of the moves: {', '.join(FIDELITIES)}.")
    ] = "settle",
    perception: Annotated[
        str, typer.Option(help=f"Detector: {PERFECT}, {', '.join(PRETRAINED_DETECTORS)}.")
    ] = PERFECT,
    count: Annotated[int, typer.Option(min=1, max=MAX_SCENES, help="Number of scenes.")] = 100,
    first: Annotated[
        int, typer.Option(min=0, max=MAX_SCENES - 1, help="Index of the first scene.")
    ] = 0,
    max_moves: Annotated[int, typer.Option(min=1, help="Maximum number of moves.")] = 20,
    seed: SeedOption = 3000,
    workers: WorkersOption = 1,
) -> None:
    """Run the episodes that are missing, and add their row to the results file."""
    if fidelity not in FIDELITIES:
        raise InputError(f"--fidelity {fidelity}; expected {', '.join(FIDELITIES)}")
    if perception != PERFECT and fidelity != "settle":
        raise InputError(f"--fidelity {fidelity}; expected settle with images")
    if first + count > MAX_SCENES:
        raise InputError(f"--count {count}: expected at most {MAX_SCENES - first} from --first")
    assert out is not None
    folder = out.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    results = ResultsFile(
        out, {"seed": seed, "moves": max_moves}, ("set", "agent", "perception", "fidelity")
    )
    scenes = load_scene_dataset(SCENES / f"{name}.json", load_catalog())
    key = {"set": name, "agent": agent, "perception": perception, "fidelity": fidelity}
    last = min(first + count, len(scenes.scenes))
    records = collect_records(
        folder / f"{name}_{agent}_{perception}_{fidelity}.jsonl.gz",
        key
        | {"sha256": scenes.sha256, "seed": seed, "moves": max_moves, "first": first}
        | {"config": to_plain(ClutterConfig())},
        partial(StoppingRunner, name, agent, fidelity, perception, seed, max_moves),
        range(first, last),
        schema=StoppingRecord,
        workers=workers,
    )
    row = key | {"first": first} | summarize(records)
    results.add(row)
    print_table([table_row(row)])


def rates(
    out: ResultsOption,
    name: Annotated[str, typer.Option("--set", help="Scene dataset.")] = "train_sg_star",
    count: Annotated[int, typer.Option(min=1, help="Number of scenes.")] = 300,
    seed: SeedOption = 3000,
) -> None:
    """Estimate how often hidden objects carry nothing, by area in which they stand unseen.

    The rate is (n + 1/2) / area for n such objects: the mean under the prior of Jeffreys.
    """
    assert out is not None
    config = ClutterConfig()
    scenes = load_scene_dataset(SCENES / f"{name}.json", load_catalog())
    detector = RayDetector(config.cell.camera)
    area = np.zeros(2)
    counts = np.zeros(2, int)
    num_hidden = 0
    indices = range(min(count, len(scenes.scenes)))
    for index in progress(indices, name, len(indices), 0):
        scene = load_scene(scenes, index, config, seed)
        observation = detector.perceive(scene).observation
        in_view = {d.name for d in observation.detections}
        known = [o for o in scene.objects if o.name in in_view]
        hidden = estimate_hidden(
            known,
            observation,
            config.cell.camera.floor_depth,
            scenes.classes,
            config.exploration.belief,
        )
        area += np.mean([list(a) for a in hidden.areas.values()], axis=0)
        for o in scene.objects:
            if o.name not in in_view:
                num_hidden += 1
                is_loaded = bool(objects_resting_on(o, scene.objects))
                is_covered = any(
                    np.all(k.bounds_T[0][:2] < o.X_TO.p[:2])
                    and np.all(o.X_TO.p[:2] < k.bounds_T[1][:2])
                    and k.bounds_T[0][2] > o.top_height - 1e-3
                    for k in known
                )
                if not is_loaded:
                    counts[0 if is_covered else 1] += 1
    row: Row = {"set": name, "scenes": len(indices), "hidden": num_hidden}
    for k, kind in enumerate(("covered", "shadow")):
        row |= {
            f"{kind}_area": float(area[k]),
            f"{kind}_objects": int(counts[k]),
            f"{kind}_rate": float((counts[k] + 0.5) / area[k]),
        }
    ResultsFile(out, {"seed": seed}, ("set",)).add(row | provenance())
    print_table([{key: str(value) for key, value in row.items()}])


if __name__ == "__main__":
    run_script(rates, episodes)
