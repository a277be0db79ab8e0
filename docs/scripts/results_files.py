"""Readers of results files, and names of policies and generators on results pages."""

import json
from pathlib import Path
from typing import Any

from drake_clutter.records import read_jsonl

ROOT = Path(__file__).parents[2]
TRAINING = ROOT / "training/results"
BENCHMARKS = ROOT / "benchmarks/results"

GENERATORS = {
    "random": "RG",
    "hill-climbing": "HC",
    "sg": "SG",
    "sg-star": "SG\\*",
    "sg-14": "SG-14",
    "sg_star_seed_1": "SG\\*, seed 1",
    "sg_star_seed_2": "SG\\*, seed 2",
    "sg_star_paper": "SG\\*, paper reward",
}
"""Short names of scene generators, by the name or checkpoint in results files."""
POLICIES = {
    "random": "RE",
    "largest-first": "LF",
    "largest-clear": "LF-clear",
    "student-rg": "SE^r",
    "student-dagger": "SE\\*, DAgger",
    "student": "SE\\*",
    "student-14": "SE-14",
    "student_14_dagger": "SE-14, DAgger",
    "student_bc": "SE\\*, cloning",
    "full-knowledge": "oracle",
    "student_seed_1": "SE\\*, seed 1",
    "student_seed_2": "SE\\*, seed 2",
}
"""Short names of exploration policies, by the name or checkpoint in results files."""


def read_training_results(name: str) -> dict[str, Any]:
    """Return the content of a file of training/results."""
    content: dict[str, Any] = json.loads((TRAINING / name).read_text(encoding="utf-8"))
    return content


def read_benchmark_results(name: str) -> Any:
    """Return the content of a file of benchmarks/results."""
    return json.loads((BENCHMARKS / name).read_text(encoding="utf-8"))


def read_episodes(path: Path) -> list[dict[str, Any]]:
    """Return the episodes of a file of records, whose first record describes the run."""
    return read_jsonl(path)[1:] if path.exists() else []


def generator_name(row: dict[str, Any]) -> str:
    """Return the short name of a row's generator, with its temperature if that is not its own."""
    stem = Path(row["agent"]).stem
    name = GENERATORS.get(stem, stem)
    return name if row.get("temperature") is None else f"{name}, T = {row['temperature']:g}"


def policy_name(agent: str) -> str:
    """Return the short name of a policy."""
    stem = Path(agent).stem
    return POLICIES.get(stem, stem)
