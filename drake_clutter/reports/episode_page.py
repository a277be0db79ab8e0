"""Web page of an episode: a recording, and images and visible fractions of every move."""

import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import atomic_write, write_text
from drake_clutter.perception.label_detector import PerceptionResult
from drake_clutter.reports.belief_html import belief_html
from drake_clutter.reports.detection_image import draw_detections
from drake_clutter.reports.filmstrip import render_frames, select_key_frames
from drake_clutter.reports.recording import episode_frames, motion_frames, write_recording
from drake_clutter.reports.scene_images import Annotations, Highlight, SceneRenderer, display_name
from drake_clutter.scenes.interfaces import Instability, InstabilityReason, Move, MoveResult
from drake_clutter.scenes.scene import TRAY, Pose, Scene
from drake_clutter.tasks.exploration_task import Transition

_TEMPLATE = Path(__file__).with_name("episode_page.html")
_IMAGES = "images"
_MIN_VISIBLE_CHANGE = 0.01
"""Smallest probability, or change of a visible fraction, that is shown without unfolding."""
_LEGEND = {
    Highlight.HIDDEN: "hidden, not found yet",
    Highlight.FOUND: "newly found",
    Highlight.MOVED: "moved; the arrow leads to its new place",
    Highlight.OCCLUDED: "found before, now out of view",
    Highlight.FALLEN: "fell or slipped",
    Highlight.VISIBLE: "in view; the number is that of its name",
}
_DASHED = (Highlight.HIDDEN, Highlight.OCCLUDED)
_BADGES = {
    MoveResult.PLACED: "good",
    MoveResult.CAME_OFF: "good",
    MoveResult.COLLAPSED: "bad",
    MoveResult.LEFT_TRAY: "bad",
    MoveResult.DROPPED: "bad",
}
_LABELS = {
    "agent": "Policy",
    "seed": "Random seed",
    "fidelity": "Fidelity of moves",
    "success": "All objects found",
    "termination": "Episode ended with",
    "total_reward": "Total reward",
    "scenes_tried": "Scenes tried",
}
"""Labels of the key figures, by key of the summary."""
_KEY_FRAMES = ("Before the lift", "Carry", "Place", "Retreat")
"""Captions of the images of the arm, one for each of `select_key_frames`."""
_FRAME_SIDE = 480
"""Side of the images of the arm [px]."""
_RECORDING_NOTES = {
    "arm": "The motion of the arm and of all objects is simulated.",
    "settle": "Lifting and carrying are an illustration, because objects are teleported; how they "
    "settle afterwards is simulated.",
    "static": "Lifting and carrying are an illustration, because objects are teleported; their "
    "stability is computed without a simulation.",
}
"""What the recording shows, by the kind of motion that the moves have."""


def write_episode_page(
    out: Path,
    title: str,
    initial_scene: Scene,
    initial_perception: PerceptionResult,
    steps: Sequence[Transition],
    summary: Mapping[str, Any],
    cell: WorkCell,
) -> None:
    """Write `index.html`, `recording.html` and `images/*.png`, which need no network.

    Args:
        out: Folder, which exists.
        title: Heading of the page.
        initial_scene: Scene before the first move.
        initial_perception: Perception result of the initial scene.
        steps: Transitions in order.
        summary: JSON values by key; numbers, texts and truth values become key figures.
        cell: Work cell in which the moves were made.
    """
    images = _PageImages(out)
    found_so_far = set(_visible_names(initial_perception))
    initially_hidden = [name for name in initial_scene.names if name not in found_so_far]
    initial_scene_html = _initial_scene_html(images, initial_scene, initially_hidden)
    moves = list[str]()
    scene = initial_scene
    perception = initial_perception
    for number, step in enumerate(steps, start=1):
        moves.append(
            _move_html(images, number, scene, perception, step, frozenset(found_so_far), cell)
        )
        found_so_far.update(step.newly_found)
        scene = step.outcome.scene
        perception = step.next_perception
    write_recording(
        out / "recording.html", initial_scene, episode_frames(initial_scene, steps), cell
    )
    num_hidden = len(initially_hidden)
    num_found = sum(name in found_so_far for name in initially_hidden)
    figures = {
        "Objects in the scene": str(len(initial_scene.objects)),
        "Hidden objects found": f"{num_found} of {num_hidden}",
        "Moves": str(len(steps)),
    }
    page = Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=escape(title),
        highlights="\n".join(
            f".{_css_class(highlight)} {{ --highlight: {highlight.value}; }}"
            for highlight in Highlight
        ),
        figures=_key_figures_html(figures, summary),
        recording_note=_recording_note(steps),
        start=initial_scene_html,
        legend=_legend_html(),
        moves=("\n".join(moves) or "<p>No move was made.</p>") + _end_html(summary),
        summary=escape(json.dumps(summary, indent=2)),
    )
    write_text(out / "index.html", page)


