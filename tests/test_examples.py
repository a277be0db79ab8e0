"""The scripts in `examples/` run as programs, with options for a short run."""

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import DEFAULT_CELL, resting, scene_of

from drake_clutter import Verdict, save_scene

ROOT = Path(__file__).parents[1]
CASES = {
    "01_generate_scenes": ["--count", "4"],
    "02_inspect_verdict": [],
    "03_explore_scene": [],
    "04_plan_arm_motion": [],
    "05_train_generator": ["--steps", "96", "--scenes", "2"],
    "06_command_arm": [],
    "07_feasibility_study": [],
    "08_add_object_class": ["--nodes", "6"],
    "09_train_maskable_ppo": ["--steps", "1"],
    "10_own_objects": [],
    "11_compose_motions": [],
    "12_own_trajectory": [],
    "13_pick_from_shelf": [],
}
"""Options for a short run of each script."""
HAS_MASKABLE_PPO = importlib.util.find_spec("sb3_contrib") is not None
TUTORIAL_SCRIPTS = list(CASES)[:4]
"""Scripts whose output a tutorial shows."""


def test_cases_contain_every_script() -> None:
    assert sorted(path.stem for path in (ROOT / "examples").glob("*.py")) == sorted(CASES)


@pytest.mark.parametrize("name", CASES)
def test_script_runs(name: str, tmp_path: Path) -> None:
    (tmp_path / "examples").mkdir()
    for file in ("catalog.yaml", "mug.stl"):
        source = ROOT / "examples/custom_class" / file
        target = tmp_path / "examples/custom_class" / file
        target.parent.mkdir(exist_ok=True)
        target.write_bytes(source.read_bytes())
    (tmp_path / "examples/own_objects").mkdir()
    scenes = tmp_path / "out/scenes/scenes"
    scenes.mkdir(parents=True)
    scene = scene_of(resting("pudding_box"))
    verdict = Verdict(None, scene.poses, dict.fromkeys(scene.names, 1.0), ())
    save_scene(scenes / "0000.yaml", scene, DEFAULT_CELL, verdict)
    result = subprocess.run(
        [sys.executable, ROOT / "examples" / f"{name}.py", *CASES[name]],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    if name == "09_train_maskable_ppo" and not HAS_MASKABLE_PPO:
        missing = "skipped: MaskablePPO is not installed; run `pip install sb3-contrib`\n"
        assert result.stdout == missing
    for shown, printed in zip(shown_output(name), result.stdout.splitlines(), strict=False):
        pattern = re.escape(shown).replace(r"\.\.\.", ".*")
        assert re.fullmatch(pattern, without_numbers(printed))


def shown_output(name: str) -> list[str]:
    """Return the output of a script that a tutorial shows, with 0 for all numbers.

    The list is empty if no tutorial shows the output.
    """
    command = shlex.join(["python", f"examples/{name}.py", *CASES[name]])
    for page in (ROOT / "docs/tutorials").glob("*.md"):
        _, found, rest = page.read_text(encoding="utf-8").partition(f"\n$ {command}\n")
        if found:
            output, *_ = re.split(r"^[$`]", rest, maxsplit=1, flags=re.MULTILINE)
            return [without_numbers(line) for line in output.splitlines()]
    return []


def without_numbers(line: str) -> str:
    """Return a line with 0 for all measured numbers, which depend on the version of Drake."""
    return re.sub(r"(?<![\w.])\d+(\.\d+)?(?![\w.])", "0", line)


def test_tutorials_show_the_output_of_scripts() -> None:
    assert [name for name in CASES if shown_output(name)] == TUTORIAL_SCRIPTS


@pytest.mark.parametrize("name", CASES)
def test_script_is_short(name: str) -> None:
    assert len((ROOT / "examples" / f"{name}.py").read_text().splitlines()) < 60


def test_every_script_is_included_in_a_page() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md"))
    assert [name for name in CASES if f'\n--8<-- "examples/{name}.py"\n' not in pages] == []
