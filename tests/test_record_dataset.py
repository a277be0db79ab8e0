"""Data sets of recorded episodes: resumed, reproducible, and whole whatever happens."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import CATALOG, DEFAULT_CELL, WORLD, resting, scene_of
from typer.testing import CliRunner

from benchmarks import recording_throughput
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.cli.app import app
from drake_clutter.commands.episode_scenes import FileScenes, find_scenes
from drake_clutter.commands.record_dataset import EpisodeSummary, episode_path, record_dataset
from drake_clutter.commands.recording_job import CameraOptions, RecordingJob
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.recording.camera_recorder import CameraChannel
from drake_clutter.recording.exact_replay import (
    compare_samples,
    recorded_physics,
    replay_action,
)
from drake_clutter.recording.hdf5_file import load_episode
from drake_clutter.recording.randomization import load_randomization
from drake_clutter.resources import resource_path
from drake_clutter.scenes.interfaces import Move, MoveResult, Observation
from drake_clutter.scenes.scene_dataset import load_scene_dataset, save_scene_dataset
from drake_clutter.scenes.scene_file import save_scene
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.station.station_simulation import COARSE_TIME_STEP
from drake_clutter.tasks.belief import Belief, Decision
from training import record_sg_star_dataset

CAMERAS = CameraOptions(("wrist",), (CameraChannel.RGB, CameraChannel.SEGMENTATION), (64, 48))


def pick_can_or_refuse(
    belief: Belief, observation: Observation, rng: np.random.Generator
) -> Decision:
    """Raise an error if there is no can, else have no move; a `Policy`."""
    if "can" not in [d.name for d in observation.detections]:
        raise RuntimeError("there is no can")
    return Decision(None)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> FileScenes:
    folder = tmp_path_factory.mktemp("scenes")
    boxes = {"a": "gelatin_box", "b": "pudding_box"}
    for name, box in boxes.items():
        # Two objects of one class: with other masses, each gets a variant of the class.
        twins = (
            resting("sugar_box", xy=(0.2, 0.2), name="far"),
            resting("sugar_box", xy=(-0.2, 0.2), name="twin"),
        )
        scene = scene_of(resting(box, name="box"), *twins)
        save_scene(folder / f"{name}.yaml", scene, DEFAULT_CELL)
    with_can = scene_of(resting("master_chef_can", name="can"))
    save_scene(folder / "c.yaml", with_can, DEFAULT_CELL)
    found = find_scenes(str(folder), WORLD)
    assert isinstance(found, FileScenes)
    return found


@pytest.fixture(scope="module")
def job(scenes: FileScenes) -> RecordingJob:
    """Return a job of one move in each episode: the box onto the tray."""
    return RecordingJob(
        FileScenes(scenes.scenes[:2], None),
        policy=(Move("box"),),
        config=WORLD,
        seed=3,
        max_moves=1,
        cameras=CAMERAS,
        randomization=load_randomization("mass,poses,textures,lights,camera,noise"),
    )


@pytest.fixture(scope="module")
def dataset(job: RecordingJob, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dataset")
    summary = record_dataset(job, 2, [], out)
    assert summary["episodes"] == 2
    assert summary["executed_moves"] == 2
    assert summary["errors"] == {}
    return out


def test_episodes_hold_what_the_job_asked_for(job: RecordingJob, dataset: Path) -> None:
    episodes = [load_episode(episode_path(dataset, index), CATALOG) for index in range(2)]
    assert [e.scene_name for e in episodes] == ["a", "b"]
    assert [e.object_classes[0] for e in episodes] == ["gelatin_box", "pudding_box"]
    assert [e.index for e in episodes] == [0, 1]
    assert {e.seed for e in episodes} == {3}
    assert {e.policy for e in episodes} == {"moves"}
    for episode in episodes:
        (action,) = episode.actions
        assert action.move == Move("box")
        assert action.result is MoveResult.PLACED
        assert action.samples is not None
        images = action.images["wrist"]
        assert images.rgb is not None
        assert images.rgb.shape[1:] == (48, 64, 3)
        assert images.depth is None
        assert images.time[-1] == action.samples.time[-1]
        assert set(np.unique(images.segmentation)) >= {0, 1, 255}  # type: ignore[arg-type]
        nominal = episode.initial_scene["box"].object_class.mass
        assert episode.variation["mass"]["box"] != nominal
        assert episode.variation["mass"]["box"] == pytest.approx(nominal, rel=0.2)
        # The box is where the images show it: below the wrist camera's tool when it is grasped.
        held = action.samples.held_object == 0
        assert held.any()
    masses = [e.variation["mass"]["far"] for e in episodes]
    assert masses[0] != masses[1]


def test_an_episode_with_other_masses_is_replayed(dataset: Path) -> None:
    episode = load_episode(episode_path(dataset, 0), CATALOG)
    samples = episode.actions[0].samples
    assert samples is not None
    with recorded_physics(episode) as scene:
        assert scene["box"].object_class.mass == episode.variation["mass"]["box"]
        replayed = replay_action(scene, episode.cell, samples, episode.rate)
    errors = compare_samples(samples, replayed)
    assert (errors.joint, errors.object) == (0.0, 0.0)
    # With the nominal mass, the bellows extend by another distance.
    nominal = replay_action(episode.initial_scene, episode.cell, samples, episode.rate)
    assert compare_samples(samples, nominal).object > 1e-4
    broken = replace(episode, variation={"mass": {"box": -1.0}})
    with pytest.raises(InputError, match=r"mass.*: -1.0"), recorded_physics(broken):
        pass


def test_a_move_of_jaws_is_recorded_and_replayed(tmp_path: Path) -> None:
    """The other box would be woken if the object counted as lost while the jaws still close."""
    cell = load_cell(resource_path("models/cells/ur10_2f85_tray.yaml"))
    config = replace(WORLD, cell=cell)
    scene = scene_of(
        resting("sugar_box", Orientation.UPRIGHT_0, name="box"),
        resting("gelatin_box", xy=(-0.2, 0.0), name="other"),
    )
    (tmp_path / "scenes").mkdir()
    save_scene(tmp_path / "scenes/jaws.yaml", scene, cell)
    scenes = find_scenes(str(tmp_path / "scenes"), config)
    job = RecordingJob(scenes, (Move("box"),), config, max_moves=1)
    record_dataset(job, 1, [], tmp_path / "out")
    path = episode_path(tmp_path / "out", 0)
    episode = load_episode(path, CATALOG)
    (action,) = episode.actions
    assert action.result is MoveResult.PLACED
    samples = action.samples
    assert samples is not None
    assert samples.time_step == COARSE_TIME_STEP
    assert samples.movable == ("box",)
    with h5py.File(path) as file:
        columns = file["action_0001/gripper_commanded"].attrs["columns"].tolist()
    assert columns == ["left_jaw_guide", "right_jaw_guide"]
    replayed = replay_action(episode.initial_scene, episode.cell, samples, episode.rate)
    errors = compare_samples(samples, replayed)
    assert errors.joint < 1e-9  # [rad]: the ramps of the jaws are interpolated
    assert errors.object < 1e-6


def test_a_missing_episode_is_recorded_again_with_the_same_bytes(
    job: RecordingJob, dataset: Path
) -> None:
    first, second = (episode_path(dataset, index) for index in range(2))
    before = second.read_bytes()
    time = first.stat().st_mtime_ns
    second.unlink()
    (second.parent / f".{second.stem}.tmp-00000000.h5").write_bytes(before[:1000])
    done = list[EpisodeSummary]()
    labels = list[str]()

    def progress(label: str, items: Any, num_done: int, total: int) -> Any:
        labels.append(label)
        assert (num_done, total) == (1 if label == "episodes" else 0, 2)
        for item in items:
            done.extend([item] if label == "episodes" else [])
            yield item

    summary = record_dataset(job, 2, [], dataset, progress=progress)
    assert labels == ["episodes", "episodes in the card"]
    assert [episode.index for episode in done] == [1]
    assert done[0].num_executed == 1
    # The worker has recorded no other episode before: nothing depends on what it did.
    assert second.read_bytes() == before
    assert first.stat().st_mtime_ns == time
    assert summary["executed_moves"] == 2
    card = (dataset / "README.md").read_text()
    assert f"# Moves of moves in {job.scenes.name}" in card
    assert sorted(p.name for p in second.parent.iterdir()) == [first.name, second.name]


def test_a_policy_that_raises_ends_only_its_episodes(scenes: FileScenes, tmp_path: Path) -> None:
    job = RecordingJob(scenes, pick_can_or_refuse, WORLD)
    summary = record_dataset(job, 4, [], tmp_path)
    message = "RuntimeError: there is no can"
    assert summary["errors"] == {0: message, 1: message, 3: message}
    assert summary["terminations"] == {"policy error": 3, "all found": 1}
    assert load_episode(episode_path(tmp_path, 3), CATALOG).error == message
    document = json.loads((tmp_path / "job.json").read_text())
    assert document["policy"] == "pick_can_or_refuse"
    with pytest.raises(InputError, match=r"--episodes 3: .* holds 4; expected at least as many"):
        record_dataset(job, 3, [], tmp_path)
    # A longer data set keeps the episodes.
    assert record_dataset(job, 5, [], tmp_path)["episodes"] == 5


def test_a_folder_of_another_job_is_refused(
    job: RecordingJob, dataset: Path, scenes: FileScenes
) -> None:
    cell = DEFAULT_CELL.model_copy(
        update={"robot": DEFAULT_CELL.robot.model_copy(update={"payload": 5.0})}
    )
    other = RecordingJob(
        job.scenes, job.policy, WORLD.__class__(cell=cell), 3, 125.0, 1, CAMERAS, job.randomization
    )
    with pytest.raises(InputError, match=r"differs in config\.cell\.robot\.payload\)"):
        record_dataset(other, 2, [], dataset)
    document = json.loads((dataset / "job.json").read_text())
    (dataset / "job.json").write_text(json.dumps(document | {"version": 1}))
    with pytest.raises(InputError, match=r"differs in version\)"):
        record_dataset(job, 2, [], dataset)
    (dataset / "job.json").write_text(json.dumps(document))
    assert load_episode(episode_path(dataset, 0), CATALOG).index == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--cameras", "side"), "--cameras side: expected some of"),
        (("--channels", "rgb,color"), "--channels color: expected some of rgb, depth"),
        (("--resolution", "640"), "--resolution 640: expected WIDTHxHEIGHT, each from 16 to 4096"),
        (("--randomize", "all"), "--randomize all: expected some of poses, mass"),
        (("--policy", "clever"), "--policy clever; expected random"),
        (("--policy", "none.yaml"), "none.yaml"),
        (("--set", "support.size=[0.6,0.6]"), "the support is that of the scene"),
    ],
)
def test_a_mistake_is_one_line(
    options: tuple[str, str], message: str, scenes: FileScenes, tmp_path: Path
) -> None:
    folder = str(scenes.scenes[0].file.parent)
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["record", "--scenes", folder, "--out", str(out), *options])
    assert isinstance(result.exception, InputError)
    assert message in str(result.exception)
    assert "\n" not in str(result.exception)
    assert not out.exists()


def test_unknown_scenes_are_named() -> None:
    with pytest.raises(InputError, match=r"--scenes nowhere: does not exist"):
        find_scenes("nowhere", WORLD)


def test_a_generator_gives_each_episode_a_stable_scene() -> None:
    source = find_scenes("random", WORLD, nodes=5, seed=5)
    load = source.make_loader(WORLD)
    (first, name), (second, _) = load(0), load(1)
    assert first.poses != second.poses
    assert name.startswith("random ")
    assert {o.object_class.name for o in first.objects} <= source.classes


def test_graphs_of_a_training_set_are_laid_out_for_each_episode(tmp_path: Path) -> None:
    shipped = load_scene_dataset(resource_path("training/scenes/sg_star_10.json"), CATALOG)
    graphs = [replace(record, settled_poses=None) for record in shipped.scenes[:2]]
    save_scene_dataset(tmp_path / "train.json", shipped.metadata, graphs, shipped.cell)
    load = find_scenes(str(tmp_path / "train.json"), WORLD).make_loader(WORLD)
    (first, name), (third, third_name) = load(0), load(2)
    assert (name, third_name) == ("train 0", "train 0"), "the second has episode 1"
    assert first.names == third.names
    assert first.derivation == third.derivation == shipped.scenes[0].rules
    assert first.poses != third.poses
    verdict = DrakeJudge(WORLD).judge(first, np.random.default_rng(0))
    moved = [np.linalg.norm(verdict.settled[name].p - X_TO.p) for name, X_TO in first.poses.items()]
    assert max(moved) < 0.003, "it is at rest"


def test_the_set_of_1000_moves_is_recorded_and_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(record_sg_star_dataset, "MAX_MOVES", 1)
    out, card = tmp_path / "moves", tmp_path / "card"
    record_sg_star_dataset.main(out, card, moves=1)
    summary = json.loads((card / "summary.json").read_text())
    assert summary["executed_moves"] == 1
    assert {path.name for path in card.iterdir()} == {
        *("README.md", "contact_sheet.png", "figures.png", "job.json", "summary.json")
    }
    episodes = sorted((out / "episodes").iterdir())
    assert len(episodes) == summary["episodes"]
    action = load_episode(episodes[-1], CATALOG).actions[0]
    assert action.result.was_executed
    depth = action.images["overhead"].depth
    assert depth is not None
    assert depth.shape[1:] == (240, 320)
    before = [path.stat().st_mtime_ns for path in episodes]
    record_sg_star_dataset.main(out, moves=1)
    assert [path.stat().st_mtime_ns for path in episodes] == before
    line = capsys.readouterr().out.splitlines()[-1]
    assert line == f"1 of {summary['moves']} moves carried out in {len(episodes)} episodes"


def test_recording_is_timed(scenes: FileScenes) -> None:
    job = RecordingJob(FileScenes(scenes.scenes[:2], None), (Move("box"),), WORLD, max_moves=1)
    timing = recording_throughput.time_dataset(job, 2, 1)
    assert (timing.moves, timing.counted) == (2, 1)
    assert min(timing.start, timing.recording, timing.finish) > 0
    shares = recording_throughput.profile(job, 2)
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["simulation"] > shares["perception"] > 0
    assert shares["images"] == 0
    row = recording_throughput.model_row(rate=3600.0, start=100.0, serial=0.001, workers=100)
    assert row["hours"] == pytest.approx((100 + 100 + 1000) / 3600)
    assert row["core_hours_per_1000_moves"] == pytest.approx(100 * 1200 / 3600 / 100)


def test_the_command_prints_counts_and_the_first_error(scenes: FileScenes, tmp_path: Path) -> None:
    folder = str(scenes.scenes[0].file.parent)
    moves = tmp_path / "moves.yaml"
    moves.write_text("- {pick: nothing, place: tray}\n")
    arguments = ["record", "--scenes", folder, "--out", str(tmp_path / "out"), "--episodes", "2"]
    result = CliRunner().invoke(app, [*arguments, "--policy", str(moves), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["episodes"] == 2
    warning = "warning the policy raised in 2 of 2 episodes, first in episode 0: InputError: move 1"
    assert warning in result.stderr
    card = (tmp_path / "out" / "README.md").read_text(encoding="utf-8")
    assert "| episodes | 2 |" in card
    assert "| policy error | 2 | 100.0 % |" in card
