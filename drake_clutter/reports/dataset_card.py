"""Card of a recorded data set: README.md, a contact sheet and figures."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import Catalog
from drake_clutter.files import write_text
from drake_clutter.recording.camera_recorder import (
    OBLIQUE,
    CameraChannel,
    CameraRecorder,
    find_cameras,
)
from drake_clutter.recording.dataset_check import find_episode_files
from drake_clutter.recording.dataset_summary import (
    EpisodeFigures,
    attempted,
    count_reasons,
    count_results,
    motions,
    summarize_episode,
)
from drake_clutter.recording.formats.dataset_format import DatasetFormat
from drake_clutter.recording.hdf5_file import load_episode
from drake_clutter.recording.randomization import Variation
from drake_clutter.recording.recorded_episode import RecordedEpisode
from drake_clutter.reports.contact_sheet import write_contact_sheet
from drake_clutter.reports.dataset_figures import plot_dataset
from drake_clutter.scenes.action_samples import ActionSamples
from drake_clutter.scenes.interfaces import MoveResult
from drake_clutter.statistics import wilson_interval

CARD_FILE = "README.md"
CONTACT_SHEET_FILE = "contact_sheet.png"
FIGURES_FILE = "figures.png"
NUM_THUMBNAILS = 24
"""Number of episodes of the contact sheet, evenly chosen."""
_VIEW_SIZE = (480, 480)
"""Width and height of the rendered views [px]: twice those of a thumbnail."""
_CONTENT = {
    DatasetFormat.HDF5: "`episodes/episode_NNNNNN.h5`: recorded episodes, HDF5 version 2",
    DatasetFormat.LEROBOT: "`meta`, `data`, `videos`: LeRobotDataset 3.0, an episode for each "
    "executed move",
    DatasetFormat.ROBOMIMIC: "`robomimic.hdf5`: a demonstration for each executed move",
    DatasetFormat.RERUN: "`rerun/episode_NNNNNN.rrd`: recordings for the Rerun viewer",
    DatasetFormat.MCAP: "`mcap/episode_NNNNNN.mcap`: recordings for Foxglove",
}
"""What a data set holds in each format."""


@dataclass(frozen=True)
class CardText:
    """What a card says besides its numbers.

    Attributes:
        title: Title.
        command: Command that made the data set.
        license: SPDX identifier of the data's license; "" if the maker has not chosen one.
    """

    title: str
    command: str
    license: str = ""


def write_card(
    out: Path,
    catalog: Catalog,
    formats: Sequence[DatasetFormat],
    text: CardText,
    *,
    progress: Callable[[Iterable[Path]], Iterable[Path]] = iter,
) -> None:
    """Write README.md, contact sheet and figures of a data set.

    Args:
        out: Folder of the data set, which holds at least one episode.
        catalog: Catalog with the classes of the objects.
        formats: Formats in which it was written besides HDF5.
        text: Title, command and license.
        progress: Wraps the files, which are read one after the other.
    """
    files = find_episode_files(out)
    episodes = list[EpisodeFigures]()
    thumbnails = list[tuple[NDArray[np.uint8], str, bool]]()
    chosen = np.linspace(0, len(files) - 1, min(len(files), NUM_THUMBNAILS)).round()
    shown = set(chosen.astype(int).tolist())
    for index, file in enumerate(progress(files)):
        episode = load_episode(file, catalog, images=index in shown)
        episodes.append(summarize_episode(episode, file.name))
        if index in shown and (thumbnail := _thumbnail(episode)) is not None:
            thumbnails.append(thumbnail)
    if thumbnails:
        write_contact_sheet(out / CONTACT_SHEET_FILE, thumbnails)
    plot_dataset(out / FIGURES_FILE, episodes)
    write_text(out / CARD_FILE, _card(episodes, formats, text))


def _thumbnail(episode: RecordedEpisode) -> tuple[NDArray[np.uint8], str, bool] | None:
    """Return image, caption and success of an episode: the middle of its first carry.

    It is a color image of a camera where one was recorded, else a view of the whole cell.

    Returns:
        None if no action was executed.
    """
    placed = sum(action.result is MoveResult.PLACED for action in episode.actions)
    caption = f"episode {episode.index}, {placed} of {len(episode.actions)} placed: "
    caption += episode.termination
    is_success = not any(action.result.ends_episode for action in episode.actions)
    for action in episode.actions:
        if action.samples is None:
            continue
        rows = np.flatnonzero(action.samples.held_object >= 0)
        row = int(rows[len(rows) // 2]) if len(rows) else len(action.samples) // 2
        for images in action.images.values():
            if images.rgb is not None and len(images.rgb):
                index = int(np.abs(images.time - action.samples.time[row]).argmin())
                return images.rgb[index], caption, is_success
        return _render(episode, action.samples, row), caption, is_success
    return None


def _render(episode: RecordedEpisode, samples: ActionSamples, row: int) -> NDArray[np.uint8]:
    """Return a view of the cell at a sample. Shape (height, width, 3)."""
    recorder = CameraRecorder(
        episode.cell,
        episode.initial_scene,
        find_cameras(episode.cell, [OBLIQUE], _VIEW_SIZE),
        [CameraChannel.RGB],
        Variation(),
        np.random.default_rng(0),
    )
    channels: dict[str, Any] = {
        name: values[row : row + 1] for name, values in samples.channels().items()
    }
    image = recorder.record(replace(samples, **channels), episode.rate)[OBLIQUE].rgb
    assert image is not None
    return np.asarray(image[0])


def _card(
    episodes: Sequence[EpisodeFigures], formats: Sequence[DatasetFormat], text: CardText
) -> str:
    """Return the text of the card."""
    rows = attempted(episodes)
    found = motions(episodes)
    placed = sum(row.result is MoveResult.PLACED for row in rows)
    low, high = wilson_interval(placed, len(rows)) if rows else (0.0, 1.0)
    first = episodes[0]
    seconds = sum(row.duration for row in found)
    images = Counter[str]()
    for row in found:
        images.update(row.num_images)
    facts = {
        "episodes": f"{len(episodes)}",
        "attempted moves": f"{len(rows)}",
        "executed moves": f"{len(found)}",
        "placed": f"{placed} ({_percent(placed, len(rows))}; 95 % interval "
        f"{100 * low:.1f} to {100 * high:.1f} %)",
        "recorded motion": f"{seconds / 60:.1f} min, {sum(r.num_samples for r in found)} samples",
        "rate": _list(f"{rate:g} Hz" for rate in sorted({e.rate for e in episodes})),
        "images": _list(f"{name}: {number}" for name, number in images.items()) or "none",
        "robot": _list(sorted({e.robot for e in episodes})),
        "gripper": _list(sorted({e.gripper for e in episodes})),
        "policy": _list(sorted({e.policy for e in episodes})),
        "scenes": f"{len({e.scene_name for e in episodes})}",
        "objects of a scene": _range([len(e.object_classes) for e in episodes]),
        "seed": _list(str(seed) for seed in sorted({e.seed for e in episodes})),
        "license": text.license or "not chosen; drake_clutter and its models: BSD-3-Clause",
        "versions": f"drake_clutter {first.versions[0]}, Drake {first.versions[1]}",
    }
    return "\n".join(
        [
            _front_matter(formats, text),
            f"# {text.title}",
            "",
            "Simulated pick-and-place moves of a robot arm in cluttered scenes, recorded with "
            "drake_clutter.",
            "",
            *([f"![Contact sheet]({CONTACT_SHEET_FILE})", ""] if found else []),
            *_table(("", ""), facts.items()),
            "",
            "## Content",
            "",
            *(f"- {_CONTENT[f]}" for f in dict.fromkeys((DatasetFormat.HDF5, *formats))),
            "",
            "Columns and units: `docs/reference/dataset_formats.md` of drake_clutter, and the "
            "attributes of the HDF5 files.",
            "",
            "## Results",
            "",
            *_count_table("result", count_results(episodes), len(rows)),
            "",
            "Moves without a plan:",
            "",
            *_count_table("reason", count_reasons(episodes), len(rows)),
            "",
            "Ends of episodes:",
            "",
            *_count_table("end", Counter(e.termination for e in episodes), len(episodes)),
            "",
            "## Objects",
            "",
            *_class_table(episodes),
            "",
            "## Motions",
            "",
            f"![Figures]({FIGURES_FILE})",
            "",
            *_table(("", "median", "smallest", "largest"), _motion_rows(episodes)),
            "",
            "## Reproduction",
            "",
            "```console",
            text.command,
            "```",
            "",
        ]
    )


def _front_matter(formats: Sequence[DatasetFormat], text: CardText) -> str:
    """Return the metadata by which the Hugging Face Hub lists and shows a data set."""
    is_lerobot = DatasetFormat.LEROBOT in formats
    lines = ["---", "task_categories:", "- robotics", "tags:", "- drake"]
    lines += ["- LeRobot"] if is_lerobot else []
    lines += [f"license: {text.license.lower()}"] if text.license else []
    if is_lerobot:
        lines += ["configs:", "- config_name: default", "  data_files: data/*/*.parquet"]
    return "\n".join([*lines, "---", ""])


def _class_table(episodes: Sequence[EpisodeFigures]) -> list[str]:
    """Return a table of the classes: in how many scenes, how often picked and placed."""
    objects = Counter(name for e in episodes for name in e.object_classes)
    rows = attempted(episodes)
    picked = Counter(row.object_class for row in rows)
    placed = Counter(row.object_class for row in rows if row.result is MoveResult.PLACED)
    header = ("class", "objects", "attempted moves", "placed")
    return _table(
        header, [(n, str(objects[n]), str(picked[n]), str(placed[n])) for n in sorted(objects)]
    )


def _motion_rows(episodes: Sequence[EpisodeFigures]) -> list[tuple[str, ...]]:
    """Return rows of quantities of the executed moves: name, median, smallest and largest."""
    found = motions(episodes)
    placed = [
        row.motion.place_error
        for row in attempted(episodes)
        if row.result is MoveResult.PLACED and row.motion is not None
    ]
    quantities = {
        "duration [s]": [row.duration for row in found],
        "path of the tool [m]": [row.path_length for row in found],
        "largest joint speed over its limit": [max(row.speed_ratios) for row in found],
        "largest joint torque over its limit": [max(row.torque_ratios) for row in found],
        "distance of a placed object from its place [mm]": [1000 * error for error in placed],
    }
    return [
        (name, *(f"{value:.3g}" for value in (np.median(v), np.min(v), np.max(v))))
        for name, v in quantities.items()
        if v
    ]


def _count_table(name: str, counts: Counter[str], total: int) -> list[str]:
    """Return a table of counts, the largest first."""
    if not counts:
        return ["None."]
    rows = [(key, str(n), _percent(n, total)) for key, n in counts.most_common()]
    return _table((name, "number", "share"), rows)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]


def _percent(part: int, total: int) -> str:
    """Return a share in percent."""
    return f"{100 * part / max(1, total):.1f} %"


def _list(names: Iterable[str]) -> str:
    """Return names separated by commas."""
    return ", ".join(names)


def _range(numbers: Sequence[int]) -> str:
    """Return the smallest and the largest of some numbers."""
    low, high = min(numbers), max(numbers)
    return f"{low}" if low == high else f"{low} to {high}"
