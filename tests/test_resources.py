"""Where the package's files are, and which commit they are of."""

import subprocess
from pathlib import Path

import pytest

from drake_clutter import resources


def test_modified_code_makes_a_commit_dirty_and_modified_results_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*arguments: str) -> None:
        subprocess.run(
            ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", *arguments],
            cwd=tmp_path,
            check=True,
        )

    code, results = (
        tmp_path / "drake_clutter" / "code.py",
        tmp_path / "training" / "results" / "row.json",
    )
    for file in (code, results):
        file.parent.mkdir(parents=True)
        file.write_text("1")
    git("init", "--quiet")
    git("add", "--all")
    git("commit", "--quiet", "--message", "first")
    monkeypatch.setattr(resources, "_PACKAGE_DIR", code.parent)
    clean = resources.git_commit()
    assert clean != "unknown"
    results.write_text("2")
    assert resources.git_commit() == clean
    code.write_text("2")
    assert resources.git_commit() == f"{clean}-dirty"
    monkeypatch.setattr(resources, "_PACKAGE_DIR", tmp_path.parent / "no_such_folder")
    assert resources.git_commit() == "unknown"
