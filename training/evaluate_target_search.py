"""Evaluate searches for one object on the frozen target sets, with moves settled in Drake.

    python training/evaluate_target_search.py --workers 2

Every episode is a record in `training/results/target_episodes`, in one file for each set and
policy. An interrupted run is resumed by the same command.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drake_clutter.agents.episode_evaluation import EpisodeResult
from drake_clutter.agents.explorers import AREA_REDUCTION, ORACLE, PRETRAINED_EXPLORERS
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.learning.pretrained import checkpoint_sha256
from drake_clutter.outputs import output_file
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.statistics import mean_interval, ratio_interval, wilson_interval
from drake_clutter.tasks.exploration_task import TerminationReason
from drake_clutter.tasks.oracle_search import Solvability
from drake_clutter.validation import to_plain
from training.episode_files import (
    MAX_MOVES,
    AgentsOption,
    CountOption,
    EpisodesSeedOption,
    FidelityOption,
    SetNameOption,
    check_evaluation,
    collect_episodes,
    episodes_path,
)
from training.results_file import ResultsFile, Row
from training.script import (
    RESULTS,
    SCENES,
    ResultsOption,
    WorkersOption,
    format_number,
    print_table,
    run_script,
)
from training.target_set import TARGETS, TargetSet, load_target_set

EPISODES = RESULTS / "target_episodes"
"""Folder of the published episodes."""
RESULTS_FILE = RESULTS / "target_search.json"
"""Published results."""
ALLOWED_RATIO = 1.25
"""Moves that a search may use, relative to the oracle's plan, to count as efficient."""
_POLICIES = ("random", "largest-clear", AREA_REDUCTION)
SETS = {
    "sg_star_25": (*_POLICIES, "student", ORACLE),
    "sg_star_40": (*_POLICIES, "student", ORACLE),
    "sg_14": (*_POLICIES, "student-14", ORACLE),
}
"""By target set, which has the name of its scene dataset: the policies that are evaluated on it."""


def is_revealed(result: EpisodeResult) -> bool:
    """Return whether an episode found its target."""
    return result.ended == TerminationReason.TARGET_FOUND.value


def moves_ratio(pairs: Sequence[tuple[int, int]], least: tuple[int, int] = (1, MAX_MOVES)) -> Row:
    """Return the ratio of two policies' moves, with its interval and the number of episodes.

    Args:
        pairs: Moves of both policies in each episode.
        least: The pair with the smallest ratio that there can be.
    """
    ours, theirs = [a for a, _ in pairs], [b for _, b in pairs]
    return {
        "ratio": sum(ours) / sum(theirs) if pairs else None,
        "ci95": ratio_interval(ours, theirs, least, (MAX_MOVES, 1)),
        "episodes": len(pairs),
    }


def summarize(
    targets: TargetSet, results: Sequence[EpisodeResult], area: Sequence[EpisodeResult]
) -> Row:
    """Return the metrics of a policy.

    Args:
        targets: The target set.
        results: Results of the policy on the first pairs.
        area: Results of the area policy on the first pairs, as far as there are any.

    Returns:
        revealed, collapsed: Fractions of the episodes, with intervals.
        solvable: The same for the solvable pairs, and the fraction that is revealed within
            `ALLOWED_RATIO` times the moves of the oracle's plan.
        moves: Mean number of moves of the episodes that revealed the target.
        to_oracle: Ratio to the moves of the oracle's plans, over the revealed pairs whose plan has
            the fewest moves that there can be.
        to_area: Ratio to the moves of the area policy, over the pairs that both reveal.
    """
    pairs = targets.pairs[: len(results)]
    solvable = [
        (result, pair.moves)
        for result, pair in zip(results, pairs, strict=True)
        if pair.solvable == Solvability.SOLVABLE.value and pair.moves is not None
    ]
    efficient = sum(is_revealed(r) and r.moves <= ALLOWED_RATIO * best for r, best in solvable)
    moves = [r.moves for r in results if is_revealed(r)]
    return {
        "episodes": len(results),
        **_rate("revealed", sum(map(is_revealed, results)), len(results)),
        **_rate(
            "collapsed",
            sum(TerminationReason(r.ended).is_failed_move for r in results),
            len(results),
        ),
        "solvable": {
            "episodes": len(solvable),
            "oracle_moves": float(np.mean([best for _, best in solvable])) if solvable else None,
            **_rate("revealed", sum(is_revealed(r) for r, _ in solvable), len(solvable)),
            **_rate("efficient", efficient, len(solvable)),
        },
        "moves": float(np.mean(moves)) if moves else None,
        "moves_ci95": mean_interval(moves, 1, MAX_MOVES),
        "to_oracle": moves_ratio(
            [
                (result.moves, pair.moves)
                for result, pair in zip(results, pairs, strict=True)
                if pair.moves is not None and pair.is_optimal and is_revealed(result)
            ],
            least=(1, 1),
        ),
        "to_area": moves_ratio(
            [
                (ours.moves, theirs.moves)
                for ours, theirs in zip(results, area, strict=False)
                if is_revealed(ours) and is_revealed(theirs)
            ]
        ),
    }


