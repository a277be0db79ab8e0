"""Killed commands and full disks: the same command again gives the result of a whole run.

Each command is stopped before one change of its output folder (a file is opened to be written,
renamed, removed), as by `kill -9` or Ctrl-C. `KILLS=20` stops each command 20 times, half of them
at random times, and adds commands that take longer:

    KILLS=20 python -m pytest tests/test_kills.py
"""

import csv
import errno
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pytest
from conftest import DEFAULT_CELL, WORLD, resting, rng, scene_of
from killable import Reply, Request
from recorded_episodes import read_rerun, synthetic_episode

from drake_clutter.files import INTERRUPTION
from drake_clutter.grammar import Orientation
from drake_clutter.recording.hdf5_file import save_episode
from drake_clutter.scenes.scene_file import save_scene
from drake_clutter.simulation.drake_judge import DrakeJudge

NUM_KILLS = int(os.environ.get("KILLS", "1"))
CLI = "drake-clutter"
QUICK = {
    "explore": (CLI, "explore", "SCENE", "--out", "OUT"),
    "solve": (CLI, "solve", "SCENE", "--out", "OUT"),
    "generate": (CLI, "generate", "--nodes", "6", "--count", "2", "--out", "OUT"),
    "evaluate": (CLI, "evaluate", "SCENES", "--agents", "random", "--out", "OUT/results.json"),
    "render": (CLI, "render", "SCENE", "--out", "OUT"),
}
"""Programs with their arguments; SCENE, SCENES, EPISODE, EPISODES and OUT are paths of the test."""
RECORD = (
    *(CLI, "record", "--scenes", "SCENES", "--policy", "random", "--episodes", "2"),
    *("--max-moves", "1", "--cameras", "wrist", "--resolution", "64x48", "--out", "OUT"),
)
LONG = {
    "generate in two processes": (*QUICK["generate"], "--workers", "2"),
    "evaluate in two processes": (*QUICK["evaluate"], "--workers", "2"),
    "explore with the arm": (*QUICK["explore"], "--fidelity", "arm"),
    "record": (*RECORD, "--format", "robomimic"),
    "record for LeRobot": (*RECORD, "--format", "lerobot"),
    "record for Rerun and Foxglove": (*RECORD, "--format", "rerun", "--format", "mcap"),
    "move": (CLI, "move", "SCENE", "--pick", "upper", "--place", "tray", "--out", "OUT"),
    "move, plan": (
        *(CLI, "move", "SCENE", "--pick", "upper", "--place", "tray", "--out", "OUT"),
        *("--fidelity", "arm", "--plan-only"),
    ),
    "run": (CLI, "run", "--set", "scene=SCENE", "--set", "agent=random", "--out", "OUT"),
    "export": (CLI, "export", "SCENE", "--format", "sdf", "--out", "OUT"),
    "export with the cell": (
        *(CLI, "export", "SCENE", "--format", "mjcf", "--with-cell", "--out", "OUT"),
    ),
    "export to USD": (CLI, "export", "SCENE", "--format", "usd", "--with-cell", "--out", "OUT"),
    "view": (CLI, "view", "SCENE", "--html", "OUT/scene.html"),
    "replay to HTML": (CLI, "replay", "EPISODE", "--html", "OUT/episode.html"),
    "replay to MP4": (CLI, "replay", "EPISODE", "--mp4", "OUT/episode.mp4"),
    "replay to Rerun": (CLI, "replay", "EPISODE", "--rrd", "OUT/episode.rrd"),
    "inspect": (CLI, "inspect", "EPISODES", "--plot", "OUT/figure.png"),
    "feasibility": (CLI, "feasibility", "SCENE", "--no-maps", "--out", "OUT"),
    "images": ("training.render_image_dataset", "--count", "20", "--out", "OUT"),
    "scene dataset": (
        *("training.generate_scene_dataset", "--agent", "random", "--nodes", "10", "--count", "2"),
        *("--work", "OUT/work", "--out", "OUT/scenes.json"),
    ),
    "scene dataset with poses": (
        *("training.generate_scene_dataset", "--agent", "random", "--nodes", "10", "--count", "2"),
        *("--with-poses", "--work", "OUT/work", "--out", "OUT/scenes.json"),
    ),
    "train a generator": (
        *("training.train_generator", "--out", "OUT", "--set", "evaluation_scenes=2"),
        *("--set", "task.nodes=6", "--set", "evaluate_every=60", "--set", "save_every=30"),
        *("--set", "learning.width=8", "--set", "learning.num_envs=2"),
        *("--set", "learning.total_timesteps=240", "--set", "learning.learning_starts=20"),
    ),
    "train an explorer": (
        *("training.train_explorer_ppo", "--out", "OUT", "--set", "evaluation_episodes=2"),
        *("--set", "max_moves=2", "--set", "evaluate_every=4", "--set", "learning.width=8"),
        *("--set", "learning.total_timesteps=16", "--set", "learning.episodes_per_iteration=2"),
    ),
}
"""Programs that only `KILLS` above 1 runs."""
COMMANDS = QUICK if NUM_KILLS == 1 else QUICK | LONG
MAX_FILE_SIZE = 1000
"""Largest file that a process can write which stands for one with a full disk [bytes]."""
WALL_TIMES = re.compile(
    r'(?P<key>(?P<quote>"|&quot;)(?:seconds|wall|planning|planning_time|planning_s|p50|p95|p99)'
    r"(?P=quote): (?:\{\s*(?P=quote)median(?P=quote): )?)[-+.e\d]+"
    r"|(?<=<td>)[.\d]+(?= s</td>)"
)
"""Values in a text that differ between two runs."""
Tree = dict[str, bytes | str]
"""Contents of files by their paths."""


