"""Parallel map on a local Ray cluster of two nodes: the same results when workers die."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path

import pytest
import ray
from conftest import DEFAULT_CELL
from failing_workers import broken_factory, make_failing_worker
from ray.cluster_utils import Cluster
from ray_workers import (
    ItemNumbers,
    RandomNumbers,
    make_environment_reader,
    make_sleeper,
    wait_for,
)
from test_cli import ABOVE, BELOW, broken, read_scene_files, run

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.scenes.scene_file import save_scene
from drake_clutter.workers.parallel_map import map_ordered


def to_bytes(results: Iterable[ItemNumbers]) -> list[tuple[int, bytes]]:
    return [(item, numbers.tobytes()) for item, numbers in results]


def busy_worker_processes(cluster: Cluster) -> list[int]:
    """Return the actors that process an item, by the process titles that Ray sets."""
    nodes = {node.all_processes["raylet"][0].process.pid for node in cluster.list_all_nodes()}
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # The process has ended.
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent in nodes and (folder / "cmdline").read_text().startswith("ray::_Actor.work"):
                found.append(int(folder.name))
    return found


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """Return a cluster of two nodes with one CPU each; this process is connected to it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        nodes = Cluster()
        try:
            nodes.add_node(num_cpus=1, include_dashboard=False)
            nodes.add_node(num_cpus=1)
            ray.init(nodes.address, log_to_driver=False)
            yield nodes
        finally:
            ray.shutdown()
            nodes.shutdown()


@pytest.fixture(scope="module")
def local_results(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[int, bytes]]:
    """Return the results of one local worker for the first items."""
    return to_bytes(
        map_ordered(partial(RandomNumbers, tmp_path_factory.mktemp("local")), range(12), workers=1)
    )


def test_results_and_order_are_those_of_one_local_worker(
    cluster: Cluster, tmp_path: Path, local_results: list[tuple[int, bytes]]
) -> None:
    """One of the three workers finds no free CPU, which delays nothing."""
    there = list(
        map_ordered(
            partial(RandomNumbers, tmp_path),
            iter(range(12)),
            workers=3,
            ray_address=cluster.address,
        )
    )
    assert [item for item, _ in there] == list(range(12))
    assert to_bytes(there) == local_results
    assert all(numbers.flags.writeable for _, numbers in there)


def test_items_of_killed_workers_are_repeated_a_limited_number_of_times(
    cluster: Cluster, tmp_path: Path, local_results: list[tuple[int, bytes]]
) -> None:
    make_worker = partial(RandomNumbers, tmp_path, deadly=(0, 5), deadliest=12)
    results = map_ordered(make_worker, range(20), workers=2, ray_address=cluster.address)
    assert to_bytes(islice(results, 12)) == local_results
    with pytest.raises(BrokenProcessPool, match="item 12: 3 worker processes ended"):
        next(results)


def test_items_of_a_lost_node_are_repeated(
    cluster: Cluster, tmp_path: Path, local_results: list[tuple[int, bytes]]
) -> None:
    """The other node's worker computes them; no CPU is free to replace the lost worker."""
    node = next(iter(cluster.worker_nodes))

    def lose() -> None:
        wait_for((tmp_path / "sprung").exists)
        cluster.remove_node(node, allow_graceful=False)

    loser = threading.Thread(target=lose)
    loser.start()
    try:
        make_worker = partial(RandomNumbers, tmp_path, trap=node.node_id)
        assert (
            to_bytes(map_ordered(make_worker, range(12), workers=2, ray_address=cluster.address))
            == local_results
        )
    finally:
        loser.join()
        cluster.add_node(num_cpus=1)
    assert node not in cluster.list_all_nodes()


