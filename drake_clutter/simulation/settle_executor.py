"""Moves by teleport: the picked object appears at its place, Drake settles what the move touched."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.geometry import group_touching_objects
from drake_clutter.scenes.interfaces import MotionSample, MoveResult, Outcome, PickPlaceCommand
from drake_clutter.scenes.scene import Pose, Scene, SceneObject, perturb_poses
from drake_clutter.simulation.drake_judge import TOUCHING_MARGIN
from drake_clutter.simulation.settle import SettleResult, settle

_COLLAPSE_TIME_STEP = 0.005
"""s; what a fall does to the rest of the scene decides nothing any more, it is only shown."""


class SettleExecutor:
    """Carries out a move at fidelity `settle` (a `MoveExecutor`).

    A scene collapses when, after the move, any object but the picked one has moved or turned past the limits that define
    "stable", or the picked one past them from where it was let go. Less than that is harmless settling. What the picked
    object carried falls. Only the groups of objects that touch the picked one before or after the move are settled; if one
    of them falls, the whole scene is settled again, so that neighbours are hit as they would be.
    """

    def __init__(self, config: ClutterConfig, *, simulate_collapse: bool = True) -> None:
        """Makes an executor.

        Args:
            config: the world.
            simulate_collapse: whether to simulate what a collapse does to the whole scene; if not, the scene
                afterwards and the motion are those of the stack that fell, up to the moment when it is known to fall.
        """
        self._config, self._simulate_collapse = config, simulate_collapse

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """See `MoveExecutor.execute`. Random offsets are added to the pose of release."""
        pick, X_TO = command.move.pick, command.X_TO_place
        # What is let go sinks by the height of release; else it would never count as calm.
        sinks = (
            self._config.settle.early_stop_displacement + self._config.exploration.release_height
        )
        settle_config = replace(self._config.settle, early_stop_displacement=sinks)
        (released,) = perturb_poses([replace(scene[pick], X_TO=X_TO)], settle_config.jitter, rng)
        moved = scene.with_poses({pick: released.X_TO})

        groups = group_touching_objects(scene.objects, TOUCHING_MARGIN)
        touched = next(names for group in groups if pick in (names := {o.name for o in group}))
        settled = []
        for group in _groups_to_settle(moved, released):
            if touched.isdisjoint(o.name for o in group):
                continue
            settled.append(settle(group, scene.support, settle_config, record=True))
            if settled[-1].instability is not None:
                if not self._simulate_collapse:
                    after = moved.with_poses(settled[-1].poses)
                    motion = _merge_motions(moved.poses, settled)
                    return Outcome(
                        MoveResult.COLLAPSED,
                        after,
                        settled[-1].instability,
                        motion,
                        X_TO_released=released.X_TO,
                    )
                coarse = replace(settle_config, time_step=_COLLAPSE_TIME_STEP)
                whole = settle(
                    moved.objects, scene.support, coarse, record=True, simulate_collapse=True
                )
                fall = settled[-1].instability
                return Outcome(
                    MoveResult.COLLAPSED,
                    moved.with_poses(whole.poses),
                    fall,
                    whole.motion,
                    X_TO_released=released.X_TO,
                )
        motion = _merge_motions(moved.poses, settled)
        return Outcome(
            MoveResult.PLACED,
            moved.with_poses(_merge_poses(settled)),
            None,
            motion,
            X_TO_released=released.X_TO,
        )


def _groups_to_settle(scene: Scene, released: SceneObject) -> list[list[SceneObject]]:
    """Objects that may touch each other; what is let go may fall onto all that is below it, however far."""
    lower, upper = (bound[:2] for bound in released.bounds_T)
    with_released, others = list[SceneObject](), []
    for group in group_touching_objects(scene.objects, TOUCHING_MARGIN):
        if any(
            (lower <= o.bounds_T[1][:2]).all() and (o.bounds_T[0][:2] <= upper).all() for o in group
        ):
            with_released += group
        else:
            others.append(group)
    return [with_released, *others]


def _merge_poses(settled: Sequence[SettleResult]) -> dict[str, Pose]:
    return {name: pose for result in settled for name, pose in result.poses.items()}


def _merge_motions(
    start: dict[str, Pose], settled: Sequence[SettleResult]
) -> tuple[MotionSample, ...]:
    """The motions of groups that settled apart, as one motion of the whole scene; a group that has ended stays."""
    longest = max((result.motion for result in settled), key=len)
    poses, frames = dict(start), []
    for index, frame in enumerate(longest):
        for result in settled:
            poses |= result.motion[min(index, len(result.motion) - 1)].poses
        frames.append(MotionSample(frame.time, dict(poses)))
    return tuple(frames)
