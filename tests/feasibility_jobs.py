"""Jobs of feasibility studies for tests."""

from pathlib import Path

from conftest import DEFAULT_CELL

from drake_clutter.commands.feasibility_job import FeasibilityJob
from drake_clutter.config import ClutterConfig
from drake_clutter.feasibility.setups import SetupRequest


def feasibility_job(scene: Path, seed: int = 0) -> FeasibilityJob:
    """Return a study of one scene with the default cell."""
    return FeasibilityJob(
        scenes=(scene,),
        setups={"default": SetupRequest(DEFAULT_CELL, keep_home=True)},
        searches=(),
        targets=(),
        draws_maps=False,
        noisy_moves=0,
        agent=None,
        simulate=False,
        seed=seed,
        config=ClutterConfig(),
        catalog_folder=None,
    )
