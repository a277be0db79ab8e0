"""The page docs/results/mutation_testing.md."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from drake_clutter.statistics import wilson_interval
from markdown_text import section, table
from results_files import read_benchmark_results

RESULTS = "benchmarks/results/mutation_testing.json"


def _score(name: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    counts = Counter(row["outcome"] for row in rows)
    judged = len(rows) - counts["equivalent"]
    interval = wilson_interval(counts["caught"], judged)
    low, high = interval
    return [
        name,
        str(len(rows)),
        str(counts["caught"]),
        str(counts["equivalent"]),
        str(counts["survived"]),
        f"{counts['caught'] / len(rows):.2f}",
        f"{counts['caught'] / judged:.2f} ({low:.2f} to {high:.2f})",
    ]


def _scores(rows: Sequence[Mapping[str, Any]], sample: int, seed: int) -> str:
    text = section(
        "Scores",
        f"{len(rows)} of a uniform sample of {sample} mutants of the modules that decide results. "
        "*Caught*: a test fails, the process ends, or the time limit is exceeded. *Equivalent*: "
        "the mutant gives the same results as the original. The results file names the content "
        "of the module, as a Git blob, at which each mutant was tested.",
        command="python benchmarks/mutation_testing.py run --coverage FOLDER",
        seed=seed,
        results=[RESULTS],
    )
    groups = dict.fromkeys(row["group"] for row in rows)
    body = [_score(name, [row for row in rows if row["group"] == name]) for name in groups]
    head = ["modules", "mutants", "caught", "equivalent", "survived"]
    return text + table(
        [*head, "caught of all", "caught of those not equivalent"], [*body, _score("all", rows)]
    )


def _code(text: str) -> str:
    """Return a text as code in a table's cell."""
    return f"`` {text.replace('|', chr(92) + '|')} ``"


def _listed(title: str, method: str, rows: Iterable[Mapping[str, Any]], last: str) -> str:
    text = section(title, method, results=[RESULTS])
    return text + table(
        ["file", "line", "code", "mutant", last],
        [
            [
                row["path"].removeprefix("drake_clutter/"),
                str(row["line"]),
                _code(row["code"]),
                _code(" ".join(f"{row['original']} -> {row['replacement'] or 'nothing'}".split())),
                row.get("reason", str(row["tests"])),
            ]
            for row in rows
        ],
    )


def page() -> str:
    """Return the page."""
    results = read_benchmark_results("mutation_testing.json")
    rows = results["rows"]
    intro = (
        "# Mutation testing\n\nHow many small faults of the code the tests notice. A mutant is the "
        "code with one change, such as `<=` in place of `<`. The tests that execute the changed "
        "statement are run, the fastest first, until one fails; then other tests of the module "
        "([how to run it](../how_to/test_with_mutants.md)).\n\n"
    )
    survived = [row for row in rows if row["outcome"] == "survived"]
    equivalent = [row for row in rows if row["outcome"] == "equivalent"]
    return intro + "\n".join(
        [
            _scores(rows, results["count"], results["seed"]),
            _listed(
                "Survivors",
                "Mutants that no test catches. *Tests*: number of tests that were run.",
                survived,
                "tests",
            ),
            _listed("Equivalent mutants", "Mutants that cannot be caught.", equivalent, "reason"),
        ]
    )