def _rate(name: str, successes: int, trials: int) -> Row:
    """Return a fraction and its 95 % interval under a name; None without trials."""
    if not trials:
        return {name: None, f"{name}_ci95": None}
    return {name: successes / trials, f"{name}_ci95": wilson_interval(successes, trials)}


def table_row(row: Mapping[str, Any]) -> dict[str, str]:
    """Return a row of the results as cells of the printed table, by title."""
    return {
        "set": row["set"],
        "agent": row["agent"],
        "episodes": str(row["episodes"]),
        "revealed": format_number(row["revealed"]),
        "collapsed": format_number(row["collapsed"]),
        "moves": format_number(row["moves"], 1),
        "moves / oracle": format_number(row["to_oracle"]["ratio"]),
        "moves / area": format_number(row["to_area"]["ratio"]),
        "efficient": format_number(row["solvable"]["efficient"]),
    }


def main(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder for the records of the episodes.")
    ] = EPISODES,
    workers: WorkersOption = 1,
    seed: EpisodesSeedOption = 2000,
    fidelity: FidelityOption = "settle",
    count: CountOption = None,
    only: SetNameOption = None,
    agents: AgentsOption = None,
    out: ResultsOption = None,
) -> None:
    """Run the episodes that are missing, and print the table."""
    fidelity = check_evaluation(fidelity, out, folder == EPISODES, bool(agents or count))
    names = [name for name in SETS if only is None or only in name]
    if not names:
        raise InputError(f"--only {only}; expected a part of one of {', '.join(SETS)}")
    folder.mkdir(parents=True, exist_ok=True)
    catalog = load_catalog()
    path = out or RESULTS_FILE
    header = {"seed": seed, "fidelity": fidelity, "config": to_plain(ClutterConfig())}
    file = ResultsFile(path, header, ("set", "agent"))
    file.read()  # Reports what is wrong before any episode is run.
    options: dict[str, Any] = {"fidelity": fidelity, "seed": seed, "workers": workers}
    rows = list[Row]()
    for name in names:
        scenes = load_scene_dataset(SCENES / f"{name}.json", catalog)
        targets = load_target_set(TARGETS / f"{name}.json", scenes)
        num_episodes = min(count or len(targets.pairs), len(targets.pairs))
        asked = agents or SETS[name]
        records = {
            agent: collect_episodes(
                episodes_path(folder, name, agent), targets, agent, num_episodes, **options
            )
            for agent in dict.fromkeys((AREA_REDUCTION, *asked))
        }
        results = {
            agent: [EpisodeResult.from_record(record) for record in records[agent]]
            for agent in records
        }
        for agent in asked:
            row = {
                "set": name,
                "sha256": targets.sha256,
                "agent": agent,
                "weights": checkpoint_sha256(agent, PRETRAINED_EXPLORERS),
                **summarize(targets, results[agent], results[AREA_REDUCTION]),
                "commits": list(dict.fromkeys(record["commit"] for record in records[agent])),
            }
            rows.append(row)
            if out is not None:
                file.add(row)
            else:
                with output_file(path):
                    file.add(row)
    print_table([table_row(row) for row in rows])


if __name__ == "__main__":
    run_script(main)
