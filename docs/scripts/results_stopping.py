"""The section of docs/results/exploration.md about explorers that stop by themselves."""

from markdown_text import estimate, number, section, table
from results_files import policy_name, read_benchmark_results


def stopping() -> str:
    """Return the section."""
    results = read_benchmark_results("stopping.json")
    rates = read_benchmark_results("hidden_rates.json")["rows"][0]
    text = section(
        "Stopping without ground truth",
        "Explorers that stop when their [belief](../explanation/belief.md) says that every object "
        "is known; at most 20 moves. "
        "*Right*: stopped with every object found, of all episodes. *Too early*: stopped with an "
        "object hidden. *Unneeded moves*: after every object was in view, mean of the episodes in "
        "which it was. Detector `labels` is perfect. `--first` and `--count` are the first scene "
        "and the number of scenes. Intervals are 95 %.",
        command="python benchmarks/stopping.py episodes --set DATASET --agent POLICY "
        "--fidelity static_or_drake --first 100 --count 60 --out FILE",
        seed=results["seed"],
        results=["benchmarks/results/stopping.json", "benchmarks/results/hidden_rates.json"],
    )
    head = ["dataset", "policy", "detector", "moves judged by", "first scene", "scenes"]
    head += ["right", "all found"]
    head += ["too early", "unneeded moves"]
    body = [
        [
            row["set"],
            policy_name(row["agent"]),
            row["perception"],
            row["fidelity"],
            str(row["first"]),
            str(row["episodes"]),
            estimate(row, "right", "right_ci95"),
            number(row["found_all"]),
            number(row["stopped"] - row["right"]),
            number(row["unneeded_moves"]),
        ]
        for row in results["rows"]
    ]
    text += table(head, body)
    return text + (
        f"\nThe rates of `exploration.belief` are estimates from {rates['scenes']} scenes of "
        f"{rates['set']}: of {rates['hidden']} hidden objects, "
        f"{rates['covered_objects'] + rates['shadow_objects']} carried nothing "
        f"(`python benchmarks/stopping.py rates`).\n"
    )
