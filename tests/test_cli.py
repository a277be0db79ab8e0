"""Commands in processes of their own, on small scenes."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

FLAT = [0.7071, 0.0, 0.7071, 0.0]
ALONE = {"translation": [0.0, 0.0, 0.03], "quaternion": FLAT}
BELOW = {
    "name": "below",
    "class": "gelatin_box",
    "X_TO": {"translation": [0.0, 0.0, 0.014], "quaternion": FLAT},
}
ABOVE = {
    "name": "above",
    "class": "cracker_box",
    "X_TO": {"translation": [0.0, 0.0, 0.058], "quaternion": FLAT},
}
SCENE = {"version": 1, "objects": [BELOW, ABOVE]}


def run(*arguments: str | Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own and check its exit code."""
    command = [
        sys.executable,
        "-c",
        "from drake_clutter.cli import main; main()",
        *map(str, arguments),
    ]
    result = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert result.returncode == code, f"{result.returncode}\n{result.stdout}\n{result.stderr}"
    return result


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A gelatin box hidden under a cracker box."""
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(SCENE))
    return path


def read_scene_files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "scenes").iterdir())}


def generate(out: Path, count: int, *more: str) -> dict[str, object]:
    summary: dict[str, object] = json.loads(
        run(
            "generate",
            "--nodes",
            "6",
            "--count",
            str(count),
            "--seed",
            "5",
            "--json",
            "--out",
            out,
            *more,
        ).stdout
    )
    return summary


def test_generate_resumes_and_does_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    whole = generate(tmp_path / "whole", 4, "--workers", "2")
    generate(tmp_path / "parts", 2)
    parts = generate(tmp_path / "parts", 4)
    assert read_scene_files(tmp_path / "whole") == read_scene_files(tmp_path / "parts")
    assert list(read_scene_files(tmp_path / "whole")) == [
        "0000.yaml",
        "0001.yaml",
        "0002.yaml",
        "0003.yaml",
    ]
    timing = {"seconds", "workers"}
    assert {k: v for k, v in whole.items() if k not in timing} == {
        k: v for k, v in parts.items() if k not in timing
    }
    fields = "nodes count stability_rate stability_ci95 hidden_mean hidden_ci95 distinct_share "
    fields += "mean_stacks seconds seed config"
    assert set(fields.split()) <= set(whole)
    assert json.loads((tmp_path / "whole/summary.json").read_text()) == whole
    assert Image.open(tmp_path / "whole/contact_sheet.png").width > 400
    stable = 0
    for path in (tmp_path / "whole/scenes").iterdir():
        document = yaml.safe_load(path.read_text())
        assert len(document["graph"]["nodes"]) == 6
        stable += document["verdict"]["stable"]
    assert whole["stability_rate"] == stable / 4


def test_generate_resumes_after_a_kill(tmp_path: Path) -> None:
    out = tmp_path / "killed"
    command = [sys.executable, "-c", "from drake_clutter.cli import main; main()"]
    command += ["generate", "--nodes", "6", "--count", "4", "--seed", "5", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not (out / "scenes/0001.yaml").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    generate(out, 4)
    generate(tmp_path / "whole", 4)
    assert read_scene_files(out) == read_scene_files(tmp_path / "whole")


@pytest.mark.parametrize("fidelity", ["settle", "static_or_drake"])
def test_explore_finds_the_hidden_object(fidelity: str, scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "episode"
    options = ("--agent", "largest-clear", "--fidelity", fidelity, "--json")
    printed = json.loads(run("explore", scene, *options, "--out", out).stdout)
    episode = json.loads((out / "episode.json").read_text())
    assert printed == episode
    assert episode["fidelity"] == fidelity
    assert episode["success"] is True
    assert episode["initially_hidden"] == episode["found"] == ["below"]
    (only,) = episode["moves"]
    assert only["move"] == {"pick": "above", "place": "tray"}
    assert only["outcome"] == "placed"
    assert only["newly_found"] == ["below"]
    assert only["visible_fractions"]["below"] > 0.99
    assert only["reward"] == 1.0
    assert (out / "index.html").is_file()


def test_solve_finds_a_plan_of_one_move_that_drake_confirms(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "solution"
    printed = json.loads(run("solve", scene, "--json", "--out", out).stdout)
    assert printed == json.loads((out / "solution.json").read_text())
    assert (
        printed["solvability"],
        printed["moves"],
        printed["is_optimal"],
        printed["confirmed"],
    ) == (
        "solvable",
        1,
        True,
        True,
    )
    assert yaml.safe_load((out / "moves.yaml").read_text()) == [{"pick": "above", "place": "tray"}]
    assert json.loads((out / "episode.json").read_text())["found"] == ["below"]
    assert (out / "index.html").is_file()


def test_evaluate_does_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    settled = {"below": BELOW["X_TO"], "above": ABOVE["X_TO"]}
    verdict = {
        "stable": True,
        "hidden": ["below"],
        "visible_share": {"below": 0.0, "above": 1.0},
        "settled": settled,
    }
    (tmp_path / "scenes").mkdir()
    for name in ("one", "two"):
        (tmp_path / f"scenes/{name}.yaml").write_text(broken(verdict=verdict))
    alone, together = tmp_path / "alone.json", tmp_path / "together.json"
    given = (
        "evaluate",
        "--scenes",
        tmp_path / "scenes",
        "--agents",
        "random,largest-first",
        "--max-moves",
        "2",
    )
    run(*given, "--out", alone)
    agents = ("--agent", "random", "--agent", "largest-first")
    run(
        "evaluate",
        tmp_path / "scenes",
        *agents,
        "--max-moves",
        "2",
        "--workers",
        "2",
        "--out",
        together,
    )
    assert alone.read_bytes() == together.read_bytes()
    written = json.loads(alone.read_text())
    files = [tmp_path / "scenes/one.yaml", tmp_path / "scenes/two.yaml"]
    assert written["scenes"] == {
        str(file): hashlib.sha256(file.read_bytes()).hexdigest() for file in files
    }
    random, largest_first = written["rows"]
    assert random["agent"] == "random"
    assert largest_first["within_2"]["success"] == 1.0
    assert largest_first["moves_of_successes"] == 1.0
    assert largest_first["hidden"] == largest_first["within_2"]["found"] == 1.0


def test_evaluate_accepts_names_of_shipped_scene_datasets() -> None:
    shown = run(
        "evaluate",
        "--scenes",
        "sg_star_10",
        "--max-scenes",
        "2",
        "--agents",
        "largest-clear",
        "--fidelity",
        "static_or_drake",
        "--json",
    )
    (row,) = json.loads(shown.stdout)
    assert (row["agent"], row["episodes"]) == ("largest-clear", 2)
    assert row["hidden"] > 0
    assert "--scenes: expected once" in run("evaluate", code=2).stderr


def test_move_executes_a_list(scene: Path, tmp_path: Path) -> None:
    moves = tmp_path / "moves.yaml"
    moves.write_text("- {pick: above, place: tray}\n- {pick: below, place: above}\n")
    run("move", scene, "--moves", moves, "--out", tmp_path / "out")
    episode = json.loads((tmp_path / "out/episode.json").read_text())
    assert [step["outcome"] for step in episode["moves"]] == ["placed", "placed"]
    after = {
        o["name"]: o["X_TO"]["translation"]
        for o in yaml.safe_load((tmp_path / "out/after.yaml").read_text())["objects"]
    }
    assert after["below"][2] == pytest.approx(0.060 + 0.014, abs=5e-4)
    assert np.allclose(after["below"][:2], after["above"][:2], atol=0.01)


def test_render_writes_camera_images(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "images"
    run("render", scene, "--out", out)
    visible = json.loads((out / "visible.json").read_text())
    assert visible["hidden"] == ["below"]
    depth = np.asarray(Image.open(out / "depth.png"), float) * 1e-4
    assert depth[240, 320] == pytest.approx(1.6 - 0.088, abs=2e-3)
    label = np.asarray(Image.open(out / "label.png"))
    assert label[240, 320] == 2
    assert set(np.unique(label)) == {0, 2}
    assert np.asarray(Image.open(out / "color.png")).shape == (480, 640, 3)


def test_view_and_export_write_files(scene: Path, tmp_path: Path) -> None:
    run("view", scene, "--html", tmp_path / "scene.html")
    assert (tmp_path / "scene.html").stat().st_size > 100_000
    run("export", scene, "--format", "mjcf", "--with-cell", "--out", tmp_path / "mjcf")
    assert 'name="robot/' in (tmp_path / "mjcf" / "scene.xml").read_text()
    assert (tmp_path / "mjcf/scene.xml").is_file()


def broken(**changes: object) -> str:
    return str(yaml.safe_dump({**SCENE, **changes}))


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("generate", "--nodes", "2", "--out", "new"), ("nodes", "2", "3")),
        (("generate", "--count", "0", "--out", "new"), ("--count 0",)),
        (("generate", "--objects", "nothing", "--out", "new"), ("nothing", "ycb7")),
        (("generate", "--out", "full"), ("full", "not empty")),
        (("generate", "--out", "scene.yaml"), ("scene.yaml", "is a file")),
        (("generate", "--catalog", "full", "--out", "new"), ("catalog.yaml",)),
        (
            ("generate", "--config", "config.yaml", "--out", "new"),
            ("config.yaml", "visibility_threshold"),
        ),
        (("explore", "missing.yaml", "--out", "new"), ("missing.yaml",)),
        (
            ("explore", "unknown.yaml", "--out", "new"),
            ("unknown.yaml", "objects[0].class", "teapot"),
        ),
        (("explore", "overlap.yaml", "--out", "new"), ("overlap.yaml", "above", "below", "mm")),
        (("explore", "unstable.yaml", "--out", "new"), ("not stable",)),
        (("evaluate", "--scenes", "full", "--out", "new.json"), ("full", "no scene files")),
        (
            ("move", "scene.yaml", "--pick", "below", "--place", "tray", "--out", "new"),
            ("below", "not in view"),
        ),
        (("move", "scene.yaml", "--pick", "above", "--out", "new"), ("--pick", "--moves")),
        (("export", "scene.yaml", "--format", "glb", "--out", "full"), ("full", "not empty")),
    ],
)
def test_invalid_input_is_one_line_and_writes_nothing(
    tmp_path: Path,
    scene: Path,
    arguments: Sequence[str],
    parts: Sequence[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("mine")
    (tmp_path / "config.yaml").write_text("camera: {visibility_threshold: -1}")
    (tmp_path / "unknown.yaml").write_text(
        broken(objects=[{"name": "a", "class": "teapot", "X_TO": ALONE}])
    )
    (tmp_path / "overlap.yaml").write_text(
        broken(objects=[BELOW, {**ABOVE, "X_TO": {**ALONE, "translation": [0.0, 0.0, 0.05]}}])
    )
    high = {**ALONE, "translation": [0.0, 0.0, 0.3]}
    (tmp_path / "unstable.yaml").write_text(
        broken(objects=[{"name": "a", "class": "cracker_box", "X_TO": high}])
    )
    before = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*"))
    result = run(*arguments, code=2)
    assert result.stderr.startswith("error")
    for part in parts:
        assert part in result.stderr
    assert "Traceback" not in result.stderr
    written = [path for path in tmp_path.rglob("*") if path.relative_to(tmp_path) not in before]
    assert [path for path in written if path.is_file()] == []
    assert (tmp_path / "full/mine.txt").read_text() == "mine"
