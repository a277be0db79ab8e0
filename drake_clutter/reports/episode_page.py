"""A page about an episode: a recording, and every move in pictures and shares."""

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
from drake_clutter.reports.detection_image import draw_detections
from drake_clutter.reports.filmstrip import render_filmstrip, select_key_frames
from drake_clutter.reports.recording import episode_frames, write_recording
from drake_clutter.reports.scene_images import Annotations, Highlight, SceneRenderer, display_name
from drake_clutter.scenes.interfaces import Instability, Move, MoveResult
from drake_clutter.scenes.scene import TRAY, Pose, Scene
from drake_clutter.tasks.belief import Decision
from drake_clutter.tasks.exploration_task import Transition

_TEMPLATE = Path(__file__).with_name("episode_page.html")
_IMAGES = "images"
_MIN_VISIBLE_CHANGE = 0.01
"""A visible share that changes by less goes below the fold."""
_LEGEND = {
    Highlight.HIDDEN: "hidden, not found yet",
    Highlight.FOUND: "newly found",
    Highlight.MOVED: "moved, with the place it goes to",
    Highlight.OCCLUDED: "found before, now out of view",
    Highlight.FALLEN: "did not stay",
    Highlight.VISIBLE: "in view, with the number of its name",
}
_DASHED = (Highlight.HIDDEN, Highlight.OCCLUDED)
_BADGES = {MoveResult.PLACED: "good", MoveResult.COLLAPSED: "bad", MoveResult.DROPPED: "bad"}


def write_episode_page(
    out: Path,
    title: str,
    initial_scene: Scene,
    initial_perception: PerceptionResult,
    steps: Sequence[Transition],
    summary: Mapping[str, Any],
    cell: WorkCell,
) -> None:
    """Writes `index.html`, `recording.html` and `images/*.png`; the page needs nothing else, and no network.

    Args:
        out: a folder that exists.
        title: heading of the page.
        initial_scene: the scene before the first move.
        initial_perception: what the camera showed of it.
        steps: the moves in order.
        summary: JSON values by key; the numbers, words and truth values among them become key figures.
        cell: in which the moves were made.
    """
    images = _PageImages(out)
    found_so_far = set(_visible_names(initial_perception))
    hidden_at_start = [name for name in initial_scene.names if name not in found_so_far]
    start_html = _initial_scene_html(images, initial_scene, hidden_at_start)
    moves, scene, perception = [], initial_scene, initial_perception
    for number, step in enumerate(steps, start=1):
        moves.append(
            _move_html(images, number, scene, perception, step, frozenset(found_so_far), cell)
        )
        found_so_far.update(step.newly_found)
        scene, perception = step.outcome.scene, step.next_perception
    write_recording(
        out / "recording.html", initial_scene, episode_frames(initial_scene, steps), cell
    )
    found = [name for name in hidden_at_start if name in found_so_far]
    page = Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=escape(title),
        marks="\n".join(f".{_css_class(mark)} {{ --mark: {mark.value}; }}" for mark in Highlight),
        figures=_key_figures_html(
            len(initial_scene.objects), len(hidden_at_start), len(found), len(steps), summary
        ),
        start=start_html,
        legend=_legend_html(),
        moves="\n".join(moves) or "<p>No move was made.</p>",
        summary=escape(json.dumps(summary, indent=2)),
    )
    write_text(out / "index.html", page)


class _PageImages:
    """Takes pictures and keeps them in the page's folder."""

    def __init__(self, out: Path) -> None:
        self.renderer = SceneRenderer()
        self._folder = out / _IMAGES
        self._folder.mkdir(exist_ok=True)

    def figure(self, name: str, picture: NDArray[np.uint8], alt: str, caption: str) -> str:
        """Writes `name`.png; returns its figure element."""
        with atomic_write(self._folder / f"{name}.png") as temporary:
            Image.fromarray(picture).save(temporary)
        height, width = picture.shape[:2]
        return (
            f'<figure><img src="{_IMAGES}/{escape(name)}.png" width="{width}" height="{height}" alt="{escape(alt)}">'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )


def _initial_scene_html(images: _PageImages, start: Scene, hidden: Sequence[str]) -> str:
    overhead = images.renderer.render_annotated(start, Annotations(hidden=tuple(hidden)))
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
            images.renderer.render_oblique(start),
            "The tray from the front, at an angle",
            "At an angle.",
        )
        + "</div>"
    )


