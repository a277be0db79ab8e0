"""Published results name commits of this repository, so that they can be measured again."""

import gzip
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = (
    "benchmarks/results",
    "training/results",
    "training/scenes",
    "training/targets",
    "training/checkpoints",
    "training/datasets",
)
COMMIT = re.compile(rb'"commit": *"([0-9a-f]{7,40})(?:-dirty)?"')
NOT_IN_HISTORY = {"788e581": "training/results/second_trainings.json"}
"""Commits that the repository lacks, and the results file that says so."""


def git(*arguments: str) -> list[str]:
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()


def test_results_name_commits_of_the_repository() -> None:
    history = git("rev-list", "HEAD")
    if not history or git("rev-parse", "--is-shallow-repository") != ["false"]:
        pytest.skip("needs the history of a Git repository")
    files: dict[str, Path] = {}
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.json*")):
            data = path.read_bytes()
            content = gzip.decompress(data) if path.suffix == ".gz" else data
            files |= {commit.decode(): path for commit in COMMIT.findall(content)}
    assert len(files) > 50
    abbreviated = {commit[:7] for commit in history}
    unknown = {
        commit: str(path.relative_to(ROOT))
        for commit, path in files.items()
        if commit[:7] not in abbreviated
    }
    assert unknown == NOT_IN_HISTORY
