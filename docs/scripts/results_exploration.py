"""The page docs/results/exploration.md."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from markdown_text import estimate, figure, number, section, table
from results_files import (
    TRAINING,
    policy_name,
    read_benchmark_results,
    read_episodes,
    read_training_results,
)
from results_generation import spread
from results_stopping import stopping

MIN_PAIRS = 10
"""Fewest scenes that both of two policies solve for their numbers of moves to be compared."""
PAPER: dict[str, dict[str, tuple[float, float | None]]] = {
    "sg_star_10": {
        "random": (0.05, 0.76),
        "largest-first": (0.88, 2.93),
        "student-rg": (0.92, 3.06),
        "student": (0.91, 3.13),
    },
    "sg_star_15": {
        "random": (0.03, 1.15),
        "largest-first": (0.58, 3.33),
        "student-rg": (0.84, 4.40),
        "student": (0.82, 4.27),
    },
    "sg_star_20": {
        "random": (0.00, 0.93),
        "largest-first": (0.32, 3.64),
        "student-rg": (0.36, 4.24),
        "student": (0.64, 4.71),
    },
    "paper_hardness": {
        "random": (0.00, 0.90),
        "largest-first": (0.10, 2.70),
        "student-rg": (0.52, 4.87),
        "student": (0.91, 5.82),
    },
    "sg_14": {"random": (0.03, None), "largest-first": (0.56, None), "student-14": (0.64, 5.33)},
}
"""Success rate and objects found by dataset and policy (Kumar et al. 2022, Tables II and III).

