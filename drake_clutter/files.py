"""Atomic writing of files, and errors in user input."""

import errno
import hashlib
import json
import os
import re
import reprlib
import secrets
import stat
import sys
import tempfile
import traceback
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

MAX_MESSAGE_LENGTH = 300
"""Largest number of characters of a message after the name of its file; the rest is cut."""

INTERRUPTION = "interrupted; finished results are kept"
"""What an interrupted program prints."""
_INTERRUPTED = 130
"""Exit code of an interrupted program, 128 + SIGINT."""
_STORAGE_ERRORS = frozenset(
    {
        errno.EACCES,
        errno.EDQUOT,
        errno.EFBIG,
        errno.EIO,
        errno.ENAMETOOLONG,
        errno.ENOSPC,
        errno.EPERM,
        errno.EROFS,
    }
)
"""Errors of the file system that have their cause in the machine, not in the program."""
_TEMPORARY_NAME = re.compile(r"\.(?P<stem>.+)\.tmp-[0-9a-f]{8}(?P<suffix>(\.[^.]*)?)")
"""Name of a `temporary_path`."""

MAX_FILE_SIZE = 4 * 2**30
"""Largest size of a file that is read [bytes].

The largest ones are states of trainings, with replay buffers.
"""
MAX_TEXT_SIZE = 2**28
"""Largest size of a text file that is read [bytes]. Its document takes about ten times as much."""

MAX_ERROR_LENGTH = 500
"""Largest number of characters of a whole error message; more than a terminal shows at a glance."""


class InputError(ValueError):
    """Unusable file, option or value from the user. The message states what is allowed.

    The message is one line of at most `MAX_ERROR_LENGTH` characters; a longer one loses its middle.
    """

    def __init__(self, message: str) -> None:
        line = _single_line(message)
        if len(line) > MAX_ERROR_LENGTH:
            line = f"{line[:295]} ... {line[-200:]}"
        super().__init__(line)


def _single_line(text: str) -> str:
    """Return a text without line breaks, other control characters and lone surrogates."""
    line = " ".join(text.split())
    return line if line.isprintable() else "".join(c if c.isprintable() else "?" for c in line)


@contextmanager
def reading_file(source: str | Path, allowed_content: str) -> Iterator[None]:
    """Turn whatever a reader raises into an `InputError` that names the file.

    A reader validates its file field by field where it can. This covers what remains: files that
    are missing, cut off or damaged, and content that the libraries of their formats refuse.

    Args:
        source: The file, or where else the content comes from. A path is that of a file, which is
            checked: to read a pipe could take forever, and a huge file all memory.
        allowed_content: What the file may contain, for the message.

    Raises:
        InputError: The file is none or too large, or the block raised an exception.
    """
    try:
        if isinstance(source, Path):
            _check_file(source)
        yield
    except InputError as error:
        if str(source) in str(error):
            raise
        raise input_error(str(source), str(error)) from error
    except Exception as error:  # many types: each library of a format has its own
        reason = _single_line(_describe_error(error))
        if len(reason) > 140:
            reason = f"{reason[:136]} ..."
        raise input_error(
            str(source), f"cannot be read ({reason}); expected {allowed_content}"
        ) from error


def _check_file(path: Path) -> None:
    """Check that a path is that of a file that is not too large.

    Raises:
        ValueError: It is not.
        OSError: There is no such file.
    """
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("is not a regular file")
    if status.st_size > MAX_FILE_SIZE:
        raise ValueError(
            f"has {status.st_size / 2**30:.1f} GiB, more than {MAX_FILE_SIZE / 2**30:g} GiB"
        )


def _describe_error(error: Exception) -> str:
    """Return the reason of an error in words."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, UnicodeDecodeError):
        return error.reason
    if isinstance(error, KeyError):
        return f"lacks {format_value(error.args[0]) if error.args else 'a field'}"
    if isinstance(error, RecursionError):
        return "is nested too deeply"
    return str(error) or type(error).__name__


def read_text(path: Path, allowed_content: str) -> str:
    """Return the content of a text file.

    Args:
        path: The file.
        allowed_content: What the file may contain, for the message.

    Raises:
        InputError: The file cannot be read, is larger than `MAX_TEXT_SIZE`, or is not UTF-8.
    """
    with reading_file(path, allowed_content):
        if path.stat().st_size > MAX_TEXT_SIZE:
            raise ValueError(f"is larger than {MAX_TEXT_SIZE / 2**20:g} MiB")
        return path.read_text(encoding="utf-8")


def read_json(path: Path, allowed_content: str) -> Any:
    """Return the document of a JSON file.

    Args:
        path: The file.
        allowed_content: What the file may contain, for the message.

    Raises:
        InputError: The file cannot be read or is not JSON; see `parse_json`.
    """
    return parse_json(read_text(path, allowed_content), str(path), allowed_content)


def parse_json(text: str, source: str, allowed_content: str, *, allow_nan: bool = False) -> Any:
    """Return the document of a JSON text.

    Args:
        text: The text.
        source: File of the text, for the message.
        allowed_content: What the text may contain, for the message.
        allow_nan: Whether NaN and Infinity, which JSON does not have, are numbers.

    Raises:
        InputError: The text is not JSON, or an object has a duplicate key.
    """
    try:
        return json.loads(
            text,
            object_pairs_hook=_unique_keys,
            parse_constant=None if allow_nan else _reject_constant,
        )
    except (ValueError, RecursionError) as error:
        raise input_error(
            source, f"is not JSON ({_describe_error(error)}); expected {allowed_content}"
        ) from error


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the object of its keys and values."""
    fields = dict(pairs)
    if len(fields) < len(pairs):
        keys = [key for key, _ in pairs]
        duplicate = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"{format_value(duplicate)} is a duplicate key")
    return fields


