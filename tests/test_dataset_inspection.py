"""Inspection and card of recorded data sets."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from recorded_episodes import SCENE, synthetic_episode, with_samples
from typer.testing import CliRunner

from drake_clutter.catalog import load_catalog
from drake_clutter.cli import app
from drake_clutter.recording.dataset_check import check_episode, find_episode_files
from drake_clutter.recording.dataset_summary import find_outliers, motions, summarize_episode
from drake_clutter.recording.formats.dataset_format import DatasetFormat
from drake_clutter.recording.hdf5_file import save_episode
from drake_clutter.recording.recorded_episode import CameraImages, RecordedEpisode
from drake_clutter.reports.dataset_card import CardText, write_card
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.action_samples import ActionSamples

SHIFT = np.array([0.0, 0.0, 0.0, 0.0, 0.05, 0.0, 0.0])
"""A change of poses: 50 mm along x."""
Edit = Callable[[ActionSamples], ActionSamples]


@pytest.fixture(scope="module")
def episode() -> RecordedEpisode:
    return synthetic_episode()


def problems(episode: RecordedEpisode) -> list[str]:
    """Return what is wrong with an episode."""
    return [str(problem) for problem in check_episode(episode, "e.h5")]


def edited(episode: RecordedEpisode, edit: Edit) -> RecordedEpisode:
    """Return an episode whose first action is edited."""
    samples = episode.actions[0].samples
    assert samples is not None
    return with_samples(episode, 1, edit(samples))


def changed(values: NDArray[Any], index: Any, value: float) -> NDArray[Any]:
    """Return an array with one entry changed."""
    values = values.copy()
    values[index] = value
    return values


def test_a_sound_episode_has_no_problems(episode: RecordedEpisode) -> None:
    assert problems(episode) == []


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            lambda s: replace(s, time=s.time + np.where(np.arange(len(s)) > 9, 0.1, 0.0)),
            "a gap of 150.0 ms at 0.450 s; expected 50.0 ms",
        ),
        (lambda s: replace(s, time=s.time + 0.2), "starts at 0.200 s; expected 0 s"),
        (
            lambda s: replace(s, time=changed(s.time, 10, 0.4)),
            "time goes from 0.4500 s to 0.4000 s",
        ),
        (
            lambda s: replace(s, torque=changed(s.torque, (3, 2), np.nan)),
            "torque: 1 numbers that are not finite, the first at 0.150 s",
        ),
        (
            lambda s: replace(s, X_TO=changed(s.X_TO, (3, 2, 0), 1.5)),
            "X_TO: a quaternion of norm 1.803; expected 1",
        ),
        (
            lambda s: replace(s, q=changed(s.q, (4, 1), 7.0)),
            "q: shoulder_lift_joint at 7.000 rad at 0.200 s; expected -6.283 to 6.283 rad",
        ),
        (
            lambda s: replace(s, v=changed(s.v, (4, 0), -9.0)),
            "v: shoulder_pan_joint at 9.00 rad/s at 0.200 s; expected at most 2.09 rad/s",
        ),
        (
            lambda s: replace(s, torque=changed(s.torque, (4, 5), 99.0)),
            "torque: wrist_3_joint at 99.00 N m at 0.200 s; expected at most 56.00 N m",
        ),
        (
            lambda s: replace(s, v=changed(s.v, (-1, 3), 0.5)),
            "ends at 0.500 rad/s; expected rest",
        ),
        (
            lambda s: replace(s, X_TO=s.X_TO + SHIFT),
            "gelatin_box starts 50 mm from where it was before; expected at most 10 mm",
        ),
    ],
)
def test_problems_name_action_value_and_what_is_expected(
    episode: RecordedEpisode, edit: Edit, message: str
) -> None:
    assert problems(edited(episode, edit))[0] == f"e.h5, action 1: {message}"


def test_executed_moves_have_samples(episode: RecordedEpisode) -> None:
    action = replace(episode.actions[0], samples=None)
    episode = replace(episode, actions=(action,))
    assert problems(episode) == ["e.h5, action 1: no samples of a move that is 'placed'"]


def seen_from_above(samples: ActionSamples, shift: int) -> CameraImages:
    """Return an image of the gelatin box from 1 m above, shifted by some pixels."""
    focal, center = 200.0, 127.5
    corners = SCENE["gelatin_box"].X_TO.apply(SCENE["gelatin_box"].object_class.corners)
    # x of the camera is x of T, and y of the camera is -y of T.
    depth = 1.0 - corners[:, 2]
    u = focal * corners[:, 0] / depth + center
    v = focal * -corners[:, 1] / depth + center
    labels = np.zeros((1, 256, 256), dtype=np.uint8)
    labels[0, round(v.min()) : round(v.max()), round(u.min()) + shift : round(u.max()) + shift] = 2
    X_TC = np.array([[0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    return CameraImages(samples.time[:1], X_TC, (focal, focal, center, center), None, None, labels)


@pytest.mark.parametrize(("shift", "is_wrong"), [(0, False), (12, True)])
def test_images_show_objects_where_they_are(
    episode: RecordedEpisode, shift: int, is_wrong: bool
) -> None:
    action = episode.actions[0]
    assert action.samples is not None
    images = {"overhead": seen_from_above(action.samples, shift)}
    found = problems(replace(episode, actions=(replace(action, images=images),)))
    assert bool(found) == is_wrong
    if is_wrong:
        assert "overhead: at 0.000 s gelatin_box is seen about pixel (" in found[0]


def test_images_are_taken_during_the_action(episode: RecordedEpisode) -> None:
    action = episode.actions[0]
    assert action.samples is not None
    image = seen_from_above(action.samples, 0)
    images = {"overhead": replace(image, time=image.time + 3.0)}
    (found,) = problems(replace(episode, actions=(replace(action, images=images),)))
    assert "overhead: images from [3.] to [3.] s; expected times of the action" in found


def test_figures_of_motions(episode: RecordedEpisode) -> None:
    figures = summarize_episode(episode, "e.h5")
    first, unplanned, dropped = figures.actions
    assert (first.object_class, first.result.value) == ("gelatin_box", "placed")
    assert (unplanned.reason, unplanned.motion) == ("no grasp", None)
    assert dropped.number == 3
    motion = first.motion
    assert motion is not None
    assert (motion.duration, motion.num_samples) == (2.0, 41)
    # The tool follows the object, which is carried along a straight line.
    start = SCENE["gelatin_box"].X_TO.p
    place = episode.actions[0].X_TO_place
    assert place is not None
    assert motion.path_length == pytest.approx(float(np.linalg.norm(place.p - start)))
    assert motion.start == pytest.approx((0.1, 0.1))
    assert motion.place == (-0.2, 0.15)
    assert motion.place_error == pytest.approx(0.0)
    limits = load_robot(episode.cell.robot).torque_limits
    assert motion.torque_ratios[1] == pytest.approx(60.0 / limits[1])
    assert len(motions([figures])) == 2


def test_a_move_that_takes_much_longer_is_an_outlier(episode: RecordedEpisode) -> None:
    figures = summarize_episode(episode, "e.h5")
    first = figures.actions[0]
    assert first.motion is not None
    slow = replace(first, number=9, motion=replace(first.motion, duration=20.0))
    figures = replace(figures, actions=(*([first] * 9), slow))
    assert find_outliers([figures]) == ["e.h5, action 9: duration 20.00 s (median 2.00 s), placed"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of two episodes, one with images."""
    out = tmp_path_factory.mktemp("dataset")
    (out / "episodes").mkdir()
    for index, cameras in enumerate(({}, {"overhead": 2})):
        episode = synthetic_episode(index=index, cameras=cameras)
        for action in episode.actions:
            for name, images in action.images.items():
                blank = replace(images, segmentation=None)
                action.images[name] = blank  # type: ignore[index]
        save_episode(out / f"episodes/episode_{index:06d}.h5", episode)
    return out