@dataclass
class KillServer:
    """The process of `killable`.

    Attributes:
        process: The process.
        folder: Folder of the scenes and of all outputs.
        whole_runs: Replies and files of undisturbed runs, by name of the command.
    """

    process: subprocess.Popen[str]
    folder: Path
    whole_runs: dict[str, tuple[Reply, Tree]] = field(default_factory=dict)

    def run(self, name: str, out: Path, **stop: Any) -> Reply:
        """Run a command, of which `stop` are the last fields of its `Request`."""
        places = {"OUT": str(out), "SCENES": str(self.folder / "scenes")}
        places["SCENE"] = str(self.folder / "scenes" / "scene.yaml")
        places["EPISODES"] = str(self.folder / "episodes")
        places["EPISODE"] = str(self.folder / "episodes" / "episode.h5")
        program, *arguments = COMMANDS[name]
        for place, path in places.items():
            arguments = [re.sub(rf"\b{place}\b", path, text) for text in arguments]
        request = Request(program, tuple(arguments), str(out), f"{out}.log", **stop)
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(asdict(request)), file=self.process.stdin, flush=True)
        return Reply(**json.loads(self.process.stdout.readline()))

    def run_undisturbed(self, name: str) -> tuple[Reply, Tree]:
        """Return how a command ends that is not stopped, and the files that it writes."""
        if name not in self.whole_runs:
            out = self.folder / f"{name}"
            out.mkdir()
            reply = self.run(name, out)
            assert reply.exit_code == 0, read_log(out)
            self.whole_runs[name] = reply, read_tree(out)
        return self.whole_runs[name]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KillServer]:
    folder = tmp_path_factory.mktemp("kills")
    (folder / "scenes").mkdir()
    lower = resting("gelatin_box", Orientation.UPRIGHT_0, name="lower")
    upper = resting("cracker_box", floor=float(lower.bounds_T[1][2]), name="upper")
    scene = scene_of(lower, upper)
    verdict = DrakeJudge(WORLD).judge(scene, rng())
    assert verdict.hidden == ("lower",)
    save_scene(folder / "scenes" / "scene.yaml", scene, DEFAULT_CELL, verdict)
    (folder / "episodes").mkdir()
    save_episode(folder / "episodes" / "episode.h5", synthetic_episode())
    command = [sys.executable, str(Path(__file__).with_name("killable.py"))]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield KillServer(process, folder)
        assert process.stdin is not None
        process.stdin.close()


