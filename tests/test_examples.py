"""Every script of `examples/` runs, as a user runs it, on a small case."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CASES = {
    "01_generate_scenes": ["--count", "2", "--nodes", "8"],
    "02_inspect_verdict": [],
    "03_explore_scene": ["--fidelity", "static_or_drake"],
    "04_plan_arm_motion": [],
    "05_train_generator": ["--steps", "96", "--scenes", "2"],
    "06_command_arm": [],
    "07_feasibility_study": ["--count", "1", "--workers", "1"],
    "08_add_object_class": ["--nodes", "6"],
}
"""Options of the scripts that make the case small."""
LAST_LINE = {
    "02_inspect_verdict": "  Drake: unstable: master_chef_can toppled",
    "03_explore_scene": "ended: all found",
    "07_feasibility_study": "base at x = -1.25 m: ",
}
"""What the last line of a script's output begins with."""


def test_every_script_is_run() -> None:
    assert sorted(path.stem for path in (ROOT / "examples").glob("*.py")) == sorted(CASES)


@pytest.mark.parametrize("name", CASES)
def test_script_runs(name: str, tmp_path: Path) -> None:
    (tmp_path / "examples").mkdir()
    for file in ("catalog.yaml", "mug.stl"):
        source = ROOT / "examples/custom_class" / file
        target = tmp_path / "examples/custom_class" / file
        target.parent.mkdir(exist_ok=True)
        target.write_bytes(source.read_bytes())
    result = subprocess.run(
        [sys.executable, ROOT / "examples" / f"{name}.py", *CASES[name]],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1].startswith(LAST_LINE.get(name, ""))


@pytest.mark.parametrize("name", CASES)
def test_script_is_short(name: str) -> None:
    assert len((ROOT / "examples" / f"{name}.py").read_text().splitlines()) < 60
