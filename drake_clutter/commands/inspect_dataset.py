"""What `drake-clutter inspect` does: figures, outliers and checks of a recorded data set."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_clutter.catalog import Catalog
from drake_clutter.files import InputError
from drake_clutter.recording.dataset_check import Problem, check_episode
from drake_clutter.recording.dataset_summary import (
    EpisodeFigures,
    attempted,
    count_reasons,
    count_results,
    find_outliers,
    motions,
    summarize_episode,
)
from drake_clutter.recording.hdf5_file import load_episode


@dataclass(frozen=True)
class Inspection:
    """Result of an inspection.

    Attributes:
        episodes: Figures of the episodes that can be read.
        problems: What is wrong.
        outliers: Moves that stand out, in words; they need not be wrong.
    """

    episodes: tuple[EpisodeFigures, ...]
    problems: tuple[Problem, ...]
    outliers: tuple[str, ...]


def inspect_files(files: Iterable[Path], catalog: Catalog) -> Inspection:
    """Return figures and problems of recorded episodes, which are read one after the other.

    Args:
        files: Files of the episodes.
        catalog: Catalog with the classes of the objects.
    """
    episodes = list[EpisodeFigures]()
    problems = list[Problem]()
    for file in files:
        try:
            episode = load_episode(file, catalog)
        except InputError as error:
            message = str(error).removeprefix(f"{file}").lstrip(":, ")
            problems.append(Problem(file.name, message))
            continue
        problems += check_episode(episode, file.name)
        episodes.append(summarize_episode(episode, file.name))
    problems += _check_agreement(episodes)
    return Inspection(tuple(episodes), tuple(problems), tuple(find_outliers(episodes)))


def _check_agreement(episodes: Sequence[EpisodeFigures]) -> list[Problem]:
    """Return the episodes whose cell, rate or seed differs from that of the first one."""
    problems = list[Problem]()
    for episode in episodes[1:]:
        for name in ("robot", "gripper", "joints", "rate", "seed"):
            value, first = getattr(episode, name), getattr(episodes[0], name)
            if value != first:
                text = f"{name} {value}; expected {first}, as in {episodes[0].source}"
                problems.append(Problem(episode.source, text))
                break
    return problems


def inspection_document(inspection: Inspection) -> dict[str, Any]:
    """Return an inspection as a JSON document."""
    episodes = inspection.episodes
    found = motions(episodes)
    return {
        "episodes": len(episodes),
        "attempted_moves": len(attempted(episodes)),
        "executed_moves": len(found),
        "results": dict(count_results(episodes).most_common()),
        "reasons": dict(count_reasons(episodes).most_common()),
        "terminations": dict(Counter(e.termination for e in episodes).most_common()),
        "picked_classes": dict(
            Counter(row.object_class for row in attempted(episodes)).most_common()
        ),
        "duration_s": _spread([row.duration for row in found]),
        "tool_path_m": _spread([row.path_length for row in found]),
        "largest_speed_ratio": _spread([max(row.speed_ratios) for row in found]),
        "largest_torque_ratio": _spread([max(row.torque_ratios) for row in found]),
        "samples": sum(row.num_samples for row in found),
        "images": sum(sum(row.num_images.values()) for row in found),
        "outliers": [*inspection.outliers],
        "problems": [str(problem) for problem in inspection.problems],
    }


def _spread(values: Sequence[float]) -> dict[str, float] | None:
    """Return median, smallest and largest of some values; None without any."""
    if not values:
        return None
    return {
        "median": float(np.median(values)),
        "min": float(np.min(values)),
        "max": float(np.max(values)),
    }


def describe_inspection(document: dict[str, Any]) -> dict[str, str]:
    """Return an inspection in words: texts by label."""
    spreads = {
        "duration": ("duration_s", " s"),
        "tool path": ("tool_path_m", " m"),
        "speed over limit": ("largest_speed_ratio", ""),
        "torque over limit": ("largest_torque_ratio", ""),
    }
    counts = {
        "results": "results",
        "without a plan": "reasons",
        "picked": "picked_classes",
        "ends": "terminations",
    }
    return {
        "episodes": str(document["episodes"]),
        "moves": f"{document['attempted_moves']} attempted, {document['executed_moves']} executed",
        "recorded": f"{document['samples']} samples, {document['images']} images",
        **{
            label: ", ".join(f"{n} {name}" for name, n in document[key].items()) or "none"
            for label, key in counts.items()
        },
        **{
            label: "{median:.3g}{unit} (median), {min:.3g} to {max:.3g}{unit}".format(
                **document[key], unit=unit
            )
            for label, (key, unit) in spreads.items()
            if document[key]
        },
        "outliers": str(len(document["outliers"])),
        "problems": str(len(document["problems"])),
    }
