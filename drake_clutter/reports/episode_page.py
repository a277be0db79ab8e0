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
from drake_clutter.reports.arm_pictures import arm_moments, strip
from drake_clutter.reports.detections_picture import detections_picture
from drake_clutter.reports.pictures import Mark, Marks, PictureCamera, humanised
from drake_clutter.reports.recording import episode_frames, write_recording
from drake_clutter.scenes.interfaces import Instability, Move, MoveResult
from drake_clutter.scenes.scene import TRAY, Pose, Scene
from drake_clutter.tasks.belief import Decision
from drake_clutter.tasks.exploration import Step

_TEMPLATE = Path(__file__).with_name("episode_page.html")
_IMAGES = "images"
_NOTICEABLE = 0.01
"""A visible share that changes by less goes below the fold."""
_LEGEND = {
    Mark.HIDDEN: "hidden, not found yet",
    Mark.FOUND: "newly found",
    Mark.MOVED: "moved, with the place it goes to",
    Mark.COVERED: "found before, now out of view",
    Mark.FALLEN: "did not stay",
    Mark.IN_VIEW: "in view, with the number of its name",
}
_DASHED = (Mark.HIDDEN, Mark.COVERED)
_BADGES = {MoveResult.PLACED: "good", MoveResult.COLLAPSED: "bad", MoveResult.DROPPED: "bad"}


def write_episode_page(
    out: Path,
    title: str,
    start: Scene,
    first_look: PerceptionResult,
    steps: Sequence[Step],
    summary: Mapping[str, Any],
    cell: WorkCell,
) -> None:
    """Writes `index.html`, `recording.html` and `images/*.png`; the page needs nothing else, and no network.

    Args:
        out: a folder that exists.
        title: heading of the page.
        start: the scene before the first move.
        first_look: what the camera showed of it.
        steps: the moves in order.
        summary: JSON values by key; the numbers, words and truth values among them become key figures.
        cell: in which the moves were made.
    """
    pictures = _Pictures(out)
    known = set(_in_view(first_look))
    hidden_at_start = [name for name in start.names if name not in known]
    start_html = _start(pictures, start, hidden_at_start)
    moves, scene, look = [], start, first_look
    for number, step in enumerate(steps, start=1):
        moves.append(_move(pictures, number, scene, look, step, frozenset(known), cell))
        known.update(step.newly_found)
        scene, look = step.outcome.scene, step.look
    write_recording(out / "recording.html", start, episode_frames(start, steps), cell)
    found = [name for name in hidden_at_start if name in known]
    page = Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=escape(title),
        marks="\n".join(f".{_css_class(mark)} {{ --mark: {mark.value}; }}" for mark in Mark),
        figures=_figures(len(start.objects), len(hidden_at_start), len(found), len(steps), summary),
        start=start_html,
        legend=_legend(),
        moves="\n".join(moves) or "<p>No move was made.</p>",
        summary=escape(json.dumps(summary, indent=2)),
    )
    write_text(out / "index.html", page)


class _Pictures:
    """Takes pictures and keeps them in the page's folder."""

    def __init__(self, out: Path) -> None:
        self.camera = PictureCamera()
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


def _start(pictures: _Pictures, start: Scene, hidden: Sequence[str]) -> str:
    above = pictures.camera.annotated(start, Marks(hidden=tuple(hidden)))
    listed = f"Hidden: {_listed(hidden)}." if hidden else "Nothing is hidden."
    return (
        '<div class="pair start">'
        + pictures.figure(
            "start_overhead",
            above,
            f"The tray from above at the start. {listed}",
            f"From above. {listed}",
        )
        + pictures.figure(
            "start_oblique",
            pictures.camera.oblique(start),
            "The tray from the front, at an angle",
            "At an angle.",
        )
        + "</div>"
    )


