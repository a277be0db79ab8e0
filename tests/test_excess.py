"""Sizes beyond their bounds, training that diverges, and inputs of the wrong kind are refused."""

from pathlib import Path

import pytest
import torch
from test_damaged_files import image_dataset
from torch import nn
from typer.testing import CliRunner

from drake_clutter.agents.learned_generator import load_generator_checkpoint
from drake_clutter.cli import app
from drake_clutter.files import MAX_ERROR_LENGTH, InputError
from drake_clutter.grammar import NodeBudget
from drake_clutter.learning.training_run import TrainingRun
from drake_clutter.limits import MAX_SEED
from drake_clutter.resources import resource_path
from drake_clutter.systems.scenario import Scenario
from drake_clutter.tasks.generation_task import GenerationTaskConfig
from drake_clutter.validation import load_config_as
from training import train_detector
from training.training_loop import CheckpointSpec, train_to_end


class DivergingLearner:
    """A learner whose weight becomes NaN at step 3."""

    def __init__(self) -> None:
        self.step = 0
        self.network = nn.Linear(1, 1)

    def train_iteration(self) -> None:
        """Make a step."""
        self.step += 1
        if self.step == 3:
            self.network.weight.data.fill_(torch.nan)

    def save(self, path: Path) -> None:
        """See `Learner`."""
        path.write_text(str(self.step))

    def load(self, path: Path) -> None:
        """See `Learner`."""
        self.step = int(path.read_text())


def test_a_diverging_training_names_the_step_and_keeps_the_last_state(tmp_path: Path) -> None:
    learner = DivergingLearner()
    run = TrainingRun(tmp_path / "run", GenerationTaskConfig(), learner, 5)
    with pytest.raises(InputError, match=r"step 3: weights NaN .*of an earlier step is kept"):
        train_to_end(
            run,
            learner,
            5,
            CheckpointSpec("network.safetensors", {"kind": "test"}, lambda row: -row["loss"]),
            train_iteration=learner.train_iteration,
            evaluate=lambda: ({}, {"loss": 0.5}),
            evaluate_every=1,
            save_every=1,
        )
    assert (tmp_path / "run" / "state.safetensors").read_text() == "2"
    assert [row["step"] for row in run.history] == [1, 2]


def test_a_loss_that_is_infinite_is_a_divergence(tmp_path: Path) -> None:
    run = TrainingRun(tmp_path / "run", GenerationTaskConfig(), DivergingLearner(), 5)
    with pytest.raises(InputError, match=r"step 0: loss NaN or infinite.*no state is saved"):
        run.report({"score": 0.5}, {"loss": float("inf")})
    assert not (tmp_path / "run" / "history.json").exists()


def test_too_many_nodes_are_refused() -> None:
    with pytest.raises(InputError, match=r"nodes: 400; expected 3 .* up to 200"):
        NodeBudget(400)


@pytest.mark.parametrize("seed", ["-1", str(2**63), str(10**30)])
def test_seeds_out_of_range_are_refused(seed: str) -> None:
    with pytest.raises(InputError, match=r"seed: .*expected a whole number from 0 to"):
        load_config_as(Scenario(), settings=[f"seed={seed}"])
    result = CliRunner().invoke(app, ["solve", "scene.yaml", "--out", "x", "--seed", seed])
    assert result.exit_code == 2


def test_the_largest_seed_is_accepted() -> None:
    assert load_config_as(Scenario(), settings=[f"seed={MAX_SEED}"]).seed == MAX_SEED


def test_a_warm_start_of_another_kind_is_refused() -> None:
    path = resource_path("training/checkpoints/student.safetensors")
    with pytest.raises(InputError, match=r"another kind \(student\); expected a generator"):
        load_generator_checkpoint(path)


def test_messages_are_one_line_of_bounded_length() -> None:
    message = str(InputError("scene.yaml: " + "long\nlines " * 500 + "; expected a scene"))
    assert message.isprintable()
    assert len(message) <= MAX_ERROR_LENGTH
    assert message.startswith("scene.yaml: ")
    assert message.endswith("; expected a scene")


@pytest.mark.parametrize("held_out", [1, 200])
def test_more_held_out_images_than_there_are_are_refused(held_out: int, tmp_path: Path) -> None:
    images = tmp_path / "images"
    image_dataset(images)
    settings = [f"images={images}", f"held_out={held_out}"]
    with pytest.raises(
        InputError, match=rf"held_out: {held_out}; expected fewer than the 1 images of {images}"
    ):
        train_detector.main(tmp_path / "run", settings=settings)
    assert not (tmp_path / "run").exists()
