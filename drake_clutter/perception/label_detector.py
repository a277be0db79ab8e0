"""Perfect detector that reads the labels of rendered images."""

from dataclasses import dataclass

from drake_clutter.cell.camera import Camera
from drake_clutter.scenes.interfaces import Detection, Observation
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.camera_renderer import CameraRenderer


@dataclass(frozen=True)
class PerceptionResult:
    """Observation of a scene together with the ground truth about visibility.

    Attributes:
        observation: Depth image and detections, which is all that an explorer may use.
        visible_fractions: Visible fraction of each object's unoccluded pixels, by name; ground
            truth for evaluation.
    """

    observation: Observation
    visible_fractions: dict[str, float]


class LabelDetector:
    """Detect every object that is in the image and not hidden, with its true class and pose."""

    def __init__(self, camera: Camera) -> None:
        self.renderer = CameraRenderer(camera)

    def perceive(self, scene: Scene) -> PerceptionResult:
        """Return the observation of a scene and the visible fraction of each object."""
        depth, label = self.renderer.render_depth_and_label(scene)
        visible_fractions = self.renderer.visible_fractions(scene, label)
        hidden = self.renderer.hidden_objects(visible_fractions)
        detections = tuple(
            Detection(o.name, o.object_class, o.X_TO, mask)
            for index, o in enumerate(scene.objects)
            if o.name not in hidden and (mask := label == index).any()
        )
        observation = Observation(depth, detections, self.renderer.camera, scene.support)
        return PerceptionResult(observation, visible_fractions)
