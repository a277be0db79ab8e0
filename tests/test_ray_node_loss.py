"""The benchmark of a lost node: what it counts, compares and refuses; the network needs root."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import ray_node_loss
from benchmarks.ray_node_loss import count_items, file_hashes, run_here
from drake_clutter.files import InputError

WRITER = """
import pathlib, sys, time
out = pathlib.Path(sys.argv[1])
records = out / "records.jsonl"
records.write_text("{}\\n" * 7)
time.sleep(0.5)
records.unlink()
(out / "summary.json").write_text("{}")
sys.exit(int(sys.argv[2]))
"""
"""A command whose record file is gone when it ends."""


def test_items_are_files_and_lines_of_record_files(tmp_path: Path) -> None:
    assert count_items(tmp_path) == 0
    (tmp_path / "scenes").mkdir()
    for name in ("scenes/0.yaml", "scenes/1.yaml", "sheet.png"):
        (tmp_path / name).write_bytes(bytes(100))
    (tmp_path / "out.json.partial.jsonl").write_text('{"seed": 0}\n{}\n{}\n{"unfin')
    assert count_items(tmp_path) == 3 + 3


def test_the_items_of_a_run_are_counted_while_it_runs(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WRITER, str(tmp_path)]
    assert run_here([*command, "0"], tmp_path) == 7
    assert count_items(tmp_path) == 1
    with pytest.raises(InputError, match="exit code 3"):
        run_here([*command, "3"], tmp_path)


def test_only_times_and_workers_may_differ(tmp_path: Path) -> None:
    documents = {
        "first": {"seconds": 1.5, "workers": 1, "stable": 3},
        "later": {"seconds": 9.0, "workers": 2, "stable": 3},
        "other": {"seconds": 1.5, "workers": 1, "stable": 4},
    }
    for name, document in documents.items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / "summary.json").write_text(json.dumps(document))
        (folder / "list.json").write_text("[1, 2]")
        (folder / "scene.yaml").write_text("seconds: 1\n")
    assert file_hashes(tmp_path / "first") == file_hashes(tmp_path / "later")
    first, other = file_hashes(tmp_path / "first"), file_hashes(tmp_path / "other")
    assert [name for name in first if first[name] != other[name]] == ["summary.json"]
    (tmp_path / "later/scene.yaml").write_text("seconds: 2\n")
    assert file_hashes(tmp_path / "first") != file_hashes(tmp_path / "later")


def test_a_folder_with_outputs_is_refused(tmp_path: Path) -> None:
    (tmp_path / "local").mkdir()
    with pytest.raises(InputError, match="local: exists; expected a FOLDER without outputs"):
        ray_node_loss.main(tmp_path, ["true"])


@pytest.mark.skipif(os.getuid() != 0, reason="network namespaces need root")
def test_processes_of_a_lost_node_are_killed() -> None:
    node = ray_node_loss.Node(f"clutter_test_{os.getpid()}", "clutter0", "10.77.0.1")
    try:
        ray_node_loss.run("ip", "netns", "add", node.name)
    except (InputError, FileNotFoundError) as error:
        pytest.skip(f"no network namespaces: {error}")
    try:
        with subprocess.Popen(node.command("sleep", "60")) as process:
            while not node.processes():
                assert process.poll() is None
            assert node.count_workers() == 0
            assert node.kill() >= 1
            assert process.wait() < 0
        assert node.processes() == []
    finally:
        ray_node_loss.run("ip", "netns", "delete", node.name)
