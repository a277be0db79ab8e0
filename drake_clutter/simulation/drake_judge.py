"""The judge that every published number comes from: settled in hydroelastic contact, seen by the rendered camera."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.support import Support
from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.geometry import group_touching_objects
from drake_clutter.scenes.interfaces import Verdict
from drake_clutter.scenes.scene import Pose, Scene, SceneObject, perturb_poses
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.settle import SettleResult, settle
from drake_clutter.stability.static_judge import StaticStabilityJudge

TOUCHING_MARGIN = 0.003
"""m; objects further apart than this, random offsets included, settle without each other."""


class DrakeJudge:
    """Settles a scene and looks at it (a `SceneJudge`).

    Groups of objects that do not touch as laid out are settled apart. The first that falls decides, since a scene is stable
    only if all are; what a falling stack would do to its neighbours changes no verdict. Those that the fast judge expects to
    fall, or cannot judge, come first: the sooner a fall is seen, the less is simulated.
    """

    def __init__(self, config: ClutterConfig) -> None:
        self._config = config
        self._renderer = CameraRenderer(config.cell.camera)
        self._static_judge = StaticStabilityJudge(config)
        self._single_results: dict[
            tuple[ObjectClass, Support, float, tuple[float, ...]], SettleResult
        ] = {}

    def judge(self, scene: Scene, rng: np.random.Generator) -> Verdict:
        """The verdict. See `SceneJudge.judge`."""
        settled: dict[str, Pose] = dict(scene.poses)
        for _, result in self.settle_groups(scene, rng):
            settled |= result.poses
            if result.instability is not None:
                return Verdict(result.instability, settled, {}, ())
        return self.judge_at_rest(scene.with_poses(settled))

    def settle_groups(
        self, scene: Scene, rng: np.random.Generator
    ) -> Iterator[tuple[tuple[SceneObject, ...], SettleResult]]:
        """Settles group after group of objects that may touch, random offsets added; each with how it settled."""
        config = self._config.settle
        groups = group_touching_objects(
            perturb_poses(scene.objects, config.jitter, rng), TOUCHING_MARGIN
        )
        for group in sorted(
            groups,
            key=lambda group: (
                self._static_judge.find_instability(replace(scene, objects=tuple(group))) is None
            ),
        ):
            is_single = len(group) == 1 and _well_inside(group[0], scene.support)
            yield (
                tuple(group),
                self._settle_single(group[0], scene.support)
                if is_single
                else settle(group, scene.support, config),
            )

    def _settle_single(self, single: SceneObject, support: Support) -> SettleResult:
        """An object on its own settles alike wherever it is on the tray: it is simulated once, at the centre."""
        x, y, z = single.X_TO.translation
        key = (single.object_class, support, z, single.X_TO.quaternion)
        if key not in self._single_results:
            centered = replace(single, X_TO=single.X_TO.translated((-x, -y, 0.0)))
            self._single_results[key] = settle([centered], support, self._config.settle)
        settled = self._single_results[key]
        (pose,) = settled.poses.values()
        instability = (
            replace(settled.instability, object=single.name) if settled.instability else None
        )
        return SettleResult(instability, {single.name: pose.translated((x, y, 0.0))}, ())

    def judge_at_rest(self, scene: Scene) -> Verdict:
        """The verdict on a scene that is known to be at rest: what it hides."""
        shares = self._renderer.visible_fractions(scene)
        return Verdict(None, scene.poses, shares, self._renderer.hidden_objects(shares))


def _well_inside(scene_object: SceneObject, support: Support) -> bool:
    """Whether an object is clear of the rim."""
    lower, upper = scene_object.bounds_T
    return bool((np.abs([lower[:2], upper[:2]]) < support.half_size - TOUCHING_MARGIN).all())