The paper's scenes with 25 nodes hide as many objects as those of `paper_hardness`.
"""
PAIRS = (
    ("paper_hardness", "student", "student-rg"),
    ("sg_star_25", "student", "student-rg"),
    ("sg_star_25", "student-dagger", "student-rg"),
    ("sg_star_40", "student", "student-rg"),
)
"""Scene dataset and two policies that are compared scene by scene."""
_NAMES = (
    ("RE", "random", "uniform choice among the legal moves (paper)"),
    ("LF", "largest-first", "largest visible object, to the tray (paper)"),
    ("LF-clear", "largest-clear", "largest visible object with a clear top, to the tray"),
    ("SE^r", "student-rg", "student cloned (DAgger) on RG scenes"),
    ("SE\\*, DAgger", "student-dagger", "student cloned (DAgger) on SG\\* scenes"),
    ("SE\\*", "student", "`student-dagger`, fine-tuned by PPO"),
    ("SE-14", "student-14", "student cloned and fine-tuned on SG-14 scenes"),
    ("oracle", "full-knowledge", "search with full state for the fewest moves"),
)
"""Short name, name on the command line and description of each policy."""
_SUCCESS = ["dataset", "policy", "episodes", "success in 10", "in 10 (paper)", "success in 20"]
_SUCCESS += ["of the solvable", "collapsed"]
_FOUND = ["dataset", "policy", "hidden", "found in 10", "in 10 (paper)", "found in 20"]
_FOUND += ["fraction found", "moves", "moves / oracle", "moves / LF-clear"]


def success_row(row: Mapping[str, Any]) -> list[str]:
    """Return the cells of a policy in the table of success rates."""
    success, _ = PAPER.get(row["set"], {}).get(row["agent"], (None, None))
    solvable = row["solvable"] or {}
    return [
        row["set"],
        policy_name(row["agent"]),
        str(row["episodes"]),
        estimate(row["within_10"], "success", "success_ci95"),
        number(success),
        estimate(row["within_20"], "success", "success_ci95"),
        number(solvable.get("within_20", {}).get("success")),
        estimate(row["within_20"], "collapsed", "collapsed_ci95"),
    ]


def found_row(row: Mapping[str, Any]) -> list[str]:
    """Return the cells of a policy in the table of objects found and moves."""
    _, found = PAPER.get(row["set"], {}).get(row["agent"], (None, None))
    ratios = [
        number(row[f"moves_to_{other}"]) if row.get(f"both_with_{other}", 0) >= MIN_PAIRS else ""
        for other in ("ceiling", "largest_clear")
    ]
    return [
        row["set"],
        policy_name(row["agent"]),
        number(row["hidden"], 1),
        number(row["within_10"]["found"], 1),
        number(found, 1),
        number(row["within_20"]["found"], 1),
        number(row["within_20"]["found_of_hidden"]),
        number(row["moves_of_successes"], 1),
        *ratios,
    ]


def _policies() -> str:
    rows = [
        row
        for name in ("table2.json", "table3.json")
        for row in read_training_results(name)["rows"]
    ]
    rows.sort(key=lambda row: str(row["set"]))
    text = section(
        "Success rates",
        "Policies on frozen scene datasets with perfect detections; Drake settles every move. "
        "*Success*: every object detected within 10 or 20 moves. *Of the solvable*: success in 20 "
        "moves on the scenes that the oracle search solves. *(Paper)*: Tables II and III of Kumar "
        "et al. 2022. Intervals are 95 %.",
        command="python training/evaluate_explorers.py runs/table2",
        seed=2000,
        results=["training/results/table2.json", "training/results/table3.json"],
    )
    text += table(_SUCCESS, [success_row(row) for row in rows])
    text += (
        "\n### Objects found and moves\n\n"
        "*Hidden* and *found*: objects per scene. *Moves*: mean over the successes. *Moves / "
        "oracle*, *moves / LF-clear*: ratio on the scenes that both policies solve, if these are "
        "at "
        f"least {MIN_PAIRS}.\n\n"
    )
    text += table(_FOUND, [found_row(row) for row in rows])
    return text + "\n" + figure("explorers.png", "Fraction of the hidden objects found, by moves.")


def _pairs() -> str:
    text = section(
        "Paired comparison",
        "Scenes solved by one of two policies alone; p-value of the two-sided sign test.",
        results=["training/results/episodes/"],
    )
    rows = []
    for name, first, second in PAIRS:
        for limit in (10, 20):
            wins = [
                _solved(f"{name}_{a}", limit) - _solved(f"{name}_{b}", limit)
                for a, b in ((first, second), (second, first))
            ]
            counts = [len(scenes) for scenes in wins]
            p_value = binomtest(counts[0], sum(counts)).pvalue if sum(counts) else 1.0
            cells = [name, str(limit), policy_name(first), policy_name(second)]
            rows.append([*cells, *(str(count) for count in counts), f"{p_value:.1g}"])
    head = ["dataset", "moves", "first", "second", "first alone", "second alone", "p"]
    return text + table(head, rows)


def _solved(run: str, limit: int) -> set[str]:
    """Return the scenes in which every hidden object was found within a number of moves."""
    return {
        episode["scene"]
        for episode in read_episodes(TRAINING / f"episodes/{run}.jsonl.gz")
        if episode["found_after"][:limit]
        and episode["found_after"][:limit][-1] == episode["hidden"]
    }


def _static_and_drake() -> str:
    rows = [
        row
        for name in ("table2.json", "table3.json")
        for row in read_training_results(name)["rows"]
    ]
    settled = {(row["set"], row["agent"], row["episodes"]): row for row in rows}
    text = section(
        "Static stability model and Drake",
        "The same scenes, seeds and policies with two transition models: static stability "
        "judge (Drake only where it is inconclusive) / Drake settles every move.",
        command="python training/evaluate_explorers.py runs/table2 --fidelity static_or_drake"
        " --out training/results/explorers_fast.json",
        seed=2000,
        results=["training/results/explorers_fast.json", "training/results/table2.json"],
    )
    compared = []
    others = []
    for static in read_training_results("explorers_fast.json")["rows"]:
        drake = settled.get((static["set"], static["agent"], static["episodes"]))
        if drake is None:
            others.append(_static_row(static))
        else:
            compared.append(_comparison(static, drake))
    head = ["dataset", "policy", "scenes", "success in 10", "success in 20", "fraction found"]
    text += table([*head, "collapsed", "moves"], compared)
    text += (
        "\n### Further policies\n\n"
        "Clones before fine-tuning, static stability model alone. *SE\\*, cloning*: behavior "
        "cloning without DAgger.\n\n"
    )
    return text + table([*head, "collapsed", "moves"], others)


def _static_row(row: Mapping[str, Any]) -> list[str]:
    return [
        row["set"],
        policy_name(row["agent"]),
        str(row["episodes"]),
        estimate(row["within_10"], "success", "success_ci95"),
        estimate(row["within_20"], "success", "success_ci95"),
        number(row["within_20"]["found_of_hidden"]),
        estimate(row["within_20"], "collapsed", "collapsed_ci95"),
        number(row["moves_of_successes"], 1),
    ]


def _comparison(static: Mapping[str, Any], drake: Mapping[str, Any]) -> list[str]:
    cells = [static["set"], policy_name(static["agent"]), str(static["episodes"])]
    for limit, key in (
        ("within_10", "success"),
        ("within_20", "success"),
        ("within_20", "found_of_hidden"),
        ("within_20", "collapsed"),
    ):
        cells.append(f"{number(static[limit][key])} / {number(drake[limit][key])}")
    moves = [number(row["moves_of_successes"], 1) for row in (static, drake)]
    return [*cells, " / ".join(moves)]


def _seeds() -> str:
    rows = read_training_results("explorers_seeds.json")["rows"]
    text = section(
        "Training seeds",
        "SE\\* trained with other seeds, teacher and clone included; the first 100 scenes of "
        "sg_star_25, settled by Drake.",
        command="python training/evaluate_explorers.py runs/seeds --only sg_star_25 --count 100"
        " --out training/results/explorers_seeds.json",
        seed=2000,
        results=["training/results/explorers_seeds.json"],
    )
    text += table(_SUCCESS, [success_row(row) for row in rows])
    text += "\n" + table(_FOUND, [found_row(row) for row in rows])
    return text + "\n" + spread("SE\\*", _of_seeds(rows))


def _of_seeds(rows: Sequence[Mapping[str, Any]]) -> dict[str, tuple[list[float], int]]:
    seeds = [row for row in rows if Path(row["agent"]).stem.split("_seed_")[0] == "student"]
    return {
        "success in 10 moves": ([row["within_10"]["success"] for row in seeds], 3),
        "in 20": ([row["within_20"]["success"] for row in seeds], 3),
        "collapsed": ([row["within_20"]["collapsed"] for row in seeds], 3),
        "moves": ([row["moves_of_successes"] for row in seeds], 2),
    }


def _action_filter() -> str:
    without = {
        (row["set"], row["agent"], row["episodes"]): row
        for row in read_training_results("explorers_without_look.json")["rows"]
    }
    text = section(
        "Placement filter",
        "Policies without / with the inference-time filter that discards moves without a free "
        "placement and prefers the tray to stacking. Static stability model.",
        seed=2000,
        results=[
            "training/results/explorers_without_look.json",
            "training/results/explorers_fast.json",
        ],
    )
    body = []
    for row in read_training_results("explorers_fast.json")["rows"]:
        other = without.get((row["set"], row["agent"], row["episodes"]))
        if other is not None and row["agent"] != "largest-clear":
            body.append(_comparison(other, row))
    head = ["dataset", "policy", "scenes", "success in 10", "success in 20", "fraction found"]
    return text + table([*head, "collapsed", "moves"], body)


def _placement_rule() -> str:
    rules = {
        "outermost": "farthest from the center, yaw 0 or 90; on objects the middle of what is "
        "visible of the top",
        "packed": "[the rule of this version](../explanation/placement.md)",
    }
    rows = {
        (row["set"], row["agent"], row["fidelity"], row["rule"]): row
        for row in read_benchmark_results("placement_rule.json")["rows"]
    }
    text = section(
        "Placement rule",
        "The same policies and scenes with two rules of placements; at most 20 moves. *Room*: "
        "moves with a free placement, of those that the policy chose. Learned policies choose only "
        "such moves. *Falls on objects*: collapses in moves onto an object. Intervals are 95 %.",
        command="python benchmarks/placement_rule.py --rule packed"
        " --out benchmarks/results/placement_rule.json",
        seed=2000,
        results=["benchmarks/results/placement_rule.json"],
    )
    text += table(["rule", "placement"], [[f"*{name}*", rule] for name, rule in rules.items()])
    head = ["dataset", "policy", "moves judged by", "scenes", "rule", "success", "collapsed"]
    head += ["moves of successes", "room on the tray", "moves onto objects", "falls on objects"]
    body = []
    for key in dict.fromkeys(key[:3] for key in rows):
        for rule in rules:
            if (row := rows.get((*key, rule))) is not None:
                body.append(
                    [
                        row["set"],
                        policy_name(row["agent"]),
                        row["fidelity"],
                        str(row["episodes"]),
                        rule,
                        estimate(row, "success", "success_ci95"),
                        estimate(row, "collapsed", "collapsed_ci95"),
                        number(row["moves_of_successes"], 1),
                        estimate(row, "tray_room", "tray_room_ci95"),
                        str(row["object_moves"]),
                        str(row["object_collapses"]),
                    ]
                )
    return text + "\n" + table(head, body)


def _trainings() -> str:
    text = section(
        "Trainings",
        "200 episodes at the end of each training, static stability model without Drake, at most "
        "20 moves, no action filter. A step is a move; of a clone, a round of demonstrations. "
        "Other processes ran on the same two cores.",
        command="python training/train_explorer_ppo.py --config training/configs/teacher.yaml"
        " --out runs/teacher",
        seed="0 unless stated",
        results=["training/results/explorer_trainings.json"],
    )
    rows = []
    for row in read_training_results("explorer_trainings.json")["rows"]:
        last = row["history"][-1]
        cells = [
            row["agent"]
            .replace("collapse costs 1", "collapse penalty 1")
            .replace("plain cloning", "without DAgger")
        ]
        cells += [str(last["step"]), number(row["minutes"], 0)]
        cells += [number(last[key], 3) for key in ("success", "found_share", "collapsed")]
        rows.append([*cells, number(last["moves_of_successes"], 1)])
    head = ["training", "steps", "minutes", "success", "fraction found", "collapsed", "moves"]
    text += table(head, rows)
    return text + "\n" + figure("explorer_curves.png", "Learning curves of exploration policies.")


def _environment() -> str:
    rows = read_benchmark_results("exploration_environment.json")["rows"]
    text = section(
        "Speed of the environment",
        "Uniformly random allowed moves in `ClutterExploration-v0`, static stability model.",
        command="python benchmarks/exploration_env_speed.py --out FILE",
        results=["benchmarks/results/exploration_environment.json"],
    )
    parts = ("the move, judged", "the look", "the graph")
    head = ["observation", "episodes", "moves", "ms per move", "ms per reset"]
    head += ["stability", "perception", "graph"]
    return text + table(
        head,
        [
            [
                "privileged" if row["privileged"] else "belief",
                str(row["episodes"]),
                str(row["moves"]),
                number(row["ms_a_move"], 1),
                number(row["ms_a_scene"], 1),
                *(number(row["parts"][f"of both: {part}"]) for part in parts),
            ]
            for row in rows
        ],
    )


def page() -> str:
    """Return the page."""
    intro = "# Exploration\n\nExploration policies compared on frozen scene datasets. "
    intro += "Unless stated, placements are those of the rule *outermost*, see "
    intro += "[placement rule](#placement-rule).\n\n" + table(
        ["name", "`--agent`", "policy"],
        [[name, f"`{agent}`" if agent else "", text] for name, agent, text in _NAMES],
    )
    parts = [_policies(), _pairs(), _static_and_drake(), _placement_rule(), _action_filter()]
    parts += [stopping(), _seeds()]
    return intro + "\n" + "\n".join([*parts, _trainings(), _environment()])
