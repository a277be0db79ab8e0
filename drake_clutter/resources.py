"""Paths of files that are shipped with the package, and its Git commit."""

import subprocess
from pathlib import Path

_PACKAGE_DIR = Path(__file__).resolve().parent
_INSTALLED_DATA_DIR = _PACKAGE_DIR / "_shipped"


def resource_path(relative_path: str) -> Path:
    """Return the absolute path of a shipped file or folder.

    The folders `models/`, `sdf_assets/` and `training/` are inside the package in a wheel, and next
    to it in a checkout.

    Args:
        relative_path: Path from the root of the repository, such as `models/robots/ur10.sdf`.

    Raises:
        FileNotFoundError: There is no such shipped file or folder.
    """
    root = _INSTALLED_DATA_DIR if _INSTALLED_DATA_DIR.is_dir() else _PACKAGE_DIR.parent
    path = root / relative_path
    if not path.exists():
        raise FileNotFoundError(
            f"{relative_path} is not shipped with drake_clutter (looked in {root})"
        )
    return path


def git_commit(folder: Path | None = None) -> str:
    """Return the Git commit of the checkout that contains a folder.

    Args:
        folder: The folder; None for that of this package.

    Returns:
        The abbreviated commit, with the suffix "-dirty" if files were modified; "unknown" outside
        of a checkout. Modified results do not count, because measurements write to them.
    """
    results = (":(top,exclude)training/results", ":(top,exclude)benchmarks/results")
    try:
        folder = folder or _PACKAGE_DIR
        commit = _git(folder, "describe", "--always")
        modified_files = _git(
            folder,
            "--no-optional-locks",
            "status",
            "--porcelain",
            "--untracked-files=no",
            "--",
            ":/",
            *results,
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return f"{commit}-dirty" if modified_files else commit


def _git(folder: Path, *arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments],
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
        timeout=10,
    ).stdout.strip()
