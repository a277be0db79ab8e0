"""Run a command on a Ray cluster of two nodes, kill one of them, and compare what is written.

    sudo python benchmarks/ray_node_loss.py FOLDER -- \
        drake-clutter record --scenes sg_star_25 --policy random --episodes 8 --max-moves 2

The nodes are two network namespaces of this machine, which a virtual Ethernet cable connects; to
make them needs Linux and root. The command runs twice, with `--out`, `--workers` and `--ray` added:
with one worker and without Ray into FOLDER/local, and with one worker on each node into FOLDER/ray.
When FOLDER/ray has half of the items of FOLDER/local, which are its files and the lines of its
record files, the cable is cut and every process of the second node is killed. The exit code is 1
unless both folders hold the same bytes; JSON files may differ in `VARYING_FIELDS`. `--results FILE`
adds a row to a results file.
"""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.files import InputError
from training.results_file import ResultsFile, provenance
from training.script import run_script

ADDRESSES = ("10.77.0.1", "10.77.0.2")
"""Addresses of the nodes in their own network; the first one is the head."""
PORT = 6379
RAY = str(Path(sys.executable).with_name("ray"))
"""Ray's program, of the environment of this script."""
POLL_PERIOD = 0.1
"""Period at which the items of the output are counted [s]."""
VARYING_FIELDS = ("seconds", "workers")
"""Fields of JSON files that say how long a run took with how many workers."""


@dataclass(frozen=True)
class Node:
    """A network namespace that acts as a machine.

    Attributes:
        name: Name of the namespace.
        cable: Name of its end of the cable.
        address: Its IP address.
    """

    name: str
    cable: str
    address: str

    def command(self, *words: str) -> list[str]:
        """Return a command that runs on the node."""
        return ["ip", "netns", "exec", self.name, *words]

    def processes(self) -> list[int]:
        """Return the numbers of the processes that run on the node."""
        output = subprocess.run(
            ["ip", "netns", "pids", self.name], capture_output=True, text=True, check=True
        ).stdout
        return [int(word) for word in output.split()]

    def count_workers(self) -> int:
        """Return the number of workers that process an item, by the titles that Ray sets."""
        titles = list[bytes]()
        for process in self.processes():
            with suppress(OSError):  # It has ended.
                titles.append(Path(f"/proc/{process}/cmdline").read_bytes())
        return sum(title.startswith(b"ray::_Actor.work") for title in titles)

    def cut(self) -> None:
        """Cut the cable."""
        run("ip", "-n", self.name, "link", "set", self.cable, "down")

    def kill(self) -> int:
        """Kill all processes of the node and return their number."""
        killed = 0
        while processes := self.processes():
            for process in processes:
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
                    killed += 1
            time.sleep(POLL_PERIOD)
        return killed


def run(*words: str) -> None:
    """Run a command that makes or changes the network.

    Raises:
        InputError: It fails, such as without root.
    """
    result = subprocess.run(words, capture_output=True, text=True)
    if result.returncode:
        message = (result.stderr or result.stdout).strip()
        raise InputError(f"{' '.join(words)}: {message}")


@contextmanager
def connected_nodes() -> Iterator[tuple[Node, Node]]:
    """Yield two nodes with a cable between them; afterwards both are gone."""
    if shutil.which("ip") is None:
        raise InputError("ip: not found; expected the program of the package iproute2")
    first, second = (
        Node(f"clutter_{os.getpid()}_{k}", f"clutter{k}", address)
        for k, address in enumerate(ADDRESSES)
    )
    made = list[Node]()
    try:
        for node in (first, second):
            run("ip", "netns", "add", node.name)
            made.append(node)
        cable = ["ip", "-n", first.name, "link", "add", first.cable, "type", "veth"]
        run(*cable, "peer", "name", second.cable, "netns", second.name)
        for node in made:
            inside = ("ip", "-n", node.name)
            run(*inside, "address", "add", f"{node.address}/24", "dev", node.cable)
            run(*inside, "link", "set", node.cable, "up")
            run(*inside, "link", "set", "lo", "up")
        yield first, second
    finally:
        for node in made:
            node.kill()
            run("ip", "netns", "delete", node.name)


