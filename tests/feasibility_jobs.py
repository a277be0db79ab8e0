"""Jobs of feasibility studies for tests."""

from pathlib import Path

from conftest import DEFAULT_CELL

from drake_clutter.commands.feasibility_job import FeasibilityJob
from drake_clutter.feasibility.setups import SetupRequest


def feasibility_job(scene: Path, seed: int = 0) -> FeasibilityJob:
    """Return a study of one scene with the default cell."""
    setups = {"default": SetupRequest(DEFAULT_CELL)}
    return FeasibilityJob((scene,), setups, draws_maps=False, seed=seed)
