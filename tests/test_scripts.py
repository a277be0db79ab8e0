"""Scripts of `training/` and `benchmarks/`: every one starts and prints its options."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = [
    path
    for folder in ("training", "benchmarks")
    for path in sorted((ROOT / folder).glob("*.py"))
    if "run_script(" in path.read_text() and path.name != "script.py"
]


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_help(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [path.name, "--help"])
    with pytest.raises(SystemExit) as exit_info:
        runpy.run_path(str(path), run_name="__main__")
    assert exit_info.value.code == 0
    assert "Usage" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [["-m", "benchmarks.layout_penetration"], ["benchmarks/layout_penetration.py"]],
    ids=["module", "file"],
)
def test_a_script_runs_as_module_and_as_file(arguments: list[str]) -> None:
    command = [sys.executable, *arguments, "--count", "2"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "deepest penetration" in result.stdout


def test_a_misuse_is_reported_in_one_line() -> None:
    command = [sys.executable, "-m", "training.evaluate_explorers", "--only", "none"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 2
    assert result.stderr.startswith("error --only none; expected")
    assert result.stderr.count("\n") == 1