def _move_html(
    images: _PageImages,
    number: int,
    scene: Scene,
    look: PerceptionResult,
    step: Transition,
    known: frozenset[str],
    cell: WorkCell,
) -> str:
    """One move's part of the page; `scene` and `look` are from before it, `known` is what had been found by then."""
    outcome, move_text = step.outcome, _move_text(step.move)
    before_view, after_view = _visible_names(look), _visible_names(step.next_perception)
    unknown = tuple(name for name in scene.names if name not in known)
    covered = tuple(name for name in scene.names if name in known and name not in before_view)
    before = Annotations(
        hidden=unknown, occluded=covered, moved=step.move.pick, X_T_placed=_place_pose(scene, step)
    )
    figures = images.figure(
        f"move_{number:02d}_before",
        images.renderer.render_annotated(scene, before),
        f"The tray from above before move {number}: {move_text}. Hidden: {_display_names(unknown) or 'nothing'}.",
        "Before, with the move.",
    )
    if outcome.result.was_executed:
        still_unknown = tuple(name for name in unknown if name not in step.newly_found)
        after = Annotations(
            hidden=still_unknown,
            occluded=tuple(
                name for name in scene.names if name not in still_unknown and name not in after_view
            ),
            found=step.newly_found,
            fallen=(outcome.instability.object,) if outcome.instability else (),
            moved=step.move.pick,
        )
        figures += images.figure(
            f"move_{number:02d}_after",
            images.renderer.render_annotated(outcome.scene, after),
            f"The tray from above after move {number}. Newly found: {_display_names(step.newly_found) or 'nothing'}.",
            "After.",
        )
    notes = [
        f"Newly found: <strong>{escape(_display_names(step.newly_found))}</strong>."
        if step.newly_found
        else "Nothing newly found."
    ]
    notes.append(f"Reward {step.reward:+g}.")
    if outcome.instability:
        notes.append(f"{escape(_instability_text(outcome.instability))}.")
    if outcome.detail:
        notes.append(f"{escape(outcome.detail)}.")
    if step.decision.observation is not None:
        observation = step.decision.observation
        names = _display_names(
            [detection.object_class.name for detection in observation.detections]
        )
        alt = f"The depth image before move {number}, with what was recognised in it: {names or 'nothing'}"
        caption = "What the camera measured before the move, brighter is higher, and what was recognised in it."
        figures += images.figure(
            f"move_{number:02d}_seen", draw_detections(observation), alt, caption
        )
    if outcome.motion and outcome.motion[0].arm:
        key_frames = select_key_frames(outcome.motion, step.move.pick)
        alt = f"The arm in four moments of move {number}: before the lift, on the way, at the place, and when it has let go"
        figures += images.figure(
            f"move_{number:02d}_arm",
            render_filmstrip(scene, key_frames, cell),
            alt,
            "The arm: lift, carry, place, retreat.",
        )
    badge = f'<span class="badge {_BADGES.get(outcome.result, "")}">{escape(outcome.result.value)}</span>'
    threshold = look.observation.camera.visibility_threshold
    after = step.next_perception.visible_fractions
    return (
        f'<article><div class="head"><h3>{number}. {escape(move_text)}</h3>{badge}</div><p>{" ".join(notes)}</p>'
        f'<div class="pair">{figures}</div>'
        f"{_pick_probabilities_html(step.decision, scene, step.newly_found)}"
        f"<h4>Visible share of each object, before &rarr; after (hidden below {threshold:.0%})</h4>"
        f"{_visible_fractions_html(look.visible_fractions, after, threshold, step.newly_found)}</article>"
    )


def _place_pose(scene: Scene, step: Transition) -> Pose | None:
    """Where the picked object was let go; of a move that was not carried out, above the object it was meant for."""
    if step.outcome.result.was_executed:
        return step.outcome.X_TO_released or step.outcome.scene[step.move.pick].X_TO
    return (
        None
        if step.move.place == TRAY
        else Pose(scene[step.move.place].X_TO.translation, scene[step.move.pick].X_TO.quaternion)
    )


