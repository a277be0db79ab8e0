"""What every training script does around its learning: a folder with config, history, curves and state, taken up after a kill."""

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from rich.console import Console
from torch import nn
from torch.utils.tensorboard import SummaryWriter

from drake_clutter.files import (
    InputError,
    file_sha256,
    prepare_output_directory,
    write_json,
    write_text,
)
from drake_clutter.learning.checkpoint import save_checkpoint
from drake_clutter.resources import git_commit
from drake_clutter.validation import config_yaml, to_plain

CONFIG, STATE, HISTORY, TENSORBOARD = (
    "config.yaml",
    "state.safetensors",
    "history.json",
    "tensorboard",
)


class Learner(Protocol):
    """What learns; `step` counts what the config's number of steps is reached in."""

    step: int

    def save(self, path: Path) -> None:
        """Writes all that is needed to go on as if it had never been interrupted."""

    def load(self, path: Path) -> None:
        """Goes on where `save` was called."""


class TrainingRun:
    """A run in a folder.

    Attributes:
        history: a row for each evaluation.
    """

    def __init__(
        self, out: Path, config: Any, learner: Learner, steps: int, files: Sequence[Path] = ()
    ) -> None:
        """Begins a run, or takes up the one that is in the folder.

        Args:
            out: the folder; config: a dataclass; learner: as it begins; steps: at which it ends.
            files: that the config names and the run learns from; must be the same when it is taken up.

        Raises:
            InputError: the folder holds something else, or a run of another config or of other files.
        """
        self._out, self._config, self._learner, self._steps = out, config, learner, steps
        self._files = {str(file): file_sha256(file) for file in files}
        told = config_yaml(config) + "".join(
            f"# {file}: sha256 {digest}\n" for file, digest in self._files.items()
        )
        if not (out / CONFIG).exists():
            prepare_output_directory(out)
            write_text(out / CONFIG, told)
        elif (out / CONFIG).read_text() != told:
            raise InputError(
                f"--out {out}: holds a run of another config or other files, see {CONFIG}; give the same ones or another folder"
            )
        self.history: list[dict[str, Any]] = []
        if (out / STATE).exists():
            learner.load(out / STATE)
            rows = json.loads((out / HISTORY).read_text()) if (out / HISTORY).exists() else []
            self.history = [row for row in rows if row["step"] <= learner.step]
        self._console = Console(stderr=True)
        self._writer = SummaryWriter(str(out / TENSORBOARD), purge_step=learner.step)
        self._seconds = self.history[-1]["seconds"] if self.history else 0.0
        self._begun, self._begun_at = time.monotonic(), learner.step

    def report(self, charts: Mapping[str, float], losses: Mapping[str, float]) -> None:
        """Notes an evaluation: in the history, as curves, and on the screen."""
        step, spent = self._learner.step, time.monotonic() - self._begun
        rate = (step - self._begun_at) / spent if step > self._begun_at else 0.0
        row = {
            "step": step,
            "seconds": self._seconds + spent,
            "commit": git_commit(),
            **losses,
            **charts,
        }
        self.history.append(row)
        write_json(self._out / HISTORY, self.history)
        for folder, values in (
            ("charts", {**charts, "steps_per_second": rate}),
            ("losses", losses),
        ):
            for name, value in values.items():
                self._writer.add_scalar(f"{folder}/{name}", value, step)
        left = (self._steps - step) / rate / 60 if rate else float("nan")
        told = ", ".join(f"{name} {value:.3g}" for name, value in {**charts, **losses}.items())
        self._console.print(
            f"{step:>7} of {self._steps}: {told}; {rate:.0f} steps/s, {left:.0f} min left",
            highlight=False,
            soft_wrap=True,
        )

    def save(self) -> None:
        """Writes the state."""
        self._learner.save(self._out / STATE)

    def finish(self, name: str, network: nn.Module, about: Mapping[str, Any]) -> None:
        """Writes the checkpoint, with config, hashes of files, last figures and commits, and the state."""
        metrics, commits = (
            self.history[-1],
            list(dict.fromkeys(row["commit"] for row in self.history)),
        )
        save_checkpoint(
            self._out / name,
            network,
            {
                **about,
                "config": to_plain(self._config),
                "files": self._files,
                "metrics": metrics,
                "commits": commits,
            },
        )
        self.save()


def device_of(name: str) -> torch.device:
    """The device of an option: auto, cpu or cuda.

    Raises:
        InputError: another name, or a device that is not there.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {name}; allowed are auto, cpu, cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: PyTorch finds none; allowed here are auto, cpu")
    return torch.device(
        ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name
    )
