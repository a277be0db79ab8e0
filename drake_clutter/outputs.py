"""Output folders and files: one writer at a time, and nothing left of interrupted runs.

Whatever writes results keeps `output_folder` or `output_file` open meanwhile, which hold a lock of
the operating system (flock) on a hidden file. Such a lock ends with the process that holds it,
however that ends, so the next run takes over the lock file of a killed one. Between hosts the lock
holds on file systems that have locks of their own: NFS 4, NFS 3 with lockd, CIFS, Lustre mounted
with `flock`. On others a warning says that the output is not locked.
"""

import errno
import fcntl
import os
import shutil
import socket
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from drake_clutter.files import InputError, is_temporary

_LOCK_SUFFIX = ".lock"
"""Name of the lock file of a folder, and ending of the hidden one beside a file."""
_NO_LOCKS = frozenset({errno.EINVAL, errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP})
"""Errors of a file system without locks."""


@contextmanager
def output_folder(path: Path) -> Iterator[Path]:
    """Create and lock an output folder, and remove the temporary files of killed runs.

    Args:
        path: The folder, which is created with its parents if it does not exist.

    Yields:
        The folder.

    Raises:
        InputError: The path is not a folder or not writable, or another run writes to the folder.
    """
    new_folder = "give a folder that is new or empty"
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"--out {path}: is a file; {new_folder}") from error
    except OSError as error:
        raise InputError(
            f"--out {path}: cannot be created ({error.strerror}); give a writable folder"
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"--out {path}: is not writable; give a writable folder")
    with _lock(path / _LOCK_SUFFIX, path):
        _remove_leftovers(path)
        for entry in path.iterdir():
            if entry.is_dir():
                _remove_leftovers(entry)
        yield path


def check_folder_is_empty(path: Path) -> None:
    """Check that a folder contains no files but the lock file; empty subfolders are allowed.

    Args:
        path: The output folder.

    Raises:
        InputError: The folder contains files.
    """
    if entry := find_result(path):
        raise InputError(
            f"--out {path}: is not empty (holds {entry.name}); give a folder that is new or empty"
        )


def find_result(folder: Path, ignored: Iterable[str] = ()) -> Path | None:
    """Return an entry of an output folder that is, or contains, a file; None if it has none.

    Args:
        folder: The output folder.
        ignored: Names of entries that do not count. The lock file never does.
    """
    for entry in sorted(folder.iterdir()):
        if entry.name in (_LOCK_SUFFIX, *ignored):
            continue
        if not entry.is_dir() or any(not below.is_dir() for below in entry.rglob("*")):
            return entry
    return None


@contextmanager
def output_file(path: Path, option: str = "--out") -> Iterator[Path]:
    """Lock an output file, and remove the temporary files of killed runs.

    Args:
        path: The file; its folder is created if it does not exist.
        option: Option that names the file, for messages.

    Yields:
        The file.

    Raises:
        InputError: The path is a folder, its folder cannot be created, or another run writes to
            the file.
    """
    expected = "give a file in a writable folder"
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; {expected}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{option} {path}: cannot be written ({error.strerror}); {expected}"
        ) from error
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(f"{option} {path}: its folder is not writable; {expected}")
    with _lock(path.with_name(f".{path.name}{_LOCK_SUFFIX}"), path):
        _remove_leftovers(path.parent, path)
        yield path


@contextmanager
def _lock(lock_file: Path, out: Path) -> Iterator[None]:
    """Hold the lock of an output; at the end, remove the lock file.

    An `OSError` without a file name, such as that of a full disk, gets the name of the output.
    """
    descriptor = _acquire(lock_file, out)
    try:
        yield
    except OSError as error:
        if error.filename is None:
            raise OSError(error.errno, error.strerror, str(out)) from error
        raise
    finally:
        with suppress(FileNotFoundError):
            lock_file.unlink()
        os.close(descriptor)


def _acquire(lock_file: Path, out: Path) -> int:
    """Return the descriptor of a lock file that this process has locked."""
    while True:
        try:
            descriptor = os.open(lock_file, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(out)) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                owner = _read_owner(descriptor)
                os.close(descriptor)
                raise InputError(
                    f"{out}: is in use by {owner}; wait until it ends, or give another place"
                ) from error
            print(f"warning {out}: is not locked ({error.strerror})", file=sys.stderr)
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), lock_file.stat()):
                _write_owner(descriptor)
                return descriptor
        os.close(descriptor)  # The process that held the lock before has removed this file.


def _write_owner(descriptor: int) -> None:
    """Write the name of this process into its lock file."""
    with suppress(OSError):  # A full disk: the name serves only for a message.
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)


def _read_owner(descriptor: int) -> str:
    """Return the name of the process that holds a lock file."""
    name = ""
    with suppress(OSError, UnicodeDecodeError):
        name = os.pread(descriptor, 200, 0).decode()
    return name or "another process"


def _remove_leftovers(folder: Path, out: Path | None = None) -> None:
    """Remove the temporary entries of a folder, or those of one file in it."""
    for entry in list(folder.iterdir()):
        if not is_temporary(entry, out):
            continue
        if entry.is_dir():
            shutil.rmtree(entry)
        else:
            entry.unlink(missing_ok=True)
