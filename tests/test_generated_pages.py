"""Generated pages of the documentation: numbers of results files, and references to the code."""

import importlib
import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
import typer.main

import cli_page
import configuration_page
import environments_page
import results_arm
import results_calibration
import results_closed_loop
import results_exploration
import results_export
import results_feasibility
import results_generation
import results_index
import results_intervals
import results_judge_agreement
import results_mutation
import results_negative
import results_perception
import results_recording
import results_rendering
import results_target_search
from markdown_text import estimate, number, table
from results_files import with_current_keys

ROOT = Path(__file__).parents[1]
RESULTS = {
    module.__name__: module.page
    for module in (
        results_arm,
        results_calibration,
        results_closed_loop,
        results_exploration,
        results_export,
        results_feasibility,
        results_generation,
        results_index,
        results_intervals,
        results_judge_agreement,
        results_mutation,
        results_negative,
        results_perception,
        results_recording,
        results_rendering,
        results_target_search,
    )
}
FILE = re.compile(r"`((?:training|benchmarks)/[\w./-]+)`")
COMMAND = re.compile(r"- Command: `python ((training|benchmarks)/(\w+)\.py)( [^`]*)`")


def rows_of(text: str, *cells: str) -> list[list[str]]:
    """Return the table rows of a page that begin with these cells."""
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith("| ")
    ]
    return [row for row in rows if row[: len(cells)] == list(cells)]


def test_coverage_of_intervals() -> None:
    """Of three values, the normal interval holds 0.05 if one or two are 1; Wilson's if none is."""
    row = rows_of(results_intervals.page(), "0 or 1, p = 0.05", "3")[0]
    normal, wilson = row[2], row[5]
    assert normal == f"{3 * 0.05 * 0.95**2 + 3 * 0.05**2 * 0.95:.3f}"
    assert wilson == f"{0.95**3:.3f}"


@pytest.mark.parametrize("name", RESULTS)
def test_pages_of_results_name_files_that_exist(name: str) -> None:
    text = RESULTS[name]()
    named = FILE.findall(text) + [match[1] for match in COMMAND.finditer(text)]
    assert named
    assert [path for path in named if not (ROOT / path).exists()] == []
    images = re.findall(r"\]\(\.\./images/([\w.]+)\)", text)
    assert [image for image in images if not (ROOT / "docs/images" / image).exists()] == []


@pytest.mark.parametrize("name", RESULTS)
def test_pages_of_results_name_commands_that_parse(name: str) -> None:
    for match in COMMAND.finditer(RESULTS[name]()):
        module = importlib.import_module(f"{match[2]}.{match[3]}")
        words = match[4].split()
        function = module.main if hasattr(module, "main") else None
        if function is None:  # The first word names a command of several.
            function = getattr(module, words.pop(0).replace("-", "_"))
        app = typer.Typer()
        app.command()(function)
        command: Any = typer.main.get_command(app)
        command.make_context(match[3], words)


def test_generation_page_has_the_rows_of_table_one() -> None:
    row, diversity, *_ = rows_of(results_generation.page(), "SG\\*", "ycb7", "25")
    assert row[3:6] == ["1000", "0.98 (0.96 to 0.98)", "0.88"]
    assert row[6:8] == ["10.1 (10.0 to 10.3)", "7.45"]
    assert diversity[3:5] == ["0.98", "1.00"]


def test_exploration_page_has_the_rows_of_tables_two_and_three() -> None:
    text = results_exploration.page()
    success, found, *_ = rows_of(text, "paper_hardness", "SE\\*")
    assert success[2:5] == ["300", "0.91 (0.88 to 0.94)", "0.91"]
    assert found[2:6] == ["7.3", "7.0", "5.8", "7.1"]
    row = rows_of(text, "sg_star_25", "10", "SE\\*, DAgger", "SE^r")[0]
    assert row[4:] == ["23", "3", "9e-05"]  # paired by scene, two-sided sign test


def test_closed_loop_page_words_reasons_as_the_code_does() -> None:
    row = rows_of(results_closed_loop.page(), "sg_star_25", "depth", "arm", "1", "100")[0]
    assert row[3] == "1"
    assert row[5:8] == ["0.71 (0.61 to 0.79)", "0.83", "0.86 (0.76 to 0.92)"]
    assert row[8].startswith("15 collapsed, 13 remaining objects unreachable by suction")


