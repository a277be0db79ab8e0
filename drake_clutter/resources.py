"""Finds the files that ship with drake_clutter, whether it is installed from a wheel or editable, and its commit."""

import subprocess
from pathlib import Path

_PACKAGE_DIR = Path(__file__).resolve().parent
_INSTALLED_DATA_DIR = _PACKAGE_DIR / "_shipped"


def resource_path(relative_path: str) -> Path:
    """Absolute path of a shipped file or folder, e.g. ``resource_path("models/robots/ur10.sdf")``.

    A wheel holds `models/`, `sdf_assets/` and `training/` inside the package; a checkout holds them beside it.

    Raises:
        FileNotFoundError: nothing of that name is shipped.
    """
    root = _INSTALLED_DATA_DIR if _INSTALLED_DATA_DIR.is_dir() else _PACKAGE_DIR.parent
    path = root / relative_path
    if not path.exists():
        raise FileNotFoundError(
            f"{relative_path} is not shipped with drake_clutter (looked in {root})"
        )
    return path


def git_commit() -> str:
    """The commit that is checked out around this package, marked if files differ from it; "unknown" outside of a checkout.

    Files of results do not count: what is measured is written into them while it is measured.
    """
    results = (":(top,exclude)training/results", ":(top,exclude)benchmarks/results")
    try:
        commit = _git("describe", "--always")
        modified_files = _git("status", "--porcelain", "--untracked-files=no", "--", ":/", *results)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return f"{commit}-dirty" if modified_files else commit


def _git(*arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments],
        capture_output=True,
        text=True,
        check=True,
        cwd=_PACKAGE_DIR,
        timeout=10,
    ).stdout.strip()