def read_tree(out: Path) -> Tree:
    """Return all files below a folder, without the times that a run took."""
    tree: Tree = {}
    for path in sorted(out.rglob("*")):
        if "tensorboard" in path.parts:
            continue  # Its files have the time in their names.
        if path.is_file() and path.suffix == ".csv":
            with path.open() as file:
                rows = [row | {"planning_s": ""} for row in csv.DictReader(file)]
            tree[str(path.relative_to(out))] = json.dumps(rows)
        elif path.is_file() and path.suffix == ".parquet":
            from pyarrow import parquet  # which has written the file

            table = parquet.read_table(path)
            rows = [row | {"planning_s": ""} for row in table.to_pylist()]
            tree[str(path.relative_to(out))] = json.dumps(rows)
        elif path.is_file() and path.suffix == ".rrd":
            # Its rows have random identifiers, and one has the time of the recording.
            ignored = re.compile("RowId|start_time")
            entities = {
                entity: [
                    (time, {name: value for name, value in row.items() if not ignored.search(name)})
                    for time, row in rows
                ]
                for entity, rows in read_rerun(path).items()
            }
            tree[str(path.relative_to(out))] = repr(sorted(entities.items(), key=lambda e: e[0]))
        elif path.is_file() and path.suffix in (".json", ".html"):
            text = path.read_text().replace(str(out), "OUT")
            tree[str(path.relative_to(out))] = WALL_TIMES.sub(r"\g<key>", text)
        elif path.is_file():
            tree[str(path.relative_to(out))] = path.read_bytes()
    return tree


def read_log(out: Path) -> str:
    """Return what the commands with an output folder have printed."""
    return Path(f"{out}.log").read_text()


@pytest.mark.parametrize("name", COMMANDS)
def test_a_stopped_command_gives_the_same_result_when_it_is_repeated(
    name: str, server: KillServer
) -> None:
    reference, expected = server.run_undisturbed(name)
    assert expected
    generator = rng(len(name))
    for number in range(1, 1 + NUM_KILLS):
        out = server.folder / f"{name} {number}"
        out.mkdir()
        for _ in range(generator.integers(1, 4) if NUM_KILLS > 1 else 1):
            stop: dict[str, Any] = {"stop_at": int(generator.integers(1, 1 + reference.changes))}
            if number % 4 == 2:
                stop["interrupt"] = True
            elif number % 2 == 0:
                stop = {"stop_after": float(generator.uniform(0, reference.seconds))}
            assert server.run(name, out, **stop).exit_code in (-9, 0, 130), read_log(out)
        assert server.run(name, out).exit_code == 0, read_log(out)
        assert read_tree(out) == expected, stop


@pytest.mark.parametrize("name", COMMANDS)
def test_an_interrupted_command_says_so_in_its_last_line(name: str, server: KillServer) -> None:
    reference, _ = server.run_undisturbed(name)
    out = server.folder / f"{name} interrupted"
    out.mkdir()
    reply = server.run(name, out, stop_at=(1 + reference.changes) // 2, interrupt=True)
    assert reply.exit_code == 130, read_log(out)
    log = read_log(out)
    assert "Traceback" not in log
    assert log.splitlines()[-1] == INTERRUPTION


@pytest.mark.parametrize("name", COMMANDS)
def test_a_full_disk_is_reported_in_one_line(name: str, server: KillServer) -> None:
    server.run_undisturbed(name)  # It caches compiled functions, which are larger than the limit.
    out = server.folder / f"{name} full"
    out.mkdir()
    assert server.run(name, out, max_file_size=MAX_FILE_SIZE).exit_code == 2, read_log(out)
    log = read_log(out)
    assert "Traceback" not in log
    line = log.splitlines()[-1]
    assert line.startswith("error ")
    assert os.strerror(errno.EFBIG) in line
    assert str(out) in line
    assert server.run(name, out).exit_code == 0, read_log(out)


@pytest.mark.parametrize("name", COMMANDS)
def test_an_output_of_the_wrong_kind_is_refused_in_one_line(name: str, server: KillServer) -> None:
    out = server.folder / f"{name} wrong"
    out.write_text("mine")
    assert server.run(name, out).exit_code == 2, read_log(out)
    (line,) = read_log(out).splitlines()
    assert re.match(rf"error --(out|work|html|mp4|rrd|plot) {out}\S*: ", line)
    assert out.read_text() == "mine"
