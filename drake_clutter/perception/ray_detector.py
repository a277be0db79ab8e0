"""Perfect detector that casts rays at the true objects instead of rendering, for training."""

from drake_clutter.cell.camera import Camera
from drake_clutter.perception.label_detector import PerceptionResult
from drake_clutter.scenes.scene import Scene
from drake_clutter.stability.ray_caster import RayCaster


class RayDetector:
    """Return the detections of `LabelDetector` for convex objects without a renderer."""

    def __init__(self, camera: Camera) -> None:
        self._rays = RayCaster(camera)

    def perceive(self, scene: Scene) -> PerceptionResult:
        """Return the observation of a scene and the visible fraction of each object."""
        observation, visible_fractions = self._rays.observe(scene)
        return PerceptionResult(observation, visible_fractions)
