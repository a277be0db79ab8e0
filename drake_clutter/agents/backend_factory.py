"""Backends by the name of their fidelity, the arm among them."""

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
"""How moves are carried out: by teleport, or planned and simulated with the arm."""


def make_backend_factory(
    fidelity: str, config: ClutterConfig, *, follow_falls: bool = False
) -> BackendFactory:
    """Return what starts episodes.

    Args:
        fidelity: One of `FIDELITIES`.
        config: The world.
        follow_falls: See `teleport_backends`; the arm's simulation always follows falls.
    """
    if fidelity == "arm":
        detector = LabelDetector(config.cell.camera)
        return partial(SteppedBackend, ArmExecutor(config), detector, config.exploration)
    return make_teleport_backend_factory(fidelity, config, follow_falls=follow_falls)