def test_generate_writes_the_same_scenes_when_a_worker_is_killed(
    cluster: Cluster, tmp_path: Path
) -> None:
    job = GenerationJob("random", "ycb7", None, nodes=5, seed=5, config=ClutterConfig())
    (tmp_path / "local/scenes").mkdir(parents=True)
    for index, made in enumerate(map_ordered(partial(SceneGenerator, job), range(3), workers=1)):
        save_scene(
            tmp_path / f"local/scenes/{index:04d}.yaml",
            made.scene,
            DEFAULT_CELL,
            made.verdict,
        )
    command = [sys.executable, "-c", "from drake_clutter.cli import main; main()"]
    command += [
        "generate",
        "--nodes",
        "5",
        "--count",
        "3",
        "--seed",
        "5",
        "--json",
        "--out",
        str(tmp_path / "there"),
    ]
    command += ["--workers", "2", "--ray", cluster.address]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        os.kill(wait_for(lambda: busy_worker_processes(cluster))[0], signal.SIGKILL)
        output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert read_scene_files(tmp_path / "there") == read_scene_files(tmp_path / "local")
    assert json.loads(output)["count"] == 3  # without the messages of Ray on the killed worker


def test_exceptions_are_raised_unchanged_in_the_order_of_items(cluster: Cluster) -> None:
    results = map_ordered(
        partial(make_failing_worker, 3), range(10), workers=2, ray_address=cluster.address
    )
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(LookupError, match=r"^item 3$"):
        next(results)
    with pytest.raises(LookupError, match=r"^no worker$"):
        next(map_ordered(broken_factory, range(3), workers=1, ray_address=cluster.address))


def test_workers_have_the_folder_and_environment_of_local_ones(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commands run in processes of their own, in this folder, with one thread."""
    monkeypatch.chdir(tmp_path)
    Path("here.txt").write_text("found")
    seen = list(
        map_ordered(
            make_environment_reader, ["here.txt"] * 6, workers=2, ray_address=cluster.address
        )
    )
    pids = {pid for pid, _, _ in seen}
    assert len(pids) <= 2
    assert os.getpid() not in pids
    assert {(text, threads) for _, text, threads in seen} == {("found", "1")}


def test_closing_early_ends_the_workers(cluster: Cluster) -> None:
    read: list[float] = []

    def endless() -> Iterator[float]:
        while True:
            read.append(60.0 if read else 0.0)
            yield read[-1]

    results = map_ordered(make_sleeper, endless(), workers=2, ray_address=cluster.address)
    pid = next(results)
    assert pid != os.getpid()
    start = time.monotonic()
    results.close()
    assert time.monotonic() - start < 10
    wait_for(lambda: not Path(f"/proc/{pid}").exists())
    assert len(read) <= 1 + 8


def test_ctrl_c_ends_the_workers(cluster: Cluster) -> None:
    code = f"""
import signal
from ray_workers import make_sleeper
from drake_clutter.workers.parallel_map import map_ordered
# A background process of a shell ignores SIGINT by default.
signal.signal(signal.SIGINT, signal.default_int_handler)
address = "{cluster.address}"
for result in map_ordered(make_sleeper, [0.0, 60.0, 60.0], workers=2, ray_address=address):
    print(result, flush=True)
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert int(process.stdout.readline()) > 0
        workers = wait_for(lambda: busy_worker_processes(cluster))
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20)
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))
    assert errors.rstrip().endswith(b"KeyboardInterrupt")


def test_without_ray_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r'--ray auto: .* pip install "drake-clutter\[scale\]"'):
        next(map_ordered(make_sleeper, [0.0], workers=1, ray_address="auto"))


def test_an_absent_cluster_is_reported_quickly(tmp_path: Path) -> None:
    settled = {"below": BELOW["X_TO"], "above": ABOVE["X_TO"]}
    verdict = {
        "stable": True,
        "hidden": ["below"],
        "visible_share": {"below": 0.0, "above": 1.0},
        "settled": settled,
    }
    (tmp_path / "scene.yaml").write_text(broken(verdict=verdict))
    start = time.monotonic()
    result = run(
        "evaluate", tmp_path, "--out", tmp_path / "out.json", "--ray", "127.0.0.1:9", code=2
    )
    assert "--ray 127.0.0.1:9: cannot connect to a cluster" in result.stderr
    assert "expected auto, " in result.stderr
    assert time.monotonic() - start < 60
