"""The perfect detector: it reads the rendered labels."""

from dataclasses import dataclass

from drake_clutter.cell.camera import Camera
from drake_clutter.scenes.interfaces import Detection, Observation
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.camera import OverheadCamera


@dataclass(frozen=True)
class Look:
    """One look at a scene.

    Attributes:
        observation: what an explorer may know.
        visible_share: the truth behind it, by name: of each object's unoccluded pixels, the share that is seen.
    """

    observation: Observation
    visible_share: dict[str, float]


class LabelDetector:
    """Detects every object that is in the frame and not hidden, with its true class and pose."""

    def __init__(self, config: Camera) -> None:
        self.camera = OverheadCamera(config)

    def look(self, scene: Scene) -> Look:
        """What the camera shows of a scene."""
        depth, label = self.camera.depth_and_label(scene)
        shares = self.camera.visible_shares(scene, label)
        hidden = self.camera.hidden(shares)
        detections = tuple(
            Detection(o.name, o.object_class, o.X_TO, mask)
            for index, o in enumerate(scene.objects)
            if o.name not in hidden and (mask := label == index).any()
        )
        return Look(Observation(depth, detections, self.camera.config, scene.support), shares)
