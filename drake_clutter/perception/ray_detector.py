"""The perfect detector without rendering: it casts the camera's rays at the true objects, which is what training needs."""

from drake_clutter.cell.camera import Camera
from drake_clutter.perception.label_detector import PerceptionResult
from drake_clutter.scenes.scene import Scene
from drake_clutter.stability.ray_caster import RayCaster


class RayDetector:
    """Detects what `LabelDetector` does (a `Detector`), of convex objects, without a renderer."""

    def __init__(self, camera: Camera) -> None:
        self._rays = RayCaster(camera)

    def perceive(self, scene: Scene) -> PerceptionResult:
        """What the camera shows of a scene."""
        observation, shares = self._rays.observe(scene)
        return PerceptionResult(observation, shares)
