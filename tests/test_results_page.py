"""The page of results says what the files of results say."""

from pathlib import Path

from conftest import training_script

PAGE = Path(__file__).parents[1] / "docs/results.md"


def test_the_page_is_that_of_the_files() -> None:
    assert PAGE.read_text() == training_script("results_page").page()


def test_a_figure_that_is_missing_is_left_out() -> None:
    script = training_script("results_page")
    row = {"agent": "sg", "objects": "ycb7", "nodes": 40, "count": 3, "stability_rate": 2 / 3}
    assert script.generator_row(row, "here")[:9] == [
        "sg",
        "ycb7",
        "40",
        "3",
        "",
        "0.67",
        "",
        "",
        "",
    ]
    assert (
        script.generator_row(row | {"layout_failures": {"stack too high": 1}}, "here")[4] == "0.75"
    )
    assert script.with_interval({"a": 0.5, "b": (0.25, 0.75)}, "a", "b") == "0.50 (0.25 to 0.75)"
