"""Finds the files that ship with drake_clutter, whether it is installed from a wheel or editable, and its commit."""

import subprocess
from pathlib import Path

_PACKAGE_DIR = Path(__file__).resolve().parent
_INSTALLED_DATA_DIR = _PACKAGE_DIR / "_shipped"


def shipped_path(relative: str) -> Path:
    """Absolute path of a shipped file or folder, e.g. ``shipped_path("models/tray.sdf")``.

    A wheel holds `models/`, `sdf_assets/` and `training/` inside the package; a checkout holds them beside it.

    Raises:
        FileNotFoundError: nothing of that name is shipped.
    """
    root = _INSTALLED_DATA_DIR if _INSTALLED_DATA_DIR.is_dir() else _PACKAGE_DIR.parent
    path = root / relative
    if not path.exists():
        raise FileNotFoundError(f"{relative} is not shipped with drake_clutter (looked in {root})")
    return path


def git_commit() -> str:
    """The commit that is checked out around this package, marked if files differ from it; "unknown" outside of a checkout."""
    try:
        told = subprocess.run(
            ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=True, cwd=_PACKAGE_DIR, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return told.stdout.strip()