def _move(
    pictures: _Pictures,
    number: int,
    scene: Scene,
    look: PerceptionResult,
    step: Step,
    known: frozenset[str],
    cell: WorkCell,
) -> str:
    """One move's part of the page; `scene` and `look` are from before it, `known` is what had been found by then."""
    outcome, words = step.outcome, _move_in_words(step.move)
    before_view, after_view = _in_view(look), _in_view(step.look)
    unknown = tuple(name for name in scene.names if name not in known)
    covered = tuple(name for name in scene.names if name in known and name not in before_view)
    before = Marks(
        hidden=unknown, covered=covered, moved=step.move.pick, X_T_placed=_place(scene, step)
    )
    figures = pictures.figure(
        f"move_{number:02d}_before",
        pictures.camera.annotated(scene, before),
        f"The tray from above before move {number}: {words}. Hidden: {_listed(unknown) or 'nothing'}.",
        "Before, with the move.",
    )
    if outcome.result.was_executed:
        still_unknown = tuple(name for name in unknown if name not in step.newly_found)
        after = Marks(
            hidden=still_unknown,
            covered=tuple(
                name for name in scene.names if name not in still_unknown and name not in after_view
            ),
            found=step.newly_found,
            fallen=(outcome.instability.object,) if outcome.instability else (),
            moved=step.move.pick,
        )
        figures += pictures.figure(
            f"move_{number:02d}_after",
            pictures.camera.annotated(outcome.scene, after),
            f"The tray from above after move {number}. Newly found: {_listed(step.newly_found) or 'nothing'}.",
            "After.",
        )
    notes = [
        f"Newly found: <strong>{escape(_listed(step.newly_found))}</strong>."
        if step.newly_found
        else "Nothing newly found."
    ]
    notes.append(f"Reward {step.reward:+g}.")
    if outcome.instability:
        notes.append(f"{escape(_fall_in_words(outcome.instability))}.")
    if outcome.detail:
        notes.append(f"{escape(outcome.detail)}.")
    if step.decision.observation is not None:
        seen = step.decision.observation
        names = _listed([detection.object_class.name for detection in seen.detections])
        alt = f"The depth image before move {number}, with what was recognised in it: {names or 'nothing'}"
        caption = "What the camera measured before the move, brighter is higher, and what was recognised in it."
        figures += pictures.figure(
            f"move_{number:02d}_seen", detections_picture(seen), alt, caption
        )
    if outcome.motion and outcome.motion[0].arm:
        moments = arm_moments(outcome.motion, step.move.pick)
        alt = f"The arm in four moments of move {number}: before the lift, on the way, at the place, and when it has let go"
        figures += pictures.figure(
            f"move_{number:02d}_arm",
            strip(scene, moments, cell),
            alt,
            "The arm: lift, carry, place, retreat.",
        )
    badge = f'<span class="badge {_BADGES.get(outcome.result, "")}">{escape(outcome.result.value)}</span>'
    threshold = look.observation.camera.visibility_threshold
    return (
        f'<article><div class="head"><h3>{number}. {escape(words)}</h3>{badge}</div><p>{" ".join(notes)}</p>'
        f'<div class="pair">{figures}</div>'
        f"{_beliefs(step.decision, scene, step.newly_found)}"
        f"<h4>Visible share of each object, before &rarr; after (hidden below {threshold:.0%})</h4>"
        f"{_shares(look.visible_fractions, step.look.visible_fractions, threshold, step.newly_found)}</article>"
    )


def _place(scene: Scene, step: Step) -> Pose | None:
    """Where the picked object was let go; of a move that was not carried out, above the object it was meant for."""
    if step.outcome.result.was_executed:
        return step.outcome.X_TO_released or step.outcome.scene[step.move.pick].X_TO
    return (
        None
        if step.move.place == TRAY
        else Pose(scene[step.move.place].X_TO.translation, scene[step.move.pick].X_TO.quaternion)
    )


