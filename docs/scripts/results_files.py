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
    "area-reduction": "area",
    "student-target": "SE, target",
    "student_seed_1": "SE\\*, seed 1",
    "student_seed_2": "SE\\*, seed 2",
}
"""Short names of exploration policies, by the name or checkpoint in results files."""


RENAMED_KEYS = {
    "recall_by_visible_share": "recall_by_visible_fraction",
    "share": "fraction",
    "eyes": "renderers",
    "FastJudge, cold": "static judge, empty cache",
    "FastJudge, warm": "static judge, cached stacks",
    "DrakeJudge": "Drake",
    "DrakeJudge, accurate": "Drake without early stop",
    "PyBullet": "PyBullet, 480 steps",
    "TinyRenderer": "PyBullet TinyRenderer, label image",
    "ray caster": "ray caster, label image",
    "Drake VTK labels": "Drake VTK, label image",
    "shares, ray caster": "ray caster, visible fractions",
    "shares, Drake VTK": "Drake VTK, visible fractions",
    "median_moves_tried": "median_moves_evaluated",
    "fast_ms_16_objects": "static_ms_16_objects",
}
"""Current keys, by those in results files of version 0.1."""


def with_current_keys(content: Any) -> Any:
    """Return the content of a results file with current keys."""
    if isinstance(content, list):
        return [with_current_keys(item) for item in content]
    if not isinstance(content, dict):
        return content
    return {RENAMED_KEYS.get(key, key): with_current_keys(item) for key, item in content.items()}


def read_training_results(name: str) -> dict[str, Any]:
    """Return the content of a file of training/results."""
    text = (TRAINING / name).read_text(encoding="utf-8")
    content: dict[str, Any] = with_current_keys(json.loads(text))
    return content


def has_training_results(name: str) -> bool:
    """Return whether there is a results file in `training/results`."""
    return (TRAINING / name).exists()


def has_benchmark_results(name: str) -> bool:
    """Return whether there is a results file in `benchmarks/results`."""
    return (BENCHMARKS / name).exists()


def read_benchmark_results(name: str) -> Any:
    """Return the content of a file of benchmarks/results."""
    return with_current_keys(json.loads((BENCHMARKS / name).read_text(encoding="utf-8")))


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
