"""Scripts that measure or prepare data: each runs its smallest case."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np
import pytest
from conftest import CATALOG, CLASSES, WORLD, resting, scene_of

from benchmarks import closed_loop_speed, planning_speed, simulation_speed, simulation_worker
from benchmarks.planning_problems import ObjectRecord, ProblemRecord
from benchmarks.planning_worker import Worker
from drake_clutter.grammar import Orientation
from drake_clutter.perception.image_dataset import AnnotatedImage, write_images
from drake_clutter.rendering.scene_rasterizer import SceneRasterizer
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene_dataset import load_scene_dataset, save_scene_dataset
from training import calibrate_detector, generate_target_set
from training.evaluate_closed_loop import EVALUATIONS
from training.evaluate_detector import render_image
from training.script import SCENES
from training.target_set import TARGETS, load_target_set


def test_a_detector_is_calibrated(tmp_path: Path) -> None:
    """Of two images of two boxes, the second is held out."""
    renderer = SceneRasterizer(WORLD.cell.camera)
    for k, y in enumerate((-0.15, 0.15)):
        scene = scene_of(
            resting("cracker_box", xy=(0.0, y)), resting("sugar_box", Orientation.UPRIGHT_0)
        )
        image = AnnotatedImage(render_image(renderer, scene), renderer.silhouettes(scene))
        folder = tmp_path / f"images/train/{k:06d}"
        write_images(folder, [image], WORLD.cell.camera, list(CLASSES), compact=True)
    shipped = resource_path("training/checkpoints/detector_depth.safetensors")
    detector, metadata = tmp_path / "detector.safetensors", tmp_path / "detector.json"
    for source, target in ((shipped, detector), (shipped.with_suffix(".json"), metadata)):
        copyfile(source, target)
    calibrate_detector.main(detector, tmp_path / "images", tmp_path / "calibration.json")
    results = json.loads((tmp_path / "calibration.json").read_text())
    assert (results["images"], results["fitted_detections"]) == (2, 2)
    plain, calibrated = results["rows"]
    assert plain["temperature"] == 1
    assert sum(b["count"] for b in plain["bins"]) == results["held_out_detections"] == 2
    # All four are recognized, so the calibrated probabilities are higher.
    assert calibrated["temperature"] < 0.5
    assert calibrated["negative_log_likelihood"] < plain["negative_log_likelihood"]
    written = json.loads(metadata.read_text())
    before = json.loads(shipped.with_suffix(".json").read_text())
    assert written == before | {"temperature": calibrated["temperature"]}


def test_a_target_set_is_drawn_again(tmp_path: Path) -> None:
    """The first pair of a shipped target set."""
    shipped = load_scene_dataset(SCENES / "sg_star_25.json", CATALOG)
    expected = load_target_set(TARGETS / "sg_star_25.json", shipped)
    seed = json.loads((TARGETS / "sg_star_25.json").read_text())["seed"]
    path, out = tmp_path / "first.json", tmp_path / "targets/first.json"
    save_scene_dataset(path, shipped.metadata, shipped.scenes[:1], shipped.cell)
    generate_target_set.main(path, out, seed=seed)
    targets = load_target_set(out, load_scene_dataset(path, CATALOG))
    assert targets.pairs == expected.pairs[:1]
    assert list(out.parent.iterdir()) == [out]


def test_parts_of_closed_loop_episodes(tmp_path: Path) -> None:
    """Two episodes without a hidden object end before the first move."""
    shipped = load_scene_dataset(SCENES / "sg_star_10.json", CATALOG)
    scene = shipped.settled_scene(0, shipped.grammar, WORLD)
    side_by_side = tuple(
        resting(o.object_class.name, xy=(0.25 * (k % 3) - 0.25, 0.25 * (k // 3) - 0.25)).X_TO
        for k, o in enumerate(scene.objects)
    )
    record = replace(shipped.scenes[0], settled_poses=side_by_side)
    save_scene_dataset(tmp_path / "apart.json", shipped.metadata, [record] * 2, shipped.cell)
    evaluation = next(e for e in EVALUATIONS if (e.perception, e.motion) == ("labels", "arm"))
    evaluation = replace(evaluation, scenes=str(tmp_path / "apart"), first=0)
    row = closed_loop_speed.measure(evaluation, 2)
    assert (row["exceptions"], row["episodes"], row["found_all"]) == (0, 2, 2)
    assert row["moves"]["p50"] == row["robot_s"]["p50"] == 0
    shares = row["shares"]
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["planning"] == shares["policy"] == 0
    assert shares["building of simulations"] > 0


def problem(*, pick: str) -> dict[str, Any]:
    """Return a problem of `planning_problems.py`: a sugar box is put down elsewhere."""
    objects = (resting("sugar_box", xy=(0.0, -0.1)), resting("cracker_box", xy=(0.15, 0.2)))
    records = tuple(ObjectRecord(o.name, o.object_class.name, o.X_TO) for o in objects)
    place = objects[0].X_TO.translated((-0.1, 0.2, 0.003))
    document: dict[str, Any] = json.loads(json.dumps(asdict(ProblemRecord(records, pick, place))))
    return document


def test_planning_is_compared() -> None:
    result = Worker()(problem(pick="sugar_box"))
    assert [r["failure"] for r in result.values()] == ["", ""]
    plain, optimized = (result[name] for name in planning_speed.PLANNERS)
    assert optimized["duration"] < plain["duration"]
    assert min(plain["min_distance"], optimized["min_distance"]) > 0
    failed = plain | {"failure": "no grasp: of any", "duration": np.nan, "min_distance": np.nan}
    summary = planning_speed.summarize([plain, failed])
    assert summary["failures"] == {"no grasp": 1}
    assert summary["min_distance_m"] == plain["min_distance"]
    ratios = planning_speed.compare([plain, plain, failed], [optimized, failed, plain])
    assert ratios["mean_duration"] == pytest.approx(optimized["duration"] / plain["duration"])
    assert (ratios["lost"], ratios["gained"]) == (1, 1)


def test_simulation_is_compared() -> None:
    (line,) = simulation_speed.sample_moves(1, 0)
    result = simulation_worker.simulate(json.loads(line))
    assert result["uneventful"]
    assert 0 < result["tracking"] < 0.01
    moved = {name: [x, y, z + 0.002] for name, (x, y, z) in result["positions"].items()}
    ratios = simulation_speed.compare([result], [result | {"positions": moved, "cpu": 1.0}])
    assert ratios["position_difference_m"]["p50"] == pytest.approx(0.002)
    assert ratios["total_cpu"] == result["cpu"]
