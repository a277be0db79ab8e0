"""The page docs/results/intervals.md."""

from markdown_text import number, section, table
from results_files import read_benchmark_results

METHODS = {
    "normal": "normal approximation",
    "student": "Student",
    "bootstrap": "bootstrap",
    "wilson": "Wilson",
    "gaffke": "Gaffke",
}
"""Titles of the columns, by the methods in the results file."""
NORMAL_INTERVALS = {
    "training/results/table1.json": ("hidden_ci95",),
    "training/results/sg_14_110.json": ("hidden_ci95",),
    "training/results/sg_star_100.json": ("hidden_ci95",),
    "training/results/first_trainings.json": ("hidden_ci95",),
    "benchmarks/results/calibration.json": ("hidden_ci95",),
    "benchmarks/results/calibration_explored.json": ("hidden_ci95",),
    "training/results/explorers_fast.json": ("found_ci95", "moves_of_successes_ci95"),
    "training/results/explorers_without_look.json": ("found_ci95", "moves_of_successes_ci95"),
}
"""Results files whose intervals of these means are those of the normal approximation."""


def page() -> str:
    """Return the page."""
    text = "# Confidence intervals\n\n"
    text += (
        "Intervals have a level of 95 % and are computed by `drake_clutter.statistics`.\n\n"
        "| of | method |\n|---|---|\n"
        "| a rate | Wilson's score interval (Wilson 1927), which has the level on average over "
        "rates |\n"
        "| a mean number of objects or moves | Gaffke's interval for quantities with known bounds "
        "(Gaffke 2005) |\n"
        "| a ratio of two means | Gaffke's interval of the mean of numerator - ratio * "
        "denominator |\n\n"
        "Gaffke's interval is conjectured to contain the mean with at least 95 % probability for "
        "any number of values and any distribution between the bounds (Learned-Miller and Thomas "
        "2020, [arXiv:1905.06208](https://arxiv.org/abs/1905.06208)); the coverage below agrees. "
        "For values of 0 and 1 it is the interval of Clopper and Pearson (1934). The bounds are "
        "the node limit for hidden objects, the number of objects for those found, and the move "
        "limit for moves.\n\n"
        "## Intervals of the normal approximation\n\n"
        "The repository does not hold the values of the scenes or episodes of these files, so that "
        "Gaffke's interval cannot be computed. The intervals of their means are the mean plus and "
        "minus 1.96 standard errors, and are marked on the pages that show them. Their coverage "
        "for few values is in the table below.\n\n"
        + table(
            ["results file", "intervals"],
            [
                [f"`{file}`", ", ".join(f"`{name}`" for name in names)]
                for file, names in NORMAL_INTERVALS.items()
            ],
        )
        + "\n"
    )
    text += section(
        "Coverage for few values",
        "Probability that the interval contains the mean of a distribution from 0 to 1, summed "
        "over all samples. *Mostly 0*: 0, 0.25 and 1 with probabilities 0.85, 0.1 and 0.05. "
        "*Mostly 1*: 0, 0.75 and 1 with probabilities 0.02, 0.08 and 0.9. The last column is "
        "the mean width of Gaffke's interval.",
        command="python benchmarks/interval_coverage.py --out FILE",
        seed=0,
        results=["benchmarks/results/interval_coverage.json"],
    )
    rows = read_benchmark_results("interval_coverage.json")["rows"]
    return text + table(
        ["distribution", "values", *METHODS.values(), "width"],
        [
            [
                row["distribution"],
                str(row["count"]),
                *(number(row["coverage"].get(method), 3) for method in METHODS),
                number(row["mean_width"]["gaffke"]),
            ]
            for row in rows
        ],
    )