class _PageImages:
    """Renders images and writes them to the folder of a page."""

    def __init__(self, out: Path) -> None:
        """Create the folder of images in the folder of the page."""
        self.renderer = SceneRenderer()
        self._folder = out / _IMAGES
        self._folder.mkdir(exist_ok=True)

    def figure(self, name: str, image: NDArray[np.uint8], alt: str, caption: str) -> str:
        """Write `name`.png and return its figure element."""
        with atomic_write(self._folder / f"{name}.png") as temporary:
            Image.fromarray(image).save(temporary)
        height, width = image.shape[:2]
        return (
            f'<figure><img src="{_IMAGES}/{escape(name)}.png" width="{width}" height="{height}" '
            f'alt="{escape(alt)}"><figcaption>{escape(caption)}</figcaption></figure>'
        )


def _recording_note(steps: Sequence[Transition]) -> str:
    """Return which part of the recording is simulated."""
    if any(step.outcome.samples is not None for step in steps):
        return _RECORDING_NOTES["arm"]
    return _RECORDING_NOTES["settle" if any(step.outcome.motion for step in steps) else "static"]


def _initial_scene_html(images: _PageImages, scene: Scene, hidden: Sequence[str]) -> str:
    overhead = images.renderer.render_annotated(scene, Annotations(hidden=tuple(hidden)))
    hidden_text = f"Hidden: {_display_names(hidden)}." if hidden else "Nothing is hidden."
    return (
        '<div class="pair start">'
        + images.figure(
            "start_overhead",
            overhead,
            f"The tray from above at the start. {hidden_text}",
            f"From above. {hidden_text}",
        )
        + images.figure(
            "start_oblique",
            images.renderer.render_oblique(scene),
            "The tray from the front, at an angle",
            "From the front.",
        )
        + "</div>"
    )


def _move_html(
    images: _PageImages,
    number: int,
    scene: Scene,
    perception: PerceptionResult,
    step: Transition,
    found_so_far: frozenset[str],
    cell: WorkCell,
) -> str:
    """Return the part of the page about one move.

    Args:
        images: Images of the page.
        number: Number of the move, from 1.
        scene: Scene before the move.
        perception: Perception result before the move.
        step: The transition.
        found_so_far: Names of the objects found before the move.
        cell: Work cell.
    """
    threshold = perception.observation.camera.visibility_threshold
    result = step.outcome.result
    badge = f'<span class="badge {_BADGES.get(result, "")}">{escape(result.value)}</span>'
    bars = _visible_fractions_html(
        perception.visible_fractions,
        step.next_perception.visible_fractions,
        threshold,
        step.newly_found,
    )
    return (
        f'<article><div class="head"><h3>{number}. {escape(_move_text(step.move))}</h3>{badge}'
        f"</div><p>{_notes_html(step)}</p>"
        f'<div class="pair">'
        f"{_overhead_figures(images, number, scene, perception, step, found_so_far)}</div>"
        f"{_arm_figures(images, number, scene, step, cell)}"
        f"{_hidden_html(step)}"
        f"{_pick_probabilities_html(step, scene)}"
        f"<h4>Visible fraction of each object, before &rarr; after the move (hidden below "
        f"{threshold:.0%})</h4>{bars}</article>"
    )


def _hidden_html(step: Transition) -> str:
    """Return the belief before a move; nothing if the policy does not estimate it."""
    hidden = step.decision.hidden
    if hidden is None:
        return ""
    return belief_html(hidden.to_dict(), "Belief before the move")


def _end_html(summary: Mapping[str, Any]) -> str:
    """Return the part of the page about the belief at which the agent stopped, if it did."""
    hidden = summary.get("hidden_at_end")
    if hidden is None:
        return ""
    title = f"<h3>{escape(str(summary['termination']))}</h3>"
    return f"<article>{title}{belief_html(hidden, 'Belief at the end')}</article>"


def _notes_html(step: Transition) -> str:
    """Return the sentences about the result of a move."""
    outcome = step.outcome
    notes = ["Nothing newly found."]
    if step.newly_found:
        notes = [f"Newly found: <strong>{escape(_display_names(step.newly_found))}</strong>."]
    notes.append(f"Reward {step.reward:+g}.")
    if outcome.instability:
        notes.append(f"{escape(_instability_text(outcome.instability, outcome.scene))}.")
    if outcome.detail:
        notes.append(f"{escape(outcome.detail[:1].upper() + outcome.detail[1:])}.")
    return " ".join(notes)