def test_results_files_of_version_0_1_are_read_with_current_keys() -> None:
    given = {"rows": [{"recall_by_visible_share": {"0 to 0.1": {"share": 0.5}}, "count": 3}]}
    expected = {
        "rows": [{"recall_by_visible_fraction": {"0 to 0.1": {"fraction": 0.5}}, "count": 3}]
    }
    assert with_current_keys(given) == with_current_keys(expected) == expected


def test_missing_numbers_are_empty_cells() -> None:
    assert number(None) == ""
    assert estimate({"rate": 0.5}, "rate", "interval") == "0.50"
    row = {"rate": 0.5, "interval": (0.25, 0.75)}
    assert estimate(row, "rate", "interval") == "0.50 (0.25 to 0.75)"
    assert results_generation.layout_rate({"count": 3}) == ""
    failures = {"stack too high": 1}
    assert results_generation.layout_rate({"count": 3, "layout_failures": failures}) == "0.75"


def test_tables_align_numbers_to_the_right() -> None:
    text = table(["name", "rate"], [["a", "0.5 (0.2 to 0.8)"], ["b", ""]])
    assert text.splitlines()[1] == "| --- | ---: |"
    with pytest.raises(ValueError, match="another length"):
        table(["name", "rate"], [["a"]])


def test_command_line_page_has_every_option() -> None:
    text = cli_page.page()
    for option in ("--scenario FILE", "--cell FILE", "--set FIELD=VALUE", "--workers"):
        assert f"`{option}" in text
    assert rows_of(text, "`--seed <int range>`")[0][2] == "default: 0; 0<=x<=9223372036854775807"


def test_configuration_page_has_types_defaults_and_ranges() -> None:
    text = configuration_page.page()
    assert rows_of(text, "`standing_gap`")[0][1:4] == ["number", "0.05", "≥ 0"]
    assert rows_of(text, "`nodes`")[0][1:4] == ["integer", "25", "3 to 200"]
    assert rows_of(text, "`size`")[0][1:4] == ["list of 2 numbers", "required", "0.1 to 2"]
    assert rows_of(text, "`ik`")[0][3] == "`ur`, `numerical`"


def test_every_field_of_a_config_is_described() -> None:
    classes = {
        cls
        for *_, root in configuration_page.ROOTS
        for cls in configuration_page.config_classes(root)
    }
    missing = {
        f"{cls.__name__}.{field.name}"
        for cls in classes
        for field in configuration_page.config_fields(cls)
        if not field.meaning
    }
    assert missing == set()


def test_environments_page_describes_both_observation_spaces() -> None:
    text = environments_page.page()
    assert "<!--" not in text
    assert rows_of(text, "`position`")[0][1:4] == ["(25, 3)", "float32", "-0.7 to 0.7"]
    assert "`MultiDiscrete([25 25])`" in text


def symmetric_intervals(document: Any) -> set[str]:
    """Return the names of intervals of means whose center is the mean, other than 1/2."""
    if isinstance(document, list):
        return set().union(*map(symmetric_intervals, document))
    names = set[str]()
    for key, value in document.items() if isinstance(document, dict) else ():
        names |= symmetric_intervals(value)
        base = key.removesuffix("_ci95")
        mean = document.get(base, document.get(f"{base}_mean"))
        is_interval = base != key and value and value[0] < value[1] and mean not in (None, 0.5)
        if is_interval and math.isclose(sum(value) / 2, mean, rel_tol=1e-9):
            names.add(key)
    return names


def test_intervals_of_the_normal_approximation_are_listed() -> None:
    """They are symmetric; those of Wilson and Gaffke are not."""
    files = {*ROOT.glob("training/results/*.json"), *ROOT.glob("benchmarks/results/*.json")}
    found = {
        str(path.relative_to(ROOT)): symmetric_intervals(json.loads(path.read_text()))
        for path in files
    }
    assert {file: names for file, names in found.items() if names} == {
        file: set(names) for file, names in results_intervals.NORMAL_INTERVALS.items()
    }
    page = results_intervals.page()
    assert all(f"| `{file}` |" in page for file in results_intervals.NORMAL_INTERVALS)