def _reject_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number of JSON")


def input_error(source: str, message: str) -> InputError:
    """Return an error with a one-line message of bounded length.

    Args:
        source: File or option with the error.
        message: Field, value and what is allowed.
    """
    line = " ".join(message.split())
    short = line if len(line) <= MAX_MESSAGE_LENGTH else f"{line[: MAX_MESSAGE_LENGTH - 4]} ..."
    return InputError(f"{source}: {short}")


def format_value(value: Any) -> str:
    """Return a value as text of at most 80 characters for a message."""
    abbreviated = reprlib.Repr()
    abbreviated.maxlevel = 2
    abbreviated.maxstring = 40
    abbreviated.maxother = 40
    try:
        text = abbreviated.repr(value)
    except ValueError:  # Python does not print integers with too many digits.
        return "a number"
    return text if len(text) <= 80 else f"{text[:76]} ..."


@contextmanager
def cli_error_handler() -> Iterator[None]:
    """Print an error that the user can correct as one line and exit with code 2.

    These are an `InputError`, files that cannot be written, and worker processes that are killed
    again and again. An interruption has a line of its own and exit code 130.
    """
    try:
        yield
    except InputError as error:
        _print_last_line(f"error {error}", error)
        sys.exit(2)
    except OSError as error:
        if error.errno not in _STORAGE_ERRORS:
            raise
        place = error.filename2 or error.filename or "a file"  # the second one is a target
        problem = f"cannot be written or read ({os.strerror(error.errno)})"
        _print_last_line(f"error {place}: {problem}; finished results are kept", error)
        sys.exit(2)
    except BrokenProcessPool as error:
        _print_last_line(f"error {_single_line(str(error))}; finished results are kept", error)
        sys.exit(2)
    except KeyboardInterrupt as error:
        _print_last_line(INTERRUPTION, error)
        sys.exit(_INTERRUPTED)
    except SystemExit as error:
        # Typer turns a KeyboardInterrupt into this exit code.
        if error.code == _INTERRUPTED:
            _print_last_line(INTERRUPTION, error)
        raise


def _print_last_line(line: str, error: BaseException) -> None:
    """Print the last line of a program that an error ends, after what else is to be printed.

    The frames of the error hold progress bars, which print a last line when they are closed.
    """
    cause: BaseException | None = error
    while cause is not None:
        traceback.clear_frames(cause.__traceback__)
        cause = cause.__context__
    print(line, file=sys.stderr)


def temporary_path(path: Path) -> Path:
    """Return a path beside a file or folder at which it is made before it gets its name."""
    # The random part separates processes. The suffix is kept for writers that infer the format.
    return path.with_name(f".{path.stem}.tmp-{secrets.token_hex(4)}{path.suffix}")


def is_temporary(entry: Path, path: Path | None = None) -> bool:
    """Return whether a path is a `temporary_path`.

    Args:
        entry: The path.
        path: File or folder whose temporary path it may be; None for any.
    """
    match = _TEMPORARY_NAME.fullmatch(entry.name)
    return match is not None and path in (None, entry.with_name(match["stem"] + match["suffix"]))


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path, which replaces `path` when the block ends without an error.

    An `OSError` without a file name, such as that of a full disk, gets the name of `path`.
    """
    temporary = temporary_path(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename in (None, str(temporary)):
            # Libraries have errors of their own, whose file name cannot be set.
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON atomically; NaN and infinity are errors."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def temporary_folder() -> Path:
    """Return the folder for temporary files.

    Raises:
        InputError: None can be written.
    """
    try:
        return Path(tempfile.gettempdir())
    except FileNotFoundError as error:
        remedy = "set TMPDIR to a folder that can be written"
        raise input_error("temporary files", f"{error.strerror}; {remedy}") from error


def private_temporary_folder(purpose: str) -> Path:
    """Return a folder for temporary files that later runs of the same user find again.

    Other users cannot write to it. If someone else has created a folder of its name, it is a new
    folder with a random name.

    Args:
        purpose: Part of the folder's name.

    Raises:
        InputError: No folder for temporary files can be written.
    """
    folder = temporary_folder() / f"drake_clutter_{purpose}_{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    status = folder.lstat()
    others_may_write = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not others_may_write:
        return folder
    return Path(tempfile.mkdtemp(prefix=f"drake_clutter_{purpose}_"))


def file_sha256(path: Path) -> str:
    """Return the SHA-256 hash of a file as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