def _overhead_figures(
    images: _PageImages,
    number: int,
    scene: Scene,
    perception: PerceptionResult,
    step: Transition,
    found_so_far: frozenset[str],
) -> str:
    """Return the figures of the tray from above; see `_move_html` for the arguments."""
    outcome = step.outcome
    visible_before = _visible_names(perception)
    visible_after = _visible_names(step.next_perception)
    hidden = tuple(name for name in scene.names if name not in found_so_far)
    before = Annotations(
        hidden=hidden,
        occluded=tuple(
            name for name in scene.names if name in found_so_far and name not in visible_before
        ),
        moved=step.move.pick,
        X_T_placed=_place_pose(scene, step),
    )
    hidden_text = _display_names(hidden) or "nothing"
    figures = images.figure(
        f"move_{number:02d}_before",
        images.renderer.render_annotated(scene, before),
        f"The tray from above before move {number}: {_move_text(step.move)}. "
        f"Hidden: {hidden_text}.",
        "Before the move.",
    )
    if outcome.result.was_executed:
        still_hidden = tuple(name for name in hidden if name not in step.newly_found)
        after = Annotations(
            hidden=still_hidden,
            occluded=tuple(
                name
                for name in scene.names
                if name not in still_hidden and name not in visible_after
            ),
            found=step.newly_found,
            fallen=(outcome.instability.object,) if outcome.instability else (),
            moved=step.move.pick,
        )
        found_text = _display_names(step.newly_found) or "nothing"
        figures += images.figure(
            f"move_{number:02d}_after",
            images.renderer.render_annotated(outcome.scene, after),
            f"The tray from above after move {number}. Newly found: {found_text}.",
            "After the move.",
        )
    if step.decision.observation is not None:
        observation = step.decision.observation
        names = _display_names([d.object_class.name for d in observation.detections])
        figures += images.figure(
            f"move_{number:02d}_detections",
            draw_detections(observation),
            f"The depth image before move {number}; detected objects: {names or 'none'}",
            "Depth image before the move (brighter is higher), with the detected objects.",
        )
    return figures


def _arm_figures(
    images: _PageImages, number: int, scene: Scene, step: Transition, cell: WorkCell
) -> str:
    """Return the figures of the arm during a move; none if no arm executed it."""
    samples = step.outcome.samples
    if samples is None:
        return ""
    frames = select_key_frames(motion_frames(samples, scene.names), step.move.pick)
    figures = [
        images.figure(
            f"move_{number:02d}_arm_{index}",
            image,
            f"The arm in move {number} at {frame.time:.1f} s: {caption.lower()}",
            f"{caption}, {frame.time:.1f} s after the start.",
        )
        for index, (caption, frame, image) in enumerate(
            zip(_KEY_FRAMES, frames, render_frames(scene, frames, cell, _FRAME_SIDE), strict=True),
            start=1,
        )
    ]
    return f'<div class="key-frames">{"".join(figures)}</div>'


def _place_pose(scene: Scene, step: Transition) -> Pose | None:
    """Return X_TO where the picked object was released.

    Of a move that was not executed, it is the pose that the move gives, or above the object that it
    names; None for the tray.
    """
    if step.outcome.result.was_executed:
        return step.outcome.X_TO_released or step.outcome.scene[step.move.pick].X_TO
    X_TO_pick = scene[step.move.pick].X_TO
    if step.move.place == TRAY or step.move.place_values is not None:
        return step.move.place_pose(X_TO_pick)
    return Pose(scene[step.move.place].X_TO.translation, X_TO_pick.quaternion)


def _pick_probabilities_html(step: Transition, scene: Scene) -> str:
    """Return the policy's pick probabilities, the highest first; nothing if it has none."""
    decision = step.decision
    if not decision.pick_probabilities:
        return ""
    probabilities = sorted(decision.pick_probabilities.items(), key=lambda item: -item[1])
    shown = list[str]()
    folded = list[str]()
    for name, probability in probabilities:
        bar = (
            f'<div class="bar"><span>{escape(display_name(name))}</span><span class="track">'
            f'<b style="width:{_percent(probability)}"></b></span>'
            f"<span>{probability:.0%}</span></div>"
        )
        (folded if probability < _MIN_VISIBLE_CHANGE else shown).append(bar)
    known = decision.considered
    html = (
        f"<h4>Probability with which the policy picks each object ({len(known)} of "
        f"{len(scene.objects)} objects are known)</h4>"
        f'<div class="bars">{"".join(shown)}</div>'
    )
    picked = 0.0 if decision.move is None else decision.pick_probabilities[decision.move.pick]
    if skipped := [name for name, probability in probabilities if probability > picked]:
        names = escape(_display_names(skipped))
        html += f'<p class="soft">Skipped, because no free placement was found: {names}.</p>'
    if folded:
        html += _details_html(f"{len(folded)} below {_MIN_VISIBLE_CHANGE:.0%}", folded)
    names = escape(_display_names(known))
    return html + f"<details><summary>Known objects</summary><p>{names}.</p></details>"


