"""The page docs/results/judge_agreement.md."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from markdown_text import estimate, figure, number, section, significant, table
from results_files import BENCHMARKS, read_benchmark_results, read_episodes

REASONS = {
    "balanced on a lying cylinder": "balanced on a lying cylinder",
    "floats in the air": "inconclusive: floating",
    "out of balance": "out of balance",
    "rests on an edge or on a curved side": "inconclusive: rests on an edge or a curved side",
    "stands beside what should carry it": "placed beside its support",
    "stable": "stable",
}
"""Wording of the static judge's reasons on the page, by that in results files."""


_AGREEMENT_COLUMNS = (
    "verdicts equal",
    "false stable",
    "false unstable",
    "inconclusive",
    "hidden lists equal",
)


def _agreement_cells(row: Mapping[str, Any]) -> list[str]:
    return [
        estimate(row, "agreement", "agreement_ci95", 3),
        number(row["false_stable_rate"], 3),
        number(row["false_unstable_rate"], 3),
        number(row["inconclusive_fraction"], 3),
        number(row["hidden_agreement"], 3),
    ]


def _verdict_pair(key: str) -> tuple[str, str]:
    """Return the two verdicts of a key such as "static unstable, Drake stable"."""
    static, drake = key.split(", ")
    static, drake = static.removeprefix("static "), drake.removeprefix("Drake ")
    return "inconclusive" if static == "cannot be judged" else static, drake


def _scenes(results: Mapping[str, Any]) -> str:
    text = section(
        "Scenes",
        "RG scenes judged by the static judge and by Drake with the same random offsets. "
        "`benchmarks/collect_drake_verdicts.py` collects Drake's verdicts. "
        "*Verdicts equal*, *false stable* and *false unstable*: of the scenes with a conclusive "
        "static verdict. *Hidden lists equal*: of the scenes that both call stable. Intervals are "
        "95 %.",
        command="python benchmarks/judge_agreement.py runs/drake_verdicts --out FILE",
        seed=0,
        results=["benchmarks/results/judges.json", "benchmarks/results/drake_verdicts/"],
    )
    text += table(
        ["objects", "nodes", "scenes", *_AGREEMENT_COLUMNS],
        [
            [
                row["objects"],
                str(row["nodes"]),
                str(row["count"]),
                *_agreement_cells(row),
            ]
            for row in results["scenes"]
        ],
    )
    share = 100 * results["scenes"][0]["false_stable_of_called_stable"]
    text += (
        f"\nOf the 25-node scenes of ycb7 that the static judge calls stable, {share:.1f} % are "
        "unstable in Drake.\n\n"
    )
    return text + figure(
        "judges_disagree.png", "Stacks that the static judge calls stable and that fall in Drake."
    )


def _meshes() -> str:
    results = read_benchmark_results("mesh_judges.json")
    rows = results["rows"]
    text = section(
        "Objects that are not convex",
        "Scenes with a mug, a bottle, a bowl and a plate beside a box and a can, judged by their "
        "convex pieces, and by Drake. Columns as above. The hill climber concentrates on the "
        "judge's errors.",
        command="python benchmarks/mesh_agreement.py runs/meshes --out FILE",
        seed=rows[0]["seed"],
        results=["benchmarks/results/mesh_judges.json"],
    )
    text += table(
        ["generator", "nodes", "scenes", *_AGREEMENT_COLUMNS],
        [
            [
                row["agent"],
                str(row["nodes"]),
                str(row["count"]),
                *_agreement_cells(row),
            ]
            for row in rows
        ],
    )
    text += "\nStacks that hold an object of the class:\n\n"
    return text + table(
        ["generator", "class", "objects", "stacks", "verdicts equal", "inconclusive"],
        [
            [
                row["agent"],
                name,
                str(row["objects_by_class"][name]),
                str(stacks["count"]),
                estimate(stacks, "agreement", "agreement_ci95", 3),
                number(stacks["inconclusive_fraction"], 3),
            ]
            for row in rows
            for name, stacks in row["by_class_in_group"].items()
        ],
    )


