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
        "Means of [generated scenes](generation.md) and of the [calibration](calibration.md) have "
        "intervals of the normal approximation: the repository does not hold the numbers of "
        "hidden objects of their 80 to 1000 scenes.\n\n"
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
