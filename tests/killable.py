"""A process that runs commands in forked copies of itself and kills them.

It imports once what all commands need. Each line of its standard input is a `Request` as JSON; the
answer on its standard output is a line with a `Reply`.
"""

import importlib
import json
import os
import resource
import signal
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

_MODULES = (
    "drake_clutter.agents.learned_explorer",
    "drake_clutter.cli",
    "drake_clutter.commands.evaluate_explorers",
    "drake_clutter.commands.feasibility_run",
    "drake_clutter.commands.generate_scenes",
    "drake_clutter.commands.record_dataset",
    "drake_clutter.commands.render_scene",
    "drake_clutter.commands.run_scenario",
    "drake_clutter.commands.solve_scene",
)
_WRITES = frozenset({"os.mkdir", "os.remove", "os.rename", "os.rmdir"})
"""Audit events of changes in a folder, besides "open"."""


@dataclass(frozen=True)
class Request:
    """A program that is run, and when it is stopped.

    Attributes:
        program: Module of a script with a `main`, or "drake-clutter".
        arguments: Command-line arguments.
        folder: Folder whose changes are counted.
        log: File for the standard output and error.
        stop_at: Number of the change before which the program is stopped, from 1 on; 0 for never.
        stop_after: Time after which the program is killed [s].
        interrupt: Whether it is stopped as by Ctrl-C, not as by `kill -9`.
        max_file_size: Largest file that it can write, as if the disk were full beyond it [bytes].
    """

    program: str
    arguments: tuple[str, ...]
    folder: str
    log: str
    stop_at: int = 0
    stop_after: float = float("inf")
    interrupt: bool = False
    max_file_size: int = resource.RLIM_INFINITY


@dataclass(frozen=True)
class Reply:
    """How a program ended.

    Attributes:
        exit_code: Exit code; negative for a signal.
        changes: Number of changes in the folder; 0 if the program was killed.
        seconds: Duration [s].
    """

    exit_code: int
    changes: int
    seconds: float


def main() -> None:
    """Answer requests until the standard input ends."""
    for module in _MODULES:
        importlib.import_module(module)
    for line in sys.stdin:
        fields = json.loads(line)
        request = Request(**fields | {"arguments": tuple(fields["arguments"])})
        print(json.dumps(asdict(_answer(request))), flush=True)


def _answer(request: Request) -> Reply:
    """Run a program in a forked process and return how it ended."""
    start = time.monotonic()
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        _run(request, writer)
    os.close(writer)
    while not (ended := os.waitpid(pid, os.WNOHANG))[0]:
        if time.monotonic() - start > request.stop_after:
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.005)
    with open(reader) as pipe:
        changes = pipe.read()
    return Reply(os.waitstatus_to_exitcode(ended[1]), int(changes or 0), time.monotonic() - start)


def _run(request: Request, writer: int) -> None:
    """Run a program in this forked process, which ends."""
    log = os.open(request.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for descriptor in (1, 2):
        os.dup2(log, descriptor)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    resource.setrlimit(resource.RLIMIT_FSIZE, (request.max_file_size, resource.RLIM_INFINITY))
    changes = 0

    def count_change(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal changes
        is_change = event in _WRITES or (event == "open" and arguments[2] & _OPEN_TO_WRITE)
        if is_change and str(arguments[0]).startswith(request.folder):
            changes += 1
            if changes == request.stop_at and not request.interrupt:
                os.kill(os.getpid(), signal.SIGKILL)
            elif changes == request.stop_at:
                raise KeyboardInterrupt

    sys.argv = [request.program, *request.arguments]
    sys.addaudithook(count_change)
    code: Any = 1
    try:
        if request.program == "drake-clutter":
            from drake_clutter.cli import main as run_command

            run_command()
        else:
            from training.script import run_script

            run_script(importlib.import_module(request.program).main)
        code = 0
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os.write(writer, str(changes).encode())
        os._exit(code if isinstance(code, int) else 1)


_OPEN_TO_WRITE = os.O_WRONLY | os.O_RDWR | os.O_CREAT

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    main()