def test_the_command_prints_plots_and_checks(dataset: Path, tmp_path: Path) -> None:
    run = CliRunner().invoke(
        app, ["inspect", str(dataset), "--plot", str(tmp_path / "plot.png"), "--json"]
    )
    assert run.exit_code == 0, run.output
    document = json.loads(run.stdout)
    assert (document["episodes"], document["attempted_moves"]) == (2, 6)
    assert document["results"] == {"placed": 2, "not planned": 2, "dropped": 2}
    assert document["reasons"] == {"no grasp": 2}
    assert document["duration_s"] == {"median": 2.0, "min": 2.0, "max": 2.0}
    assert document["images"] == 42
    with Image.open(tmp_path / "plot.png") as image:
        assert image.size == (1280, 960)


def test_the_command_says_what_is_wrong(dataset: Path, tmp_path: Path) -> None:
    episode = synthetic_episode()
    broken = edited(episode, lambda s: replace(s, v=changed(s.v, (-1, 0), 1.0)))
    save_episode(tmp_path / "a.h5", broken)
    (tmp_path / "b.h5").write_bytes(b"no HDF5")
    save_episode(tmp_path / "c.h5", replace(episode, rate=30.0))
    run = CliRunner().invoke(app, ["inspect", str(tmp_path)])
    assert run.exit_code == 1
    lines = [line for line in run.output.splitlines() if line.startswith("problem")]
    assert lines[0] == "problem a.h5, action 1: ends at 1.000 rad/s; expected rest"
    assert lines[1].startswith("problem b.h5: cannot be read")
    assert any("c.h5: rate 30.0; expected 20.0, as in a.h5" in line for line in lines)
    run = CliRunner().invoke(app, ["inspect", str(dataset / "episodes/episode_000000.h5")])
    assert run.exit_code == 0, run.output


def test_a_folder_without_episodes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no recorded episode; expected a file, or a folder"):
        find_episode_files(tmp_path)


def test_the_card_states_counts_results_and_origin(dataset: Path) -> None:
    text = CardText("Two moves", "drake-clutter record --episodes 2", "BSD-3-Clause")
    write_card(dataset, load_catalog(), [DatasetFormat.LEROBOT], text)
    card = (dataset / "README.md").read_text()
    assert card.startswith("---\ntask_categories:\n- robotics\n")
    assert "license: bsd-3-clause\n" in card
    assert "- LeRobot\n" in card
    assert "# Two moves\n" in card
    for row in (
        "| attempted moves | 6 |",
        "| executed moves | 4 |",
        "| recorded motion | 0.1 min, 164 samples |",
        "| placed | 2 (33.3 %; 95 % interval 9.7 to 70.0 %) |",
        "| images | overhead: 42 |",
        "| seed | 7 |",
        "| not planned | 2 | 33.3 % |",
        "| no grasp | 2 | 33.3 % |",
        "| gelatin_box | 2 | 2 | 2 |",
        "| duration [s] | 2 | 2 | 2 |",
    ):
        assert row in card
    assert "drake-clutter record --episodes 2" in card
    for name in ("contact_sheet.png", "figures.png"):
        assert f"({name})" in card
        with Image.open(dataset / name) as image:
            assert np.asarray(image.convert("L")).std() > 10, "the picture shows something"