def _visible_fractions_html(
    before: Mapping[str, float], after: Mapping[str, float], threshold: float, found: Sequence[str]
) -> str:
    """Return bars of visible fractions; those that are unchanged and in view are folded.

    Args:
        before: Visible fraction of each object before the move.
        after: Visible fraction of each object after the move.
        threshold: Fraction below which an object counts as hidden.
        found: Names of the newly found objects.
    """
    shown = list[str]()
    folded = list[str]()
    for name, fraction_after in after.items():
        fraction_before = before[name]
        css_class = "found" if name in found else "hidden" if fraction_after < threshold else ""
        bar = (
            f'<div class="bar"><span>{escape(display_name(name))}</span><span class="track">'
            f'<b class="{css_class}" style="width:{_percent(fraction_after)}"></b>'
            f'<u class="threshold" style="left:{_percent(threshold)}"></u>'
            f'<u class="before" style="left:calc({_percent(fraction_before)} - 1.5px)"></u></span>'
            f"<span>{fraction_before:.0%} &rarr; {fraction_after:.0%}</span></div>"
        )
        changed = abs(fraction_after - fraction_before) >= _MIN_VISIBLE_CHANGE
        if css_class or changed or fraction_before < threshold:
            shown.append(bar)
        else:
            folded.append(bar)
    html = '<p class="soft">No visible fraction changed.</p>'
    if shown:
        html = (
            f'<div class="bars">{"".join(shown)}</div><p class="soft">Bar: after the move; framed '
            "tick: before the move; dotted line: threshold.</p>"
        )
    if folded:
        html += _details_html(f"{len(folded)} unchanged, in view", folded)
    return html


def _details_html(title: str, bars: Sequence[str]) -> str:
    """Return bars that are folded."""
    return f'<details><summary>{title}</summary><div class="bars">{"".join(bars)}</div></details>'


def _key_figures_html(figures: Mapping[str, str], summary: Mapping[str, Any]) -> str:
    """Return cards of figures, by label, and of the scalars of a summary."""
    texts = dict(figures)
    for key, value in summary.items():
        if key != "num_objects" and isinstance(value, str | int | float):
            texts[_LABELS.get(key, display_name(key))] = _format_value(value)
    return "".join(
        f"<div><dt>{escape(label)}</dt><dd>{escape(text)}</dd></div>"
        for label, text in texts.items()
    )


def _format_value(value: str | int | float) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _legend_html() -> str:
    entries = "".join(
        f'<li><i class="{"dashed " if highlight in _DASHED else ""}{_css_class(highlight)}"></i>'
        f"{text}</li>"
        for highlight, text in _LEGEND.items()
    )
    return f'<ul class="legend" aria-label="Colors in the images">{entries}</ul>'


def _css_class(highlight: Highlight) -> str:
    return highlight.name.lower().replace("_", "-")


def _percent(fraction: float) -> str:
    return f"{100 * min(max(fraction, 0.0), 1.0):.1f}%"


def _visible_names(perception: PerceptionResult) -> tuple[str, ...]:
    return tuple(detection.name for detection in perception.observation.detections)


def _display_names(names: Sequence[str]) -> str:
    return ", ".join(display_name(name) for name in names)


def _move_text(move: Move) -> str:
    place = move.place if move.place == TRAY else display_name(move.place)
    return f"{display_name(move.pick)} \N{RIGHTWARDS ARROW} {place}"


def _instability_text(instability: Instability, after: Scene) -> str:
    displacement = f"moved {1000 * instability.displacement:.0f} mm"
    tilt = f"tilted {np.degrees(instability.tilt):.0f}\N{DEGREE SIGN}"
    name = display_name(instability.object)
    place = ""
    if instability.reason is InstabilityReason.LEFT_TRAY:
        place = f", and is at {after[instability.object].X_TO.place_text}"
    return f"{name}: {instability.reason.value} ({displacement}, {tilt}){place}"
