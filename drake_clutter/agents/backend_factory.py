"""Backends of exploration episodes by the name of their fidelity, including the arm."""

from functools import partial

from drake_clutter.config import ClutterConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.station.arm_executor import ArmExecutor
from drake_clutter.tasks.episode import (
    TELEPORT_FIDELITIES,
    BackendFactory,
    SteppedBackend,
    make_teleport_backend_factory,
)

FIDELITIES = (*TELEPORT_FIDELITIES, "arm")
"""Models of the outcome of a move: three in which objects are teleported, and the simulated arm."""


def make_backend_factory(
    fidelity: str, config: ClutterConfig, *, simulate_collapse: bool = False
) -> BackendFactory:
    """Return a factory of the backends of episodes.

    Args:
        fidelity: One of `FIDELITIES`.
        config: Configuration of the simulated world.
        simulate_collapse: See `make_teleport_backend_factory`. The arm's simulation always follows
            a collapse to its end.

    Raises:
        InputError: The fidelity is unknown.
    """
    if fidelity == "arm":
        detector = LabelDetector(config.cell.camera)
        return partial(SteppedBackend, ArmExecutor(config), detector, config.exploration)
    return make_teleport_backend_factory(fidelity, config, simulate_collapse=simulate_collapse)