@contextmanager
def ray_cluster(first: Node, second: Node) -> Iterator[str]:
    """Start Ray with one CPU on each node and yield the address of the cluster."""
    with tempfile.TemporaryDirectory(prefix="ray_", ignore_cleanup_errors=True) as folder:
        common = ["--num-cpus", "1", "--disable-usage-stats", "--node-ip-address"]
        head = [RAY, "start", "--head", "--port", str(PORT), "--temp-dir", folder]
        head += ["--include-dashboard", "false", *common, first.address]
        run(*first.command(*head))
        address = f"{first.address}:{PORT}"
        run(*second.command(RAY, "start", "--address", address, *common, second.address))
        try:
            yield address
        finally:
            first.kill()


def count_items(folder: Path) -> int:
    """Return the number of files of a folder, with the lines instead of each record file."""
    items = 0
    for path in folder.rglob("*"):
        with suppress(FileNotFoundError):  # It was temporary.
            if path.suffix == ".jsonl":
                items += path.read_bytes().count(b"\n")
            elif path.is_file():
                items += 1
    return items


def file_hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of a folder, by its path in it.

    `VARYING_FIELDS` of JSON documents are left out.
    """
    hashes = dict[str, str]()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            data = path.read_bytes()
            if path.suffix == ".json" and isinstance(document := json.loads(data), dict):
                kept = {key: document[key] for key in document if key not in VARYING_FIELDS}
                data = json.dumps(kept).encode() if kept != document else data
            hashes[str(path.relative_to(folder))] = hashlib.sha256(data).hexdigest()
    return hashes


def run_here(command: Sequence[str], out: Path) -> int:
    """Run a command and return the largest number of items that its output has had.

    Args:
        command: Command with all options.
        out: Folder of its output.

    Raises:
        InputError: The command ends with an error.
    """
    items = 0
    with subprocess.Popen(command) as process:
        while process.poll() is None:
            items = max(items, count_items(out))
            time.sleep(POLL_PERIOD)
    if process.returncode:
        raise InputError(f"{' '.join(command)}: exit code {process.returncode}")
    return max(items, count_items(out))


def run_with_loss(
    command: Sequence[str], out: Path, items_of_loss: float, nodes: tuple[Node, Node]
) -> dict[str, int]:
    """Run a command on the cluster, and lose the second node on its way.

    Args:
        command: Command with its options but those of the cluster.
        out: Folder of its output.
        items_of_loss: Number of items of the output at which the node is lost.
        nodes: The nodes.

    Returns:
        What was lost, as counts.

    Raises:
        InputError: The command ends with an error, or before the node is lost.
    """
    first, second = nodes
    with ray_cluster(first, second) as address:
        words = [*command, "--workers", "2", "--ray", address]
        with subprocess.Popen(first.command(*words)) as process:
            is_due = False
            while not is_due and process.poll() is None:
                time.sleep(POLL_PERIOD)
                is_due = count_items(out) >= items_of_loss and second.count_workers() > 0
            if not is_due:
                raise InputError(f"{' '.join(words)}: ended before a node was lost")
            loss = {"items_at_loss": count_items(out), "lost_workers": second.count_workers()}
            second.cut()
            loss["killed_processes"] = second.kill()
            if process.wait():
                raise InputError(f"{' '.join(words)}: exit code {process.returncode}")
    return loss


def main(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of both outputs.")],
    command: Annotated[
        list[str], typer.Argument(metavar="-- COMMAND...", help="Command that takes --ray.")
    ],
    output: Annotated[
        str, typer.Option(metavar="NAME", help="Name of the command's --out in each folder.")
    ] = "out",
    results: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Results file to which a row is added.")
    ] = None,
) -> None:
    """Lose a node of a cluster and compare the output with that of a local run."""
    local, there = folder / "local", folder / "ray"
    for path in (local, there):
        if path.exists():
            raise InputError(f"{path}: exists; expected a FOLDER without outputs")
        path.mkdir(parents=True)
    print(f"local: {' '.join(command)}", flush=True)
    items = run_here([*command, "--out", str(local / output), "--workers", "1"], local)
    with connected_nodes() as nodes:
        print("two nodes", flush=True)
        command_there = [*command, "--out", str((there / output).resolve())]
        loss = run_with_loss(command_there, there, items / 2, nodes)
    expected, found = file_hashes(local), file_hashes(there)
    different = sorted(path for path in expected | found if expected.get(path) != found.get(path))
    row = {"items": items, **loss, "files": len(expected), "different": different}
    print(json.dumps(row))
    if results is not None:
        row = {"command": " ".join(command), **row, **provenance()}
        ResultsFile(results, {}, ("command",)).add(row)
    if different:
        raise typer.Exit(1)


if __name__ == "__main__":
    run_script(main)
