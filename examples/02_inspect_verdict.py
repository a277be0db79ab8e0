"""Build scenes object by object and compare the verdicts of two judges."""

import numpy as np

from drake_clutter import (
    ClutterConfig,
    DrakeJudge,
    Pose,
    Scene,
    SceneJudge,
    SceneObject,
    StaticStabilityJudge,
    Verdict,
    load_catalog,
)

CLASSES = load_catalog().classes


def standing(name: str, x: float, bottom: float) -> SceneObject:
    """Return an object that stands upright with its bottom at a height [m]."""
    object_class = CLASSES[name]
    return SceneObject(name, object_class, Pose((x, 0.0, bottom + object_class.size[2] / 2)))


def main() -> None:
    config = ClutterConfig()
    judges: dict[str, SceneJudge] = {
        "static": StaticStabilityJudge(config),
        "Drake": DrakeJudge(config),
    }
    box_height = CLASSES["pudding_box"].size[2]
    pudding = standing("pudding_box", 0.0, 0.0)
    scenes = {
        "balanced stack": [pudding, standing("master_chef_can", 0.0, box_height)],
        "overhanging stack": [pudding, standing("master_chef_can", 0.04, box_height)],
    }
    for title, objects in scenes.items():
        scene = Scene(tuple(objects), config.cell.support)
        print(title)
        for name, judge in judges.items():
            verdict = judge.judge(scene, np.random.default_rng(0))
            if not isinstance(verdict, Verdict):  # the static judge is inconclusive
                print(f"  {name}: inconclusive: {verdict}")
            elif verdict.instability is not None:
                print(f"  {name}: unstable: {verdict.instability}")
            else:
                visible = {k: round(v, 2) for k, v in verdict.visible_fractions.items()}
                print(f"  {name}: stable, visible {visible}, hidden {list(verdict.hidden)}")


if __name__ == "__main__":
    main()
