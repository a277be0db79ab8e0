"""Writing files and folders so that an interrupted or failed run leaves nothing half-written."""

import hashlib
import json
import os
import reprlib
import secrets
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MAX_MESSAGE_LENGTH = 300
"""Characters after the name of the file; a longer message is cut."""


class InputError(ValueError):
    """A file, option or value that a user gave and that cannot be used; the message says what is allowed."""


def input_error(source: str, message: str) -> InputError:
    """Return the error for a misuse, in one line of bounded length.

    Args:
        source: The file or option.
        message: Field, value and what is allowed.
    """
    line = " ".join(message.split())
    short = line if len(line) <= MAX_MESSAGE_LENGTH else f"{line[: MAX_MESSAGE_LENGTH - 4]} ..."
    return InputError(f"{source}: {short}")


def format_value(value: Any) -> str:
    """Return a value for a message, at most 80 characters long."""
    short = reprlib.Repr()
    short.maxlevel, short.maxstring, short.maxother = 2, 40, 40
    try:
        text = short.repr(value)
    except ValueError:  # an integer of too many digits
        return "a number"
    return text if len(text) <= 80 else f"{text[:76]} ..."


@contextmanager
def cli_error_handler() -> Iterator[None]:
    """A user's mistake is one line and exit code 2; an interruption, exit code 130."""
    try:
        yield
    except InputError as error:
        print(f"error {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("stopped; what was finished is kept", file=sys.stderr)
        sys.exit(130)


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`; renames it to `path` when the block ends without an error."""
    # The random part keeps two processes apart; the suffix stays, for writers that choose a format by it.
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes `text` to `path` in one step."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Writes `value` as indented JSON to `path` in one step; NaN and infinity are errors."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def prepare_output_directory(path: Path, *, allowed_entries: frozenset[str] = frozenset()) -> Path:
    """Makes an output folder.

    Args:
        path: the folder; made, with its parents, if it is not there.
        allowed_entries: names that may already be inside, e.g. from an earlier run that is now resumed.

    Raises:
        InputError: not a folder, not writable, or holding something else than `allowed_entries`.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"--out {path}: is a file; give a folder that is new or empty") from error
    except OSError as error:
        raise InputError(
            f"--out {path}: cannot be made ({error.strerror}); give a folder that you may write"
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"--out {path}: is not writable; give a folder that you may write")
    unexpected_entries = sorted(
        entry.name for entry in path.iterdir() if entry.name not in allowed_entries
    )
    if unexpected_entries:
        raise InputError(
            f"--out {path}: is not empty (holds {unexpected_entries[0]}); give a folder that is new or empty"
        )
    return path


def file_sha256(path: Path) -> str:
    """The hash of a file's bytes, in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
