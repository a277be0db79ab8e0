"""Episode pages with their images and recording, contact sheets and diagram drawings."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, TRAY, resting, rng, scene_of
from PIL import Image
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import PassThrough, ZeroOrderHold

from drake_clutter.config import ClutterConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.reports.contact_sheet import MAX_THUMBNAILS, TILE_SIZE, write_contact_sheet
from drake_clutter.reports.detection_image import draw_detections
from drake_clutter.reports.diagram_drawing import connection_graph, draw_diagram
from drake_clutter.reports.episode_page import write_episode_page
from drake_clutter.reports.recording import FRAMES_PER_SECOND, episode_frames, write_recording
from drake_clutter.reports.scene_images import Annotations, Highlight, display_name
from drake_clutter.scenes.interfaces import (
    Instability,
    InstabilityReason,
    MotionSample,
    Move,
    MoveResult,
    Outcome,
)
from drake_clutter.scenes.scene import Scene
from drake_clutter.tasks.belief import Decision
from drake_clutter.tasks.episode import make_teleport_backend_factory, run_episode
from drake_clutter.tasks.exploration_task import ExplorationTask, Transition

GELATIN = resting("gelatin_box", xy=(-0.15, 0.1), name="gelatin_box_1")
SCENE = scene_of(
    GELATIN,
    resting("cracker_box", xy=(-0.15, 0.1), floor=GELATIN.top_height, name="cracker_box_2"),
    resting("sugar_box", xy=(0.2, -0.2), name="sugar_box_3"),
)
UNCOVER = Move("cracker_box_2")
HOSTILE = '<script>alert(1)</script> & "co"'


class Page(HTMLParser):
    """References, texts and tags of a page."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.references: list[str] = []
        self.alts: list[str | None] = []
        self.tags: list[str] = []
        self.text = ""
        self.feed(source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.tags.append(tag)
        self.references += [value for key in ("src", "href") if (value := values.get(key))]
        if tag == "img":
            self.alts.append(values.get("alt"))

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def task(config: ClutterConfig) -> ExplorationTask:
    """Episode of one move, which uncovers the gelatin box."""
    backend = make_teleport_backend_factory("settle", config, simulate_collapse=True)(SCENE, rng())
    task = run_episode(backend, lambda *_: Decision(UNCOVER), max_moves=1)
    assert task.found == ("gelatin_box_1",)
    return task


@pytest.fixture(scope="module")
def folder(task: ExplorationTask, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the episode's page, to which two invented moves are added.

    The first finds no free placement, the second makes the sugar box fall.
    """
    out = tmp_path_factory.mktemp("page")
    step = task.transitions[0]
    onto_gelatin = Decision(Move("sugar_box_3", "gelatin_box_1"))
    stuck = Transition(
        onto_gelatin,
        Outcome(MoveResult.NO_FREE_PLACEMENT, task.scene),
        step.next_perception,
        (),
        0.0,
    )
    fallen = Instability(InstabilityReason.TOPPLED, "sugar_box_3", 0.1, 1.5)
    outcome = Outcome(MoveResult.COLLAPSED, task.scene, fallen)
    collapse = Transition(Decision(Move("cracker_box_2")), outcome, step.next_perception, (), -1.0)
    summary = {"agent": HOSTILE, "seed": 3, "success": True, "moves": [{"move": HOSTILE}]}
    write_episode_page(
        out,
        f"Episode {HOSTILE}",
        task.initial_scene,
        task.initial_perception,
        [step, stuck, collapse],
        summary,
        DEFAULT_CELL,
    )
    return out


def test_the_page_refers_only_to_files_in_its_folder(folder: Path) -> None:
    source = (folder / "index.html").read_text(encoding="utf-8")
    page = Page(source)
    assert not re.search(r"https?://|@import|url\(", source)
    assert {"recording.html", "images/start_oblique.png", "images/move_01_after.png"} <= set(
        page.references
    )
    for reference in page.references:
        assert (folder / reference).is_file(), reference
    written = {f"images/{path.name}" for path in (folder / "images").iterdir()}
    assert written == {
        reference for reference in page.references if reference.startswith("images/")
    }
    assert "$" not in source  # every field of the template is filled in
    assert all(page.alts)


def test_the_page_describes_the_moves(folder: Path) -> None:
    text = Page((folder / "index.html").read_text(encoding="utf-8")).text
    assert "Hidden: Gelatin box 1." in text
    assert "1. Cracker box 2 \N{RIGHTWARDS ARROW} tray" in text
    assert "Newly found: Gelatin box 1." in text
    assert "0% \N{RIGHTWARDS ARROW} 100%" in text
    assert "no free spot" in text
    assert "Sugar box 3: toppled (moved 100 mm, tilted 86\N{DEGREE SIGN})" in text


def test_texts_from_outside_are_escaped(folder: Path) -> None:
    page = Page((folder / "index.html").read_text(encoding="utf-8"))
    assert "script" not in page.tags
    assert page.text.count(HOSTILE) >= 3  # the document's title, the heading, the key figure


def test_images_have_their_size_and_are_not_empty(folder: Path) -> None:
    for path in (folder / "images").iterdir():
        with Image.open(path) as picture:
            assert picture.size == ((960, 720) if "oblique" in path.name else (720, 720))
            assert np.asarray(picture).std() > 20, path.name
            assert len(picture.getcolors(maxcolors=2**20) or ()) > 1000, path.name


def test_hidden_and_found_objects_are_highlighted(folder: Path) -> None:
    def pixels(name: str, mark: Highlight) -> int:
        color = [int(mark.value[i : i + 2], 16) for i in (1, 3, 5)]
        with Image.open(folder / "images" / name) as picture:
            return int((np.abs(np.asarray(picture, int) - color).max(axis=2) < 3).sum())

    assert pixels("start_overhead.png", Highlight.HIDDEN) > 500
    assert pixels("start_overhead.png", Highlight.MOVED) == 0
    assert pixels("move_01_before.png", Highlight.MOVED) > 500
    assert pixels("move_01_after.png", Highlight.FOUND) > 500
    assert pixels("move_01_after.png", Highlight.HIDDEN) == 0
    assert pixels("move_03_after.png", Highlight.FALLEN) > 500


def test_a_moved_object_that_fell_is_highlighted_as_fallen() -> None:
    assert Annotations(fallen=("a",), moved="a").highlight("a") is Highlight.FALLEN
    assert Annotations(found=("a",), moved="a").highlight("a") is Highlight.MOVED
    assert Annotations().highlight("a") is Highlight.VISIBLE


def test_the_recording_is_one_animated_file(folder: Path, tmp_path: Path) -> None:
    source = (folder / "recording.html").read_text(encoding="utf-8")
    assert not re.search(r"<(script|link|img|iframe)[^>]*\b(src|href)\s*=", source)
    assert len(source) < 4_000_000
    still = tmp_path / "still.html"
    write_recording(still, SCENE, [MotionSample(0.0, SCENE.poses)], DEFAULT_CELL)
    # The last command that the viewer is given; a still scene has none of its kind.
    assert _commands(source, "set_animation") == 1
    assert _commands(still.read_text(encoding="utf-8"), "set_animation") == 0


def _commands(source: str, kind: str) -> int:
    from base64 import b64decode

    blocks = re.findall(r'fetch\("data:application/octet-binary;base64,([^"]*)"\)', source)
    return sum(kind.encode() in b64decode(block)[:60] for block in blocks)


def test_frames_lift_carry_and_settle(task: ExplorationTask) -> None:
    frames = episode_frames(task.initial_scene, task.transitions)
    times = [frame.time for frame in frames]
    assert times == sorted(times)
    assert len(set(np.rint(np.multiply(times, FRAMES_PER_SECOND)))) >= 0.9 * len(times)
    assert frames[0].poses == task.initial_scene.poses
    assert frames[-1].poses == task.scene.poses
    path = np.array([frame.poses["cracker_box_2"].p for frame in frames])
    assert path[:, 2].max() > max(o.top_height for o in SCENE.objects)
    # Nothing jumps: within a frame of carrying, less than 10 cm.
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.1


def test_a_move_that_was_not_executed_has_no_frames(task: ExplorationTask) -> None:
    step = replace(task.transitions[0], outcome=Outcome(MoveResult.NO_FREE_PLACEMENT, SCENE))
    assert {frame.poses["cracker_box_2"] for frame in episode_frames(SCENE, [step])} == {
        SCENE["cracker_box_2"].X_TO
    }


def test_a_page_without_moves(detector: LabelDetector, tmp_path: Path) -> None:
    alone = Scene((GELATIN,), TRAY)
    write_episode_page(
        tmp_path, "Nothing to do", alone, detector.perceive(alone), [], {}, DEFAULT_CELL
    )
    text = Page((tmp_path / "index.html").read_text(encoding="utf-8")).text
    assert "Nothing is hidden." in text
    assert "No move was made." in text


def test_pick_probabilities_are_shown(task: ExplorationTask, tmp_path: Path) -> None:
    (step,) = task.transitions
    other = next(name for name in task.detected if name != step.move.pick)
    decision = Decision(step.move, {other: 0.6, step.move.pick: 0.4}, (other, step.move.pick))
    write_episode_page(
        tmp_path,
        "Believed",
        task.initial_scene,
        task.initial_perception,
        [replace(step, decision=decision)],
        {},
        DEFAULT_CELL,
    )
    text = Page((tmp_path / "index.html").read_text(encoding="utf-8")).text
    assert f"2 of {len(task.scene.objects)} objects are known" in text
    assert text.index("60%") < text.index("40%")
    assert f"Skipped, because no free placement was found: {display_name(other)}." in text
    assert f"Known objects{display_name(other)}, {display_name(step.move.pick)}." in text


def test_detections_are_shown(task: ExplorationTask, tmp_path: Path) -> None:
    (step,) = task.transitions
    seen = task.initial_perception.observation
    shown = replace(step, decision=Decision(step.move, observation=seen))
    write_episode_page(
        tmp_path, "Seen", task.initial_scene, task.initial_perception, [shown], {}, DEFAULT_CELL
    )
    picture = np.asarray(Image.open(tmp_path / "images/move_01_detections.png"))
    assert picture.shape == (720, 720, 3)
    assert "detected objects: Cracker box, Sugar box" in (tmp_path / "index.html").read_text()
    unseen = draw_detections(replace(seen, detections=()))
    assert (picture != unseen).any(axis=2).mean() > 0.01, "outlines and labels"
    assert (unseen[:40, :40] == unseen[0, 0]).all(), "the tray's floor"


@pytest.mark.parametrize(("count", "columns", "rows"), [(1, 2, 1), (7, 4, 2), (48, 8, 6)])
def test_contact_sheet(tmp_path: Path, count: int, columns: int, rows: int) -> None:
    picture = np.full((90, 120, 3), 128, np.uint8)
    write_contact_sheet(
        tmp_path / "sheet.png", [(picture, f"{i:04d}  hidden 2", i != 1) for i in range(count)]
    )
    with Image.open(tmp_path / "sheet.png") as sheet:
        gap = sheet.width - columns * TILE_SIZE[0]
        assert sheet.size == (columns * TILE_SIZE[0] + gap, rows * TILE_SIZE[1] + gap)
        assert 0 < gap < 20
        red, green, _ = sheet.convert("RGB").getpixel((gap + 1, gap + 1))  # type: ignore[misc]
        assert green > red
        if count > 1:
            red, green, _ = sheet.convert("RGB").getpixel((gap + TILE_SIZE[0] + 1, gap + 1))  # type: ignore[misc]
            assert red > green


@pytest.mark.parametrize("count", [0, MAX_THUMBNAILS + 1])
def test_a_contact_sheet_has_1_to_48_thumbnails(tmp_path: Path, count: int) -> None:
    with pytest.raises(ValueError, match="expected 1 to 48"):
        write_contact_sheet(
            tmp_path / "sheet.png", [(np.zeros((4, 4, 3), np.uint8), "", True)] * count
        )


def test_the_drawing_of_a_diagram_has_all_its_connections(tmp_path: Path) -> None:
    builder = DiagramBuilder()
    there, back = (
        builder.AddNamedSystem("there", PassThrough(1)),
        builder.AddNamedSystem("back", ZeroOrderHold(0.1, 1)),
    )
    builder.Connect(there.get_output_port(), back.get_input_port())
    builder.Connect(back.get_output_port(), there.get_input_port())
    diagram = builder.Build()
    ports = {"ports": ["y → u"]}
    assert list(connection_graph(diagram).edges(data=True)) == [
        ("there", "back", ports),
        ("back", "there", ports),
    ]
    draw_diagram(diagram, tmp_path / "loop.svg")
    words = re.findall(r">([^<]+)</text>", (tmp_path / "loop.svg").read_text())
    assert {"there", "back", "PassThrough", "ZeroOrderHold", "y → u"} <= set(words)


def test_display_name() -> None:
    assert display_name("sugar_box_3") == "Sugar box 3"
    assert display_name("initially_hidden") == "Initially hidden"
