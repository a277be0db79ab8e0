"""Output folders and files: one writer at a time, and clear errors."""

import errno
import fcntl
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from drake_clutter.files import InputError
from drake_clutter.outputs import check_folder_is_empty, output_file, output_folder

HOLDER = """
import sys, time
from pathlib import Path
from drake_clutter.outputs import output_file, output_folder
with {lock}(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""
Lock = Callable[[Path], AbstractContextManager[Path]]


@pytest.mark.parametrize("lock", [output_folder, output_file])
def test_a_second_writer_is_refused_and_a_killed_one_replaced(lock: Lock, tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    name = "output_folder" if lock is output_folder else "output_file"
    command = [sys.executable, "-c", HOLDER.format(lock=name), str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        owner = f"{out}: is in use by process {holder.pid} on {socket.gethostname()}"
        with pytest.raises(InputError, match=owner), lock(out):
            pass
        holder.send_signal(signal.SIGKILL)
    assert [path for path in out.parent.rglob("*") if path.is_file()] != []
    with lock(out):
        pass
    assert [path for path in out.parent.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("lock", [output_folder, output_file])
def test_an_error_without_a_file_name_gets_that_of_the_output(lock: Lock, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(OSError, match="No space") as full, lock(out):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert full.value.filename == str(out)
    with pytest.raises(FileNotFoundError) as missing, lock(out):
        (tmp_path / "missing").read_bytes()
    assert missing.value.filename == str(tmp_path / "missing")


def test_a_file_system_without_locks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with output_folder(tmp_path), output_folder(tmp_path):
        pass
    line = f"warning {tmp_path}: is not locked ({os.strerror(errno.ENOLCK)})\n"
    assert capsys.readouterr().err == 2 * line


def test_a_folder_is_created_with_its_parents(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    with output_folder(out) as folder:
        assert folder == out
        (out / "empty").mkdir()
        check_folder_is_empty(out)
        (out / "empty" / "summary.json").touch()
        with pytest.raises(InputError, match=r"is not empty \(holds empty\); give a folder"):
            check_folder_is_empty(out)


def test_a_file_instead_of_a_folder_and_the_reverse(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    below = tmp_path / "file" / "below"
    for path in (tmp_path / "file", below):
        with pytest.raises(InputError, match=f"--out {path}: is a file"), output_folder(path):
            pass
    with pytest.raises(InputError, match=f"--out {tmp_path}: is a folder"), output_file(tmp_path):
        pass
    with pytest.raises(InputError, match=f"--out {below}: cannot be written"), output_file(below):
        pass


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write to any folder")
def test_a_folder_that_is_not_writable(tmp_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    with pytest.raises(InputError, match="is not writable"), output_folder(locked):
        pass
    with pytest.raises(InputError, match="cannot be created"), output_folder(locked / "below"):
        pass
    with pytest.raises(InputError, match="is not writable"), output_file(locked / "file"):
        pass