def _drake_itself(results: Mapping[str, Any]) -> str:
    text = section(
        "Drake with other settings",
        "Drake's verdicts with another setting, compared with its default verdicts, on the first "
        "25-node scenes of ycb7.",
        seed=0,
        results=["benchmarks/results/judges.json"],
    )
    return text + table(
        ["setting", "scenes", "verdicts equal", "hidden lists equal"],
        [
            [
                row["variant"],
                str(row["count"]),
                estimate(row, "agreement", "agreement_ci95", 3),
                estimate(row, "hidden_agreement", "hidden_agreement_ci95", 3),
            ]
            for row in results["drake_variants"]
        ],
    )


def _moves(results: Mapping[str, Any]) -> str:
    moves = results["moves"]
    text = section(
        "Moves",
        f"{moves['count']} legal moves drawn uniformly in stable 25-node scenes, executed by both "
        "transition models with the same random numbers. Of the conclusive outcomes "
        f"{estimate(moves, 'agreement', 'agreement_ci95', 3)} are equal.",
        seed=0,
        results=["benchmarks/results/judges.json"],
    )
    rows = [[*_verdict_pair(key), str(count)] for key, count in moves["confusion"].items()]
    return text + table(["static model", "Drake", "moves"], rows)


def _reasons(results: Mapping[str, Any]) -> str:
    details = results["details"]["ycb7, 25 nodes"]
    stacks = results["scenes"][0]["stacks"]["confusion"]
    text = section(
        "Stacks by reason",
        "Stacks of the 25-node scenes of ycb7 by the static judge's reason. A stack whose support "
        "stands in another stack is judged together with it.",
        seed=0,
        results=["benchmarks/results/judges.json"],
    )
    reasons = {
        **details["by_static_reason"],
        "stable": {key: count for key, count in stacks.items() if key.startswith("static stable")},
    }
    return text + table(
        ["static judge", "Drake: unstable", "Drake: stable"],
        [
            [REASONS[reason], *_by_drake(counts)]
            for reason, counts in sorted(reasons.items(), key=lambda item: REASONS[item[0]])
        ],
    )


def _by_drake(counts: Mapping[str, int]) -> list[str]:
    totals = {"unstable": 0, "stable": 0}
    for key, count in counts.items():
        totals[_verdict_pair(key)[1]] += count
    return [str(count) for count in totals.values()]


def _classes(results: Mapping[str, Any]) -> str:
    classes = results["details"]["ycb7, 25 nodes"]["by_class"]
    text = section(
        "Stacks by class",
        "Stacks of the 25-node scenes of ycb7 that are unstable in Drake, by the class of the "
        "object that moves first, and the static judge's verdict.",
        seed=0,
        results=["benchmarks/results/judges.json"],
    )
    verdicts = ("unstable", "stable", "inconclusive")
    body = []
    for name, counts in classes.items():
        by_verdict = {_verdict_pair(key)[0]: count for key, count in counts.items()}
        body.append([name, *(str(by_verdict.get(verdict, 0)) for verdict in verdicts)])
    return text + table(["class", *verdicts], body)


def _sensitivity(results: Mapping[str, Any]) -> str:
    text = section(
        "Margin and friction",
        "The static judge with other contact margins and friction coefficients on the 1,000 "
        "25-node scenes of ycb7. The defaults are 2.05 mm and 0.3.",
        seed=0,
        results=["benchmarks/results/judges.json"],
    )
    return text + table(
        ["margin [mm]", "friction", "verdicts equal", "false stable", "false unstable"],
        [
            [
                f"{row['margin_mm']:g}",
                f"{row['friction']:g}",
                number(row["agreement"], 3),
                number(row["false_stable_rate"], 3),
                number(row["false_unstable_rate"], 3),
            ]
            for row in results["sensitivity"]
        ],
    )