def _pick_probabilities_html(decision: Decision, scene: Scene, found: Sequence[str]) -> str:
    """What the agent went by: how likely it was to pick each object, the likeliest first, and what it knew."""
    if not decision.pick_probabilities:
        return ""
    probabilities = sorted(decision.pick_probabilities.items(), key=lambda item: -item[1])
    bars = [
        f'<div class="bar"><span>{escape(display_name(name))}</span>'
        f'<span class="track"><b style="width:{_percent(chance)}"></b></span><span>{chance:.0%}</span></div>'
        for name, chance in probabilities
    ]
    unlikely = [
        bar
        for bar, (_, chance) in zip(bars, probabilities, strict=True)
        if chance < _MIN_VISIBLE_CHANGE
    ]
    html = f'<div class="bars">{"".join(bar for bar in bars if bar not in unlikely)}</div>'
    if unlikely:
        html += f'<details><summary>{len(unlikely)} less likely</summary><div class="bars">{"".join(unlikely)}</div></details>'
    picked = 0.0 if decision.move is None else decision.pick_probabilities[decision.move.pick]
    if skipped := [name for name, chance in probabilities if chance > picked]:
        html += f'<p class="soft">Passed over, as there was no room for it: {escape(_display_names(skipped))}.</p>'
    html += f"<details><summary>What it knew</summary><p>{escape(_display_names(decision.considered))}.</p></details>"
    belief_text = f"it knew {len(decision.considered)} of {len(scene.objects)} objects, and found {len(found)} more by this move"
    return f"<h4>The agent's choice of what to pick; {belief_text}</h4>{html}"


def _visible_fractions_html(
    before: Mapping[str, float], after: Mapping[str, float], threshold: float, found: Sequence[str]
) -> str:
    """Bars of the visible shares: those that changed or are hidden, and the others below a fold."""
    shown: list[str] = []
    folded: list[str] = []
    for name, fraction_after in after.items():
        fraction_before = before[name]
        css_class = "found" if name in found else "hidden" if fraction_after < threshold else ""
        bar = (
            f'<div class="bar"><span>{escape(display_name(name))}</span>'
            f'<span class="track"><b class="{css_class}" style="width:{_percent(fraction_after)}"></b>'
            f'<u class="threshold" style="left:{_percent(threshold)}"></u>'
            f'<u class="before" style="left:calc({_percent(fraction_before)} - 1.5px)"></u></span>'
            f"<span>{fraction_before:.0%} &rarr; {fraction_after:.0%}</span></div>"
        )
        changed = abs(fraction_after - fraction_before) >= _MIN_VISIBLE_CHANGE
        if css_class or changed or fraction_before < threshold:
            shown.append(bar)
        else:
            folded.append(bar)
    html = (
        f'<div class="bars">{"".join(shown)}</div>'
        if shown
        else '<p class="soft">No share changed.</p>'
    )
    if shown:
        html += '<p class="soft">Bar: after; framed tick: before; dotted line: threshold.</p>'
    if folded:
        html += f'<details><summary>{len(folded)} unchanged, in view</summary><div class="bars">{"".join(folded)}</div></details>'
    return html


def _key_figures_html(
    objects: int, hidden: int, found: int, moves: int, summary: Mapping[str, Any]
) -> str:
    figures = {
        "objects": str(objects),
        "hidden_at_start": str(hidden),
        "found": f"{found} of {hidden}",
        "moves": str(moves),
    }
    for key, value in summary.items():
        if key not in figures and isinstance(value, str | int | float):
            figures[key] = _format_value(value)
    return "".join(
        f"<div><dt>{escape(display_name(key))}</dt><dd>{escape(text)}</dd></div>"
        for key, text in figures.items()
    )


def _format_value(value: str | int | float) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _legend_html() -> str:
    entries = "".join(
        f'<li><i class="{"dashed " if mark in _DASHED else ""}{_css_class(mark)}"></i>{text}</li>'
        for mark, text in _LEGEND.items()
    )
    return f'<ul class="legend" aria-label="Colours in the pictures">{entries}</ul>'


def _css_class(mark: Highlight) -> str:
    return mark.name.lower().replace("_", "-")


def _percent(fraction: float) -> str:
    return f"{100 * min(max(fraction, 0.0), 1.0):.1f}%"


def _visible_names(look: PerceptionResult) -> tuple[str, ...]:
    return tuple(detection.name for detection in look.observation.detections)


def _display_names(names: Sequence[str]) -> str:
    return ", ".join(display_name(name) for name in names)


def _move_text(move: Move) -> str:
    return f"{display_name(move.pick)} \N{RIGHTWARDS ARROW} {move.place if move.place == TRAY else display_name(move.place)}"


def _instability_text(instability: Instability) -> str:
    size = f"{1000 * instability.displacement:.0f} mm, {np.degrees(instability.tilt):.0f}\N{DEGREE SIGN}"
    return f"{display_name(instability.object)}: {instability.reason.value} ({size})"
