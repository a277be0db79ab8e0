"""The perfect detector: it reads the rendered labels."""

from dataclasses import dataclass

from drake_clutter.cell.camera import Camera
from drake_clutter.scenes.interfaces import Detection, Observation
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.camera_renderer import CameraRenderer


@dataclass(frozen=True)
class PerceptionResult:
    """One look at a scene.

    Attributes:
        observation: what an explorer may know.
        visible_fractions: the truth behind it, by name: of each object's unoccluded pixels, the share that is seen.
    """

    observation: Observation
    visible_fractions: dict[str, float]


class LabelDetector:
    """Detects every object that is in the frame and not hidden, with its true class and pose."""

    def __init__(self, camera: Camera) -> None:
        self.camera = CameraRenderer(camera)

    def perceive(self, scene: Scene) -> PerceptionResult:
        """What the camera shows of a scene."""
        depth, label = self.camera.render_depth_and_label(scene)
        shares = self.camera.visible_fractions(scene, label)
        hidden = self.camera.hidden_objects(shares)
        detections = tuple(
            Detection(o.name, o.object_class, o.X_TO, mask)
            for index, o in enumerate(scene.objects)
            if o.name not in hidden and (mask := label == index).any()
        )
        return PerceptionResult(
            Observation(depth, detections, self.camera.camera, scene.support), shares
        )
