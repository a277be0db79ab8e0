"""The page docs/results/mutation_testing.md."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from benchmarks.mutation_testing import OUTCOMES
from drake_clutter.statistics import wilson_interval
from markdown_text import section, table
from results_files import read_benchmark_results

RESULTS = "benchmarks/results/mutation_testing.json"


def _score(name: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    counts = Counter(row["outcome"] for row in rows)
    judged = len(rows) - counts["equivalent"]
    noticed = counts["caught"] + counts["timed out"]
    low, high = wilson_interval(noticed, judged)
    return [
        name,
        str(len(rows)),
        *(str(counts[outcome]) for outcome in OUTCOMES),
        f"{noticed / len(rows):.3f}",
        f"{noticed / judged:.3f} ({low:.2f} to {high:.2f})",
    ]


def _scores(rows: Sequence[Mapping[str, Any]], sample: int, seed: int) -> str:
    text = section(
        "Scores",
        f"{len(rows)} of a uniform sample of {sample} mutants of the modules that decide results"
        + (". " if len(rows) == sample else "; the others, in changed lines, were not tested. ")
        + "*Caught*: a test fails, or the process ends. *Timed out*: two runs exceed a limit of "
        "processor time, as of a loop without an end. *Equivalent*: the mutant gives the same "
        "results as the original. The last two columns count mutants that are caught or time out. "
        "The results file names the content of the module, as a Git blob, at which each mutant "
        "was tested.",
        command="python benchmarks/mutation_testing.py run --coverage FOLDER",
        seed=seed,
        results=[RESULTS],
    )
    groups = dict.fromkeys(row["group"] for row in rows)
    body = [_score(name, [row for row in rows if row["group"] == name]) for name in groups]
    head = ["modules", "mutants", *OUTCOMES, "of all", "of those not equivalent"]
    return text + table(head, [*body, _score("all", rows)])


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
