"""An interruption and a full disk end a program in one line, and keep finished results."""

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import DEFAULT_CELL, resting, scene_of
from typer.testing import CliRunner

from drake_clutter.cli import app
from drake_clutter.files import atomic_write, cli_error_handler
from drake_clutter.grammar import Orientation
from drake_clutter.learning.checkpoint import load_tensors, save_tensors
from drake_clutter.scenes.scene_file import save_scene

CLI = "from drake_clutter.cli import main; main()"
SCRIPT = """
import os, signal, time
from training.script import run_script
# A background process of a shell ignores SIGINT by default.
signal.signal(signal.SIGINT, signal.default_int_handler)
def main() -> None:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(10)
run_script(main)
"""
INTERRUPTED = "interrupted; finished results are kept\n"
MAX_FILE_SIZE = 1000
"""Largest file that a process can write which stands for one with a full disk [bytes]."""
FIRST_RUN_ENDED = "first run ended with 0\n"
CLI_ON_A_FULL_DISK = f"""
import resource, sys
from pathlib import Path
from drake_clutter.cli import main
# The first run caches compiled functions, whose files are larger than the limit.
try:
    main()
except SystemExit as end:
    print("first run ended with", end.code or 0, flush=True)
resource.setrlimit(resource.RLIMIT_FSIZE, ({MAX_FILE_SIZE}, {MAX_FILE_SIZE}))
sys.argv[-1] = str(Path(sys.argv[-1]).with_name("full"))
main()
"""


def start(program: str, *arguments: str | Path) -> subprocess.Popen[str]:
    """Start a Python program."""
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_an_interrupted_command_says_that_its_results_are_kept(tmp_path: Path) -> None:
    program = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {CLI}"
    arguments = ("generate", "--nodes", "6", "--count", "500", "--out", tmp_path / "out")
    process = start(program, *arguments)
    while not (tmp_path / "out/scenes/0001.yaml").exists():
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate()
    assert process.returncode == 130
    assert errors.endswith(INTERRUPTED)
    assert "Traceback" not in errors
    assert (tmp_path / "out/scenes/0001.yaml").exists()


def test_an_interrupted_script_says_that_its_results_are_kept() -> None:
    process = start(SCRIPT)
    _, errors = process.communicate()
    assert (process.returncode, errors) == (130, INTERRUPTED)


def test_an_interruption_outside_of_a_command_has_the_same_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as end, cli_error_handler():
        raise KeyboardInterrupt
    assert end.value.code == 130
    assert capsys.readouterr().err == INTERRUPTED


def test_a_live_view_ends_without_an_error_when_it_is_interrupted(scene_file: Path) -> None:
    """Ctrl-C is how it is meant to end."""
    program = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {CLI}"
    process = start(program, "view", scene_file)
    assert process.stdout is not None
    assert "press Ctrl-C to stop" in process.stdout.readline()
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate()
    assert process.returncode == 0
    assert "Traceback" not in errors


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "scene.yaml"
    lower = resting("gelatin_box", Orientation.UPRIGHT_0)
    upper = resting("cracker_box", Orientation.FLAT_0, floor=float(lower.bounds_T[1][2]))
    save_scene(path, scene_of(lower, upper), DEFAULT_CELL)
    return path


def test_a_full_disk_is_reported_in_one_line(scene_file: Path, tmp_path: Path) -> None:
    """Commands with `--out` are tested in `test_kills.py`."""
    page = tmp_path / "first"
    process = start(CLI_ON_A_FULL_DISK, "view", scene_file, "--html", page)
    output, errors = process.communicate()
    assert process.returncode == 2, errors
    assert output.endswith(FIRST_RUN_ENDED), errors
    (line,) = errors.splitlines()
    assert line.startswith(f"error --html {tmp_path / 'full'}: cannot be written")
    assert os.strerror(errno.EFBIG) in line


def test_an_error_of_the_program_keeps_its_traceback() -> None:
    with pytest.raises(FileNotFoundError), cli_error_handler():
        Path("no such file").read_bytes()


def test_the_error_of_an_atomic_write_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space") as full, atomic_write(tmp_path / "a.json"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert full.value.filename == str(tmp_path / "a.json")

    class LibraryError(OSError):
        """An error whose file name cannot be set, as those of PyAV."""

        @property
        def filename(self) -> None:
            return None

    with pytest.raises(OSError, match="No space") as full, atomic_write(tmp_path / "a.mp4"):
        raise LibraryError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert full.value.filename == str(tmp_path / "a.mp4")
    with pytest.raises(FileNotFoundError) as missing, atomic_write(tmp_path / "b" / "a.json") as t:
        t.write_text("x")
    assert missing.value.filename == str(tmp_path / "b" / "a.json")


def test_tensors_that_cannot_be_written_are_a_file_error(tmp_path: Path) -> None:
    """The library's own writer raises an error of its own type instead."""
    torch = pytest.importorskip("torch")
    path = tmp_path / "state.safetensors"
    save_tensors(path, {"a": torch.arange(3)}, {"step": 1})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_FILE_SIZE, limits[1]))
    try:
        with pytest.raises(OSError, match=os.strerror(errno.EFBIG)) as full:
            save_tensors(path, {"a": torch.zeros(10_000)}, {"step": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert full.value.filename == str(path)
    tensors, state = load_tensors(path)
    assert json.dumps(state) == '{"step": 1}'
    assert tensors["a"].tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("arguments", "choices"),
    [
        (["explore", "scene.yaml", "--fidelity", "x"], "'static_or_drake', 'settle', 'arm'"),
        (["export", "scene.yaml", "--format", "x"], "'dmd', 'sdf', 'mjcf', 'glb', 'usd'"),
    ],
)
def test_a_wrong_choice_names_the_choices(arguments: list[str], choices: str) -> None:
    result = CliRunner().invoke(app, [*arguments, "--out", "out"])
    message = " ".join(result.stderr.replace("\u2502", "").split())
    assert f"{arguments[2]}': 'x' is not one of {choices}." in message
    assert result.exit_code == 2