def _beliefs(decision: Decision, scene: Scene, found: Sequence[str]) -> str:
    """What the agent went by: how likely it was to pick each object, the likeliest first, and what it knew."""
    if not decision.picks:
        return ""
    likeliest = sorted(decision.picks.items(), key=lambda item: -item[1])
    bars = [
        f'<div class="bar"><span>{escape(humanised(name))}</span>'
        f'<span class="track"><b style="width:{_percent(chance)}"></b></span><span>{chance:.0%}</span></div>'
        for name, chance in likeliest
    ]
    unlikely = [
        bar for bar, (_, chance) in zip(bars, likeliest, strict=True) if chance < _NOTICEABLE
    ]
    html = f'<div class="bars">{"".join(bar for bar in bars if bar not in unlikely)}</div>'
    if unlikely:
        html += f'<details><summary>{len(unlikely)} less likely</summary><div class="bars">{"".join(unlikely)}</div></details>'
    picked = 0.0 if decision.move is None else decision.picks[decision.move.pick]
    if no_room := [name for name, chance in likeliest if chance > picked]:
        html += f'<p class="soft">Passed over, as there was no room for it: {escape(_listed(no_room))}.</p>'
    html += f"<details><summary>What it knew</summary><p>{escape(_listed(decision.known))}.</p></details>"
    what = f"it knew {len(decision.known)} of {len(scene.objects)} objects, and found {len(found)} more by this move"
    return f"<h4>The agent's choice of what to pick; {what}</h4>{html}"


def _shares(
    before: Mapping[str, float], after: Mapping[str, float], threshold: float, found: Sequence[str]
) -> str:
    """Bars of the visible shares: those that changed or are hidden, and the others below a fold."""
    shown: list[str] = []
    folded: list[str] = []
    for name, share in after.items():
        was = before[name]
        kind = "found" if name in found else "hidden" if share < threshold else ""
        bar = (
            f'<div class="bar"><span>{escape(humanised(name))}</span>'
            f'<span class="track"><b class="{kind}" style="width:{_percent(share)}"></b>'
            f'<u class="threshold" style="left:{_percent(threshold)}"></u>'
            f'<u class="before" style="left:calc({_percent(was)} - 1.5px)"></u></span>'
            f"<span>{was:.0%} &rarr; {share:.0%}</span></div>"
        )
        (shown if kind or was < threshold or abs(share - was) >= _NOTICEABLE else folded).append(
            bar
        )
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


def _figures(objects: int, hidden: int, found: int, moves: int, summary: Mapping[str, Any]) -> str:
    figures = {
        "objects": str(objects),
        "hidden_at_start": str(hidden),
        "found": f"{found} of {hidden}",
        "moves": str(moves),
    }
    for key, value in summary.items():
        if key not in figures and isinstance(value, str | int | float):
            figures[key] = _in_words(value)
    return "".join(
        f"<div><dt>{escape(humanised(key))}</dt><dd>{escape(text)}</dd></div>"
        for key, text in figures.items()
    )


def _in_words(value: str | int | float) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _legend() -> str:
    entries = "".join(
        f'<li><i class="{"dashed " if mark in _DASHED else ""}{_css_class(mark)}"></i>{text}</li>'
        for mark, text in _LEGEND.items()
    )
    return f'<ul class="legend" aria-label="Colours in the pictures">{entries}</ul>'


def _css_class(mark: Mark) -> str:
    return mark.name.lower().replace("_", "-")


def _percent(share: float) -> str:
    return f"{100 * min(max(share, 0.0), 1.0):.1f}%"


def _in_view(look: PerceptionResult) -> tuple[str, ...]:
    return tuple(detection.name for detection in look.observation.detections)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(humanised(name) for name in names)


def _move_in_words(move: Move) -> str:
    return f"{humanised(move.pick)} \N{RIGHTWARDS ARROW} {move.place if move.place == TRAY else humanised(move.place)}"


def _fall_in_words(instability: Instability) -> str:
    size = f"{1000 * instability.displacement:.0f} mm, {np.degrees(instability.tilt):.0f}\N{DEGREE SIGN}"
    return f"{humanised(instability.object)}: {instability.reason.value} ({size})"
