"""Runs are resumed with their own configuration, extended, and keep their best checkpoint."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from torch import nn

from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.learning.training_run import CONFIG_FILE, TrainingRun
from training.training_loop import CheckpointSpec, train_to_end


@dataclass
class Config:
    """A configuration."""

    rate: float = 0.1


class NoLearner:
    """A learner that does nothing."""

    step = 0
    network = nn.Module()

    def save(self, path: Path) -> None:
        """See `Learner`."""
        path.touch()

    def load(self, path: Path) -> None:
        """See `Learner`."""


def test_another_config_or_input_file_is_rejected(tmp_path: Path) -> None:
    teacher, out = tmp_path / "teacher", tmp_path / "out"
    teacher.write_text("first")
    TrainingRun(out, Config(), NoLearner(), 1, [teacher]).save()
    assert str(teacher) in (out / CONFIG_FILE).read_text()
    TrainingRun(out, Config(), NoLearner(), 1, [teacher])
    with pytest.raises(InputError, match="another config or other files"):
        TrainingRun(out, Config(0.2), NoLearner(), 1, [teacher])
    teacher.write_text("second")
    with pytest.raises(InputError, match="another config or other files"):
        TrainingRun(out, Config(), NoLearner(), 1, [teacher])


@dataclass
class CountingConfig:
    """A configuration with a number of steps."""

    steps: int = 4
    rate: float = 0.1


class Counter:
    """A learner whose only weight is its number of steps."""

    def __init__(self) -> None:
        """Start at 0."""
        self.step = 0
        self.network = nn.Linear(1, 1, bias=False)

    def train_iteration(self) -> None:
        """Count a step."""
        self.step += 1
        with torch.no_grad():
            self.network.weight.fill_(self.step)

    def save(self, path: Path) -> None:
        """See `Learner`."""
        path.write_text(str(self.step))

    def load(self, path: Path) -> None:
        """See `Learner`."""
        self.step = int(path.read_text())


def train(out: Path, config: CountingConfig, max_minutes: float | None = None) -> list[int]:
    """Train to the end and return the evaluated steps; the evaluation at step 3 is the best."""
    learner = Counter()
    run = TrainingRun(out, config, learner, config.steps, steps_field="steps")
    train_to_end(
        run,
        learner,
        config.steps,
        CheckpointSpec("net.safetensors", {"kind": "test"}, lambda row: -abs(row["error"])),
        train_iteration=learner.train_iteration,
        evaluate=lambda: ({"error": float(learner.step - 3)}, {}),
        evaluate_every=1,
        save_every=2,
        max_minutes=max_minutes,
    )
    return [row["step"] for row in run.history]


def test_a_training_interrupts_itself_and_is_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train(out, CountingConfig(), max_minutes=0.0) == []
    assert "interrupted after 0 of 4 steps" in capsys.readouterr().out
    assert not (out / "net.safetensors").exists()
    assert train(out, CountingConfig(), max_minutes=60.0) == [1, 2, 3, 4]
    assert weight_and_step(out / "net.safetensors") == (4.0, 4)


def weight_and_step(path: Path) -> tuple[float, int]:
    checkpoint = load_checkpoint(path)
    return float(checkpoint.weights["weight"]), checkpoint.metadata["metrics"]["step"]


def test_the_best_checkpoint_is_kept_beside_the_last_and_a_run_is_extended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train(out, CountingConfig()) == [1, 2, 3, 4]
    printed = capsys.readouterr().err
    assert "0 of 4 steps: started" in printed
    assert printed.index("steps/s") < printed.index("error")  # before the first evaluation
    assert weight_and_step(out / "net.safetensors") == (4.0, 4)
    assert weight_and_step(out / "net_best.safetensors") == (3.0, 3)
    with pytest.raises(InputError, match="another config or other files"):
        train(out, CountingConfig(steps=3))
    with pytest.raises(InputError, match="another config or other files"):
        train(out, CountingConfig(steps=6, rate=0.2))
    assert train(out, CountingConfig(steps=6)) == [1, 2, 3, 4, 5, 6]
    assert "4 of 6 steps: resumed" in capsys.readouterr().err
    assert weight_and_step(out / "net.safetensors") == (6.0, 6)
    assert weight_and_step(out / "net_best.safetensors") == (3.0, 3)
    assert "steps: 6" in (out / CONFIG_FILE).read_text()
