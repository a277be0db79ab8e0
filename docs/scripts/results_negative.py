"""The page docs/results/negative_results.md."""

from collections.abc import Mapping, Sequence
from typing import Any

from markdown_text import number, table
from results_closed_loop import closed_loop_episodes
from results_files import read_benchmark_results, read_training_results

Line = tuple[str, str, str]
"""What was tried, what came out, and the results file."""


def _rates(row: Mapping[str, Any]) -> str:
    cells = [
        row["within_10"]["success"],
        row["within_20"]["success"],
        row["within_20"]["collapsed"],
    ]
    return " / ".join(number(value) for value in cells)


def _exploration() -> list[Line]:
    file = "training/results/explorers_without_look.json"
    rows = read_training_results("explorers_without_look.json")["rows"]
    by_agent = {(row["agent"], row["set"], row["episodes"]): row for row in rows}
    lines = []
    for agent, name in (("student", "sg_star_25"), ("student-14", "sg_14")):
        with_search = by_agent[f"careful-{agent}", name, 100]
        without = by_agent[agent, name, 100]
        lines.append(
            (
                f"One-step look-ahead with the static judge ({agent}, {name})",
                "Success in 10 / in 20 moves / collapsed: "
                f"{_rates(with_search)} with, {_rates(without)} without, n = 100.",
                file,
            )
        )
    trainings = {
        row["agent"]: row["history"][-1]
        for row in read_training_results("explorer_trainings.json")["rows"]
    }
    high, low = trainings["student"], trainings["student, collapse costs 1"]
    lines.append(
        (
            "Collapse penalty 1 instead of 3 in fine-tuning",
            f"Success {number(low['success'], 3)} instead of {number(high['success'], 3)}, "
            "collapsed "
            f"{number(low['collapsed'], 3)} in both, n = 200.",
            "training/results/explorer_trainings.json",
        )
    )
    return lines


def _generation() -> list[Line]:
    table1 = read_training_results("table1.json")["rows"]
    cold = next(row for row in table1 if row["temperature"] == 0.02)
    paper = next(row for row in table1 if row["agent"].endswith("sg_star_paper.safetensors"))
    first = read_training_results("first_trainings.json")["trainings"]
    second = read_training_results("second_trainings.json")
    relative = second["runs"]["prior_0.1"]["history"]
    without_bonus = next(r for r in second["sampled"]["sg_star_0"] if r["temperature"] == 0.3)
    sampled = read_training_results("sg_star_seed_0.json")["sampled"]
    with_bonus = next(row for row in sampled if row["temperature"] == 0.3)

    def score(history: Sequence[Mapping[str, float]], step: int) -> str:
        return number(next(row["score"] for row in history if row["step"] == step))

    exploratory = "training/results/first_trainings.json"
    return [
        (
            "Nearly greedy sampling of SG\\* (T = 0.02)",
            f"{100 * cold['false_stable_of_called_stable']:.1f} % of the scenes that the static "
            "judge "
            f"calls stable fall in Drake, and {number(cold['distinct_share'])} of the graphs are "
            "distinct.",
            "training/results/table1.json",
        ),
        (
            "The paper's reward alone",
            f"{number(paper['hidden_mean'], 1)} hidden objects, but "
            f"{number(paper['solvable_share'])} "
            f"of the stable scenes are solvable and {number(paper['balanced_share'])} balanced.",
            "training/results/table1.json",
        ),
        (
            "No balance bonus",
            f"{without_bonus['hidden']:.1f} hidden in {without_bonus['stacks']:.1f} stacks at T = "
            "0.3, "
            f"with the bonus {with_bonus['hidden']:.1f} in {with_bonus['stacks']:.1f}.",
            "training/results/second_trainings.json",
        ),
        (
            "Absolute instead of relative entropy",
            f"Mean return after 16,000 / 32,000 steps: {score(first[3]['history'], 16000)} / "
            f"{score(first[3]['history'], 32000)}, relative to RG {score(relative, 16000)} / "
            f"{score(relative, 32000)}; one run each.",
            exploratory,
        ),
        (
            "Q-values from the global node alone",
            f"Mean return after 32,000 steps {score(first[0]['history'], 32000)}, with the marked "
            f"nodes {score(first[3]['history'], 32000)}; one run each.",
            exploratory,
        ),
        (
            "Replay buffer of 20,000 instead of 100,000 steps",
            f"Mean return after 32,000 steps {score(first[4]['history'], 32000)} instead of "
            f"{score(first[3]['history'], 32000)}; one run each.",
            exploratory,
        ),
    ]


def _closed_loop() -> list[Line]:
    color = closed_loop_episodes("sg_star_25_student_depth-color_settle")
    depth = closed_loop_episodes("sg_star_25_student_depth_settle")

    def solved(episodes: Mapping[int, Mapping[str, Any]]) -> int:
        return sum(episodes[number]["ended"] == "all found" for number in color)

    return [
        (
            "Color beside depth in the closed loop",
            f"{solved(color)} of {len(color)} scenes solved, with depth alone {solved(depth)} of "
            "the "
            "same; teleported moves.",
            "training/results/closed_loop/",
        )
    ]


def _arm() -> list[Line]:
    cut = read_benchmark_results("arm_moves_cut_ends.json")["carried_out_unless_unstable_anyway"]
    full = read_benchmark_results("arm_moves.json")["carried_out_unless_unstable_anyway"]
    holds = read_benchmark_results("arm_holds.json")["rows"]

    def executed(hold: str) -> str:
        rows = [row for row in holds if row["hold"] == hold]
        return ", ".join(
            f"{row['results'].get('carried out', 0)} of {row['moves']} ({row['scenes']})"
            for row in rows
        )

    return [
        (
            "Coarse resampling of optimized trajectories",
            f"{cut['fraction']:.3f} of the planned moves executed (n = {cut['of']}), with fine "
            "resampling "
            f"{full['fraction']:.3f} (n = {full['of']}): the cup left the surface at a slant.",
            "benchmarks/results/arm_moves_cut_ends.json",
        ),
        (
            "Locked floating joint as grasp constraint",
            f"Executed {executed('JointHold')}; compliant grasp {executed('HexapodHold')}.",
            "benchmarks/results/arm_holds.json",
        ),
    ]


def _stability() -> list[Line]:
    rows = read_benchmark_results("calibration_explored.json")
    by_speed = [row for row in rows if "instantaneous speed" in row["tried"] and row["nodes"] == 25]
    count = by_speed[0]["instability_reasons"]["not at rest in time"]
    environment = read_benchmark_results("speed.json")["judges"]["PyBullet, 480 steps"]
    return [
        (
            "Rest criterion by instantaneous speed (5 mm/s)",
            f"{count} of {by_speed[0]['count']} scenes of 25 nodes not at rest; by displacement "
            "over "
            "0.5 s none of 80.",
            "benchmarks/results/calibration_explored.json",
        ),
        (
            "PyBullet as the judge",
            f"Agrees with Drake on {number(environment['agrees'])} of {environment['count']} "
            "scenes; "
            "lying markers roll away without rolling friction.",
            "benchmarks/results/speed.json",
        ),
    ]


def page() -> str:
    """Return the page."""
    lines = [*_generation(), *_exploration(), *_closed_loop(), *_arm(), *_stability()]
    return (
        "# Negative results\n\nWhat was tried and did not help, with the numbers of its results "
        "file.\n\n"
        + table(
            ["tried", "result", "results file"],
            [[tried, result, f"`{file}`"] for tried, result, file in lines],
        )
    )