def _speed() -> str:
    results = read_benchmark_results("speed.json")
    text = section(
        "Speed",
        f"{results['count']} RG scenes of {results['nodes']} nodes "
        f"({results['objects_mean']:.1f} objects on average), one core, the same random offsets "
        "for every judge. *Agreement*: verdicts equal to those of Drake without early stop.",
        command="python benchmarks/judge_speed.py --out benchmarks/results/speed.json",
        seed=results["seed"],
        results=["benchmarks/results/speed.json"],
    )
    head = ["judge", "median [ms]", "mean [ms]", "scenes per second", "agreement"]
    text += table(
        head,
        [
            [
                name,
                significant(row["median_ms"]),
                significant(row["mean_ms"]),
                significant(row["per_second"]),
                number(row["agrees"]),
            ]
            for name, row in results["judges"].items()
        ],
    )
    targets = results["targets"]
    text += (
        f"\nThe static judge with an empty cache is {targets['ratio_to_pybullet']:.0f} times as "
        "fast as 480 steps of PyBullet. A scene of 16 objects takes "
        f"{targets['static_ms_16_objects']:.2f} ms at the median.\n\n"
    )
    text += table(
        ["renderer, 640 x 480", "median [ms]", "images per second"],
        [
            [name, significant(row["median_ms"]), significant(row["per_second"])]
            for name, row in results["renderers"].items()
        ],
    )
    return text + "\n" + figure("speed_growth.png", "Time per scene by number of objects.")


def _oracle() -> str:
    search = read_benchmark_results("speed.json")["search"]
    text = section(
        "Oracle search",
        "Time of the oracle search by number of hidden objects, with a budget of 2,000 simulated "
        "moves.",
        command="python benchmarks/judge_speed.py --out benchmarks/results/speed.json",
        seed=0,
        results=["benchmarks/results/speed.json"],
    )
    head = ["hidden objects", "scenes", "median [s]", "median simulated moves", "solvable"]
    return text + table(
        [*head, "proved unsolvable", "undecided"],
        [
            [
                name,
                str(row["count"]),
                f"{row['median_s']:.2g}",
                number(row["median_moves_evaluated"], 0),
                *(number(row[key]) for key in ("solvable", "proved unsolvable", "undecided")),
            ]
            for name, row in search.items()
        ],
    )


def _drake_versions() -> str:
    names = ("1.51.1", "1.58.0")
    runs = [
        read_benchmark_results(f"drake_versions/drake_{name}.json")
        | {"verdicts": read_episodes(BENCHMARKS / f"drake_versions/drake_{name}.jsonl.gz")}
        for name in names
    ]
    text = section(
        "Drake versions",
        "Verdicts and times of the oldest and the newest supported Drake on the same RG scenes.",
        command="python benchmarks/drake_versions.py measure --out FILE",
        seed=runs[0]["seed"],
        results=[f"benchmarks/results/drake_versions/drake_{name}.json" for name in names],
    )
    head = ["Drake", "scenes", "stable", "verdicts equal", "hidden lists equal"]
    head += ["step, objects locked [ms]", "step, objects free [ms]", "settling, median [s]"]
    return text + table([*head, "arm [s per move]"], [_version_row(runs[0], run) for run in runs])


def _version_row(reference: Mapping[str, Any], run: Mapping[str, Any]) -> list[str]:
    pairs: Sequence[tuple[Any, Any]] = list(
        zip(reference["verdicts"], run["verdicts"], strict=True)
    )
    hidden = [a["hidden"] == b["hidden"] for a, b in pairs if a["stable"] and b["stable"]]
    return [
        run["drake"],
        str(run["count"]),
        number(float(np.mean([b["stable"] for _, b in pairs])), 3),
        number(float(np.mean([a["stable"] == b["stable"] for a, b in pairs])), 3),
        number(float(np.mean(hidden)), 3),
        number(run["step_ms"]["asleep"], 3),
        number(run["step_ms"]["awake"]),
        number(run["settle_seconds"]["median"]),
        number(run["episode_seconds_per_move"]),
    ]


def page() -> str:
    """Return the page."""
    results = read_benchmark_results("judges.json")
    intro = (
        "# Judge agreement\n\nHow often the static stability judge agrees with Drake, and how long "
        "both take ([stability](../explanation/stability.md), "
        "[visibility](../explanation/visibility.md)).\n\n"
    )
    parts = [_scenes, _drake_itself, _moves, _reasons, _classes, _sensitivity]
    texts = [part(results) for part in parts]
    texts.insert(1, _meshes())
    return intro + "\n".join([*texts, _speed(), _oracle(), _drake_versions()])
