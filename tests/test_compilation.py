"""Compiled functions are cached where numba can write, also in a read-only installation."""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import drake_clutter
from drake_clutter.files import private_temporary_folder

PROGRAM = """
import json, os
from drake_clutter.cell import pinhole
from drake_clutter.compilation import cache_folder, njit
import drake_clutter.planning.toppra, drake_clutter.stability.static_judge
print(json.dumps([cache_folder(), os.environ.get("NUMBA_CACHE_DIR")]))
"""


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a folder with a copy of the package, a home and a temporary folder."""
    package = Path(drake_clutter.__file__).parent
    ignored = shutil.ignore_patterns("__pycache__", "_shipped")
    shutil.copytree(package, tmp_path / "site" / package.name, ignore=ignored)
    (tmp_path / "home").mkdir()
    (tmp_path / "tmp").mkdir(mode=0o700)
    return tmp_path


def run_in(copy: Path) -> tuple[str, str | None]:
    """Import compiled functions of the copy without the right to override the modes of files.

    Returns:
        Folder of the cache, and the value of NUMBA_CACHE_DIR.
    """
    unprivileged = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]
    if os.geteuid() == 0 and shutil.which("setpriv") is None:
        pytest.skip("root may write everywhere, and setpriv is missing")
    result = subprocess.run(
        [*(unprivileged if os.geteuid() == 0 else []), sys.executable, "-c", PROGRAM],
        cwd=copy,
        env={
            "PATH": os.environ["PATH"],
            "PYTHONPATH": str(copy / "site"),
            "HOME": str(copy / "home"),
            "TMPDIR": str(copy / "tmp"),
        },
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    cache, variable = json.loads(result.stdout)
    return cache, variable


def make_read_only(folder: Path) -> None:
    for path in (folder, *folder.rglob("*")):
        path.chmod(path.stat().st_mode & ~0o222)


def test_functions_are_cached_beside_their_source(copy: Path) -> None:
    assert run_in(copy) == (str(copy / "site/drake_clutter/__pycache__"), None)


def test_functions_of_a_read_only_installation_are_cached_in_the_home(copy: Path) -> None:
    make_read_only(copy / "site")
    cache, variable = run_in(copy)
    assert Path(cache).is_relative_to(copy / "home/.cache/numba")
    assert variable is None


def test_functions_are_cached_in_a_temporary_folder_without_a_home(copy: Path) -> None:
    make_read_only(copy / "site")
    make_read_only(copy / "home")
    cache, variable = run_in(copy)
    assert variable == str(copy / f"tmp/drake_clutter_numba_{os.getuid()}")
    assert Path(cache).is_relative_to(variable)
    assert Path(variable).stat().st_mode & 0o777 == 0o700
    assert run_in(copy) == (cache, variable)


READ_ONLY = """
set -e
awk '{print $2}' /proc/self/mounts | grep -Ev '^/(proc|sys|dev$|dev/pts)' | sort -u |
    while read folder; do mount -o remount,bind,ro "$folder"; done
for folder in . /tmp /var/tmp; do test ! -w "$folder"; done
"""
"""Script that makes every file system of its namespace read-only."""
UNWRITABLE = """
import sys
from drake_clutter import installation_check
print(installation_check._run_probe(installation_check.probe_temporary, "remedy").detail)
from drake_clutter.cli import main
sys.argv = ["drake-clutter", "view", "scene.yaml"]
main()
"""


def test_a_machine_without_a_writable_folder_is_reported_in_one_line() -> None:
    namespace = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    try:
        subprocess.run([*namespace, READ_ONLY], check=True, capture_output=True)
    except (FileNotFoundError, subprocess.CalledProcessError):
        pytest.skip("this process may not make file systems read-only for itself")
    program = [sys.executable, "-c", UNWRITABLE]
    result = subprocess.run(
        [*namespace, f'{READ_ONLY} exec "$@"', "sh", *program], capture_output=True, text=True
    )
    assert result.returncode == 2, result.stderr
    (line,) = result.stderr.splitlines()
    assert re.fullmatch(
        r"error temporary files: No usable temporary directory found in .*'/tmp'.*; "
        r"set TMPDIR to a folder that can be written",
        line,
    )
    assert result.stdout.strip() == line.removeprefix("error ")


def test_a_temporary_folder_of_someone_else_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever can write to the cache can let this user execute code."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = private_temporary_folder("numba")
    assert folder.parent == tmp_path
    assert private_temporary_folder("numba") == folder
    folder.chmod(0o777)
    assert private_temporary_folder("numba") != folder
    folder.rmdir()
    folder.symlink_to(tmp_path)
    other = private_temporary_folder("numba")
    assert other != folder
    assert other.stat().st_mode & 0o777 == 0o700
