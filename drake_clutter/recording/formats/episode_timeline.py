"""The time line of an episode, and its events in words, for viewers."""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drake_clutter.recording.recorded_episode import RecordedAction, RecordedEpisode
from drake_clutter.scenes.action_samples import PHASES
from drake_clutter.scenes.interfaces import MoveResult

PAUSE = 1.0
"""Time before, between and after actions on the time line [s]."""
JPEG_QUALITY = 92
"""Quality of JPEG images, at which artifacts are hardly visible."""


class Severity(Enum):
    """Severity of an event.

    Attributes:
        INFO: The course of things.
        WARNING: A move that was not carried out, and changed nothing.
        ERROR: A move that failed.
    """

    INFO = "INFO"
    WARNING = "WARNING"
    ERROR = "ERROR"


@dataclass(frozen=True)
class Event:
    """Something that happened at a time.

    Attributes:
        time: Time on the time line of the episode [s].
        text: What happened.
        severity: Its severity.
    """

    time: float
    text: str
    severity: Severity


def start_times(episode: RecordedEpisode) -> list[float]:
    """Return the time of each action on the time line [s]; one without samples takes no time."""
    starts = list[float]()
    time = PAUSE
    for action in episode.actions:
        starts.append(time)
        time += _duration(action) + PAUSE
    return starts


def _duration(action: RecordedAction) -> float:
    """Return the duration of an action [s]."""
    return 0.0 if action.samples is None else float(action.samples.time[-1])


def events(episode: RecordedEpisode) -> Iterator[Event]:
    """Yield start, phases and result of each action, and the end of the episode, in order."""
    time = 0.0
    for number, (start, action) in enumerate(
        zip(start_times(episode), episode.actions, strict=True), start=1
    ):
        yield Event(start, f"{number}. {action.move}", Severity.INFO)
        if action.samples is not None:
            phase = action.samples.phase
            changes = np.flatnonzero(np.diff(phase, prepend=phase[0] - 1))
            for index in changes:
                if phase[index] >= 0:
                    at = start + float(action.samples.time[index])
                    yield Event(at, f"{number}. {PHASES[phase[index]]}", Severity.INFO)
        time = start + _duration(action)
        yield Event(time, f"{number}. {describe_result(action)}", _severity(action.result))
    yield Event(time + PAUSE, f"end: {episode.termination}", Severity.INFO)


def _severity(result: MoveResult) -> Severity:
    """Return the severity of a move's result."""
    if result is MoveResult.PLACED:
        return Severity.INFO
    return Severity.ERROR if result.was_executed else Severity.WARNING


def describe_result(action: RecordedAction) -> str:
    """Return the result of an action with its reasons, in one line."""
    notes = dict.fromkeys(
        note for note in (action.failure_reason, action.detail, action.instability) if note
    )
    return action.result.value + (f" ({'; '.join(notes)})" if notes else "")


def encode_jpeg(image: NDArray[np.uint8]) -> bytes:
    """Return a color image (height, width, 3) as a JPEG file."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "jpeg", quality=JPEG_QUALITY)
    return file.getvalue()
