"""The page docs/results/recording.md."""

import json

from markdown_text import number, section, table
from results_files import ROOT, has_benchmark_results, read_benchmark_results

DATASET = "training/datasets/sg_star_25_moves"
"""Folder of the card of the recorded data set."""
SUMMARY_FILE = "summary.json"
NODE_LOSS = "ray_node_loss.json"
"""Results file of `benchmarks/ray_node_loss.py`."""
NODE_LOSS_COUNTS = ("items", "items_at_loss", "lost_workers", "killed_processes", "files")

IMAGES = {"none": "none", "RGB-D": "color and depth"}
"""Names of the kinds of images, by those in the results file."""


def page() -> str:
    """Return the page."""
    results = read_benchmark_results("recording_throughput.json")
    camera = results["recorded_camera"]
    size = f"{camera['width']} x {camera['height']}"
    text = (
        "# Recording\n\nHow fast `drake-clutter record` makes data sets "
        "([how to record](../how_to/record_trajectories.md)).\n\n"
    )
    text += section(
        "Throughput of recording",
        f"Episodes of the policy `{results['policy']}` in scenes of `{results['scenes']}`, at most "
        f"{results['max_moves']} moves each, {results['rate_hz']:g} samples per second. With "
        f"images: {size} pixels of the camera `{camera['name']}`, {camera['rate_hz']} per second. "
        f"{results['machine']['cpu']}, {results['cores']} cores. *Moves per hour*: carried out by "
        f"all workers, after the first episode of each, of {results['episodes']} episodes.",
        command="python benchmarks/recording_throughput.py "
        f"--episodes {results['episodes']} --out FILE",
        seed=str(results["seed"]),
        results=["benchmarks/results/recording_throughput.json"],
    )
    text += table(
        ["images", "workers", "moves", "moves per hour", "start [s]", "summary and card [s]"],
        [
            [
                IMAGES[row["images"]],
                str(row["workers"]),
                str(row["moves"]),
                f"{row['moves_per_hour']:,.0f}",
                number(row["start_s"]),
                number(row["finish_s"]),
            ]
            for row in results["rows"]
        ],
    )
    text += (
        "\n## Where the time goes\n\nShares of the time of one worker, of some of the episodes.\n\n"
    )
    text += table(["part", *IMAGES.values()], _share_rows(results["shares"]))
    text += (
        f"\n## More workers\n\nTime for {results['model_moves']:,} moves by a model, not by a "
        "measurement: every worker runs on a separate core and is as fast as the measured "
        "one, and a single process reads all episodes for the card at the end. The "
        "moves per hour include the start and the card. See "
        "`benchmarks/recording_throughput.py`.\n\n"
    )
    text += table(
        ["images", "workers", "hours", "moves per hour", "core hours per 1,000 moves"],
        [
            [
                IMAGES[row["images"]],
                f"{row['workers']:,}",
                number(row["hours"]),
                f"{row['moves_per_hour']:,.0f}",
                number(row["core_hours_per_1000_moves"]),
            ]
            for row in results["model"]
        ],
    )
    if (ROOT / DATASET / SUMMARY_FILE).exists():
        text += "\n" + _dataset()
    if has_benchmark_results(NODE_LOSS):
        text += "\n" + _node_loss()
    return text


def _node_loss() -> str:
    """Return the section of the commands during which a node of a cluster was lost."""
    text = section(
        "Loss of a node",
        "Commands on a Ray cluster of two nodes, network namespaces of one machine, with one "
        "worker each. When half of the items are there, the cable is cut and all processes of a "
        "node are killed. *Different*: files whose bytes differ from those of a local run; of JSON "
        "files the fields `seconds` and `workers` are left out.",
        command="python benchmarks/ray_node_loss.py FOLDER --results FILE -- COMMAND",
        results=[f"benchmarks/results/{NODE_LOSS}"],
    )
    return text + table(
        [
            "command",
            "items",
            "at the loss",
            "lost workers",
            "killed processes",
            "files",
            "different",
        ],
        [
            [
                f"`{row['command']}`",
                *(str(row[key]) for key in NODE_LOSS_COUNTS),
                str(len(row["different"])),
            ]
            for row in read_benchmark_results(NODE_LOSS)["rows"]
        ],
    )


def _dataset() -> str:
    """Return the section of the data set whose card is published."""
    summary = json.loads((ROOT / DATASET / SUMMARY_FILE).read_text())
    text = section(
        "A recorded data set",
        "Random legal moves of the arm with color, depth and segmentation images of the overhead "
        f"camera. `{DATASET}/README.md` is the card of the data set, with its pictures; the data "
        "are made by the command.",
        command="python training/record_sg_star_dataset.py --workers 2 --out FOLDER",
        seed=json.loads((ROOT / DATASET / "job.json").read_text())["seed"],
        results=[f"{DATASET}/{SUMMARY_FILE}"],
    )
    results = ", ".join(f"{count:,} {result}" for result, count in summary["results"].items())
    return text + table(
        ["episodes", "attempted moves", "carried out", "results", "motion"],
        [
            [
                f"{summary['episodes']:,}",
                f"{summary['moves']:,}",
                f"{summary['executed_moves']:,}",
                results,
                f"{summary['recorded_seconds'] / 3600:.1f} h",
            ]
        ],
    )


def _share_rows(shares: dict[str, dict[str, float]]) -> list[list[str]]:
    """Return a row for each part of the work."""
    parts = dict.fromkeys(part for kind in IMAGES for part in shares[kind])
    return [
        [part, *(f"{100 * shares[kind].get(part, 0.0):.0f} %" for kind in IMAGES)] for part in parts
    ]
