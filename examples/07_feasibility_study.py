"""Compare two heights of an arm's base by the moves that it can execute."""

from pathlib import Path

from drake_clutter import (
    FeasibilityJob,
    SetupRequest,
    Sweep,
    default_cell,
    run_feasibility_study,
    sweep_setups,
)

# Worker processes import this file; the guard keeps them from running the study again.
if __name__ == "__main__":
    scenes = tuple(sorted(Path("out/scenes/scenes").glob("*.yaml")))
    heights = Sweep("robot.base.z", (0.0, 0.3))
    setups = sweep_setups({"default": SetupRequest(default_cell())}, [heights])
    job = FeasibilityJob(scenes, setups, draws_maps=False)
    summary = run_feasibility_study(job, Path("out/heights_python"), workers=2)
    for setup in summary["setups"]:
        print(setup["name"], setup["planned"], "of", setup["possible"], setup["share_ci95"])
