"""Damaged files of every kind are read, or refused in one line that names the file.

Each reader reads seeded mutants of valid files: cut off, with changed bytes, or with fields that
are missing, duplicated, of another type, NaN, huge or deeply nested. `DAMAGED_FILES=2000` sets the
number of mutants of each reader, for a long run:

    DAMAGED_FILES=2000 python -m pytest tests/test_damaged_files.py
"""

import copy
import gzip
import json
import math
import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import trimesh
import yaml
from conftest import DEFAULT_CELL, TRAY, rng
from feasibility_jobs import feasibility_job
from PIL import Image
from pydrake.systems.framework import DiagramBuilder
from recorded_episodes import synthetic_episode
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from test_collision_filters import arm
from test_inverse_reachability import Arm, disk_map, move_rows, reaches
from test_mesh_file import write_cube_with_seams
from test_scene_file import DOCUMENT
from test_scene_file_fuzzed import SCENARIO, places
from test_station_simulation import STATIC

from drake_clutter.agents.behavior_cloning import BehaviorCloningConfig, BehaviorCloningLearner
from drake_clutter.agents.episode_evaluation import EpisodeResult
from drake_clutter.agents.explorer_network import ExplorerNetwork
from drake_clutter.agents.learned_explorer import STUDENT, LearnedExplorerFactory, explorer_metadata
from drake_clutter.agents.learned_generator import (
    LearnedGenerator,
    load_generator_checkpoint,
    load_rule_network,
    rule_network_metadata,
)
from drake_clutter.agents.ppo import PPOConfig, PPOLearner
from drake_clutter.agents.soft_q import SoftQConfig, SoftQLearner
from drake_clutter.assets import build_assets
from drake_clutter.assets.mesh_appearance import textured_parts
from drake_clutter.assets.textured_mesh import gltf_text
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.commands.explore_scene import read_moves
from drake_clutter.commands.feasibility_job import read_targets
from drake_clutter.commands.feasibility_parts import PartKind, StudyPart, load_part
from drake_clutter.commands.generate_scenes import read_generation_progress
from drake_clutter.commands.inspect_dataset import (
    describe_inspection,
    inspect_files,
    inspection_document,
)
from drake_clutter.commands.job_file import JOB_FILE, open_job_folder
from drake_clutter.commands.record_dataset import read_summary, summarize_dataset
from drake_clutter.config import ClutterConfig, ExplorationConfig, upgrade_config
from drake_clutter.feasibility.inverse_reachability import (
    load_inverse_reachability,
    save_inverse_reachability,
)
from drake_clutter.feasibility.move_study import MoveRecord
from drake_clutter.feasibility.pose_noise import NoiseRecord
from drake_clutter.feasibility.sequences import SequenceRecord
from drake_clutter.files import MAX_ERROR_LENGTH, InputError, write_json
from drake_clutter.grammar import SceneGrammar
from drake_clutter.learning.checkpoint import save_checkpoint
from drake_clutter.learning.training_run import TrainingRun
from drake_clutter.mesh_file import load_object_mesh
from drake_clutter.perception.image_dataset import (
    AnnotatedImage,
    ImageDataset,
    LabeledImage,
    _read_cameras,
    _read_infos,
    _read_poses,
    write_images,
)
from drake_clutter.perception.segmentation import CHECKPOINT_KIND, SegmentationNetwork
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.recording.dataset_check import find_episode_files
from drake_clutter.recording.hdf5_file import load_episode, save_episode
from drake_clutter.recording.randomization import (
    RANDOMIZATION_GROUPS,
    RandomizationConfig,
    load_randomization,
)
from drake_clutter.records import read_jsonl, resume_jsonl, write_jsonl
from drake_clutter.resources import resource_path
from drake_clutter.robots.model_parsing import read_model_text, read_torque_limits
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.scene import Pose
from drake_clutter.scenes.scene_dataset import _digest, load_scene_dataset
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.simulation.scene_plant import add_scene_plant
from drake_clutter.systems.scenario import Scenario
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.generation_task import ClutterGeneration, GenerationTaskConfig
from drake_clutter.validation import load_config_as, override_config, to_plain
from drake_clutter.visual_mesh import check_visual_mesh
from drake_clutter.yaml_io import to_yaml
from training.episode_files import EpisodeRecord
from training.reaching_policy import ReachingPolicy
from training.results_file import ResultsFile
from training.target_set import TargetPair, load_target_set, save_target_set

NUM_MUTANTS = int(os.environ.get("DAMAGED_FILES", "100"))
"""Number of mutants of each reader."""
CPU = torch.device("cpu")
CATALOG = load_catalog()
DATASET = resource_path("training/scenes/sg_star_10.json")
YCB_GRAMMAR = SceneGrammar(CATALOG.object_set("ycb7"))


@dataclass(frozen=True)
class Reader:
    """A reader and valid files that it reads.

    Attributes:
        files: The files, each of which is damaged in turn.
        read: Reads all files.
    """

    files: Sequence[Path]
    read: Callable[[], object]


# --- Mutants ---

DEEP = 100_000
"""Depth of nesting at which parsers without a limit exhaust the stack."""
STRANGE_VALUES: list[Any] = [
    *(None, True, False, 0, -1, 7, 10**9, 2**63, 10**40, 0.5, -0.0, 1e308, -1e308, 1e-320),
    *(math.nan, math.inf, -math.inf, "", "tray", "end", "\0", "x" * 3000, "é\n" * 50),
    *([], {}, [[]], [1, 2, 3], [1, 0, 0, 0], [math.nan] * 7, [None], {"a": 1}, [[[[[[1]]]]]]),
]


def mutate_document(original: Any, generator: np.random.Generator) -> Any:
    """Return a document with one to three fields changed, missing or added."""
    document: Any = copy.deepcopy(original)
    for _ in range(int(generator.integers(1, 4))):
        paths = list(places(document))
        if not paths:
            break
        path = paths[int(generator.integers(len(paths)))]
        owner: Any = document
        for part in path[:-1]:
            owner = owner[part]
        key: Any = path[-1]
        action = generator.integers(4)
        if action == 0:
            del owner[key]
        elif action == 1 and isinstance(owner, list):
            owner.append(copy.deepcopy(owner[key]))
        elif action == 1:
            owner[f"{key}_2"] = copy.deepcopy(owner[key])
        else:
            value = STRANGE_VALUES[int(generator.integers(len(STRANGE_VALUES)))]
            owner[key] = copy.deepcopy(value)
    return document


def mutate_bytes(data: bytes, generator: np.random.Generator) -> bytes:
    """Return bytes that are cut off, or of which some are changed, removed or inserted."""
    action = generator.integers(5)
    at = int(generator.integers(len(data) + 1))
    size = int(generator.integers(1, 64))
    if action == 0:
        return data[:at]
    if action == 1:
        return data[:at] + data[at + size :]
    if action == 2:
        return data[:at] + generator.bytes(size) + data[at:]
    changed = bytearray(data)
    # The beginning of a file often decides how the remaining bytes are read.
    end = len(data) if action == 3 else min(len(data), 400)
    for k in generator.integers(end, size=int(generator.integers(1, 9))):
        changed[k] ^= 1 << int(generator.integers(8))
    return bytes(changed)


def mutate_json_text(text: str, generator: np.random.Generator) -> str:
    """Return a JSON text with a duplicate key, too many digits or deep nesting."""
    action = generator.integers(4)
    first = text.find('"')
    key = text[first : text.find('"', first + 1) + 1]
    if action == 0:
        return text.replace("{", f"{{{key}: 1, {key}: 2, ", 1)
    if action == 1:
        return text.replace(": ", f": {'9' * 5000}, {key}: ", 1)
    if action == 2:
        return "[" * DEEP + "]" * DEEP
    return text.replace(": ", ": " + '{"a":' * DEEP + "1" + "}" * DEEP + f", {key}: ", 1)


def damage(path: Path, generator: np.random.Generator) -> None:
    """Damage a file."""
    data = path.read_bytes()
    structured = generator.random() < 0.6
    if structured and path.suffix == ".json":
        text = data.decode()
        document = mutate_document(json.loads(text), generator)
        if isinstance(document, dict) and "sha256" in document and generator.random() < 0.8:
            entries = "pairs" if "pairs" in document else "scenes"
            head = {k: v for k, v in document.items() if k not in (entries, "sha256")}
            document["sha256"] = _digest(head, document.get(entries, []))
        many = generator.random() < 0.1
        path.write_text(mutate_json_text(text, generator) if many else json.dumps(document))
    elif structured and path.suffix == ".yaml":
        document = mutate_document(yaml.safe_load(data), generator)
        path.write_text(yaml.dump(document, sort_keys=False), encoding="utf-8")
    elif structured and path.suffix == ".h5":
        damage_hdf5(path, generator)
    elif structured and path.suffix == ".npz":
        damage_archive(path, generator)
    elif structured and path.suffix == ".safetensors":
        damage_tensors(path, generator)
    elif structured and path.suffix == ".gz":
        lines = gzip.decompress(data).decode().splitlines()
        k = int(generator.integers(len(lines)))
        lines[k] = json.dumps(mutate_document(json.loads(lines[k]), generator))
        if generator.random() < 0.3:
            lines[k] = mutate_bytes(lines[k].encode(), generator).decode(errors="replace")
        path.write_bytes(gzip.compress("\n".join([*lines, ""]).encode()))
    else:
        path.write_bytes(mutate_bytes(data, generator))


def damage_hdf5(path: Path, generator: np.random.Generator) -> None:
    """Change, replace or remove an attribute or a dataset of an HDF5 file."""
    with h5py.File(path, "r+") as file:
        owners = [file, *(file[name] for name in file)]
        owner = owners[int(generator.integers(len(owners)))]
        if len(owner.attrs) and (not len(owner) or generator.random() < 0.5):
            name = str(generator.choice(sorted(owner.attrs)))
            value = owner.attrs[name]
            del owner.attrs[name]
            choices: list[Any] = [
                *(1, -1.5, math.nan, 2**62, np.zeros((2, 2)), np.zeros(0), b"\xff\xfe"),
                *("", "{", "[" * 2000, "objects: 3", f"{value}\nversion: 9", h5py.Empty("f")),
            ]
            k = int(generator.integers(len(choices) + 1))
            if k < len(choices):
                owner.attrs[name] = choices[k]
            return
        name = str(generator.choice(sorted(owner)))
        values = owner[name][()] if isinstance(owner[name], h5py.Dataset) else np.zeros(3)
        del owner[name]
        changes: list[Any] = [
            *(values[:-1], values[:, None], values.astype("S4"), np.zeros(()), h5py.Empty("f")),
            *(np.full(values.shape, np.nan), np.full(values.shape, 1e300), np.zeros(values.shape)),
            *(values.astype(complex), "text"),
        ]
        k = int(generator.integers(len(changes) + 3))
        if k < len(changes):
            owner[name] = changes[k]
        elif k == len(changes):
            owner.create_group(name)
        elif k == len(changes) + 1:
            shape = (10**9, *values.shape[1:])
            owner.create_dataset(name, shape, values.dtype, chunks=True)


def damage_archive(path: Path, generator: np.random.Generator) -> None:
    """Change, replace or remove an array of a NumPy archive."""
    with np.load(path) as archive:
        arrays = dict(archive)
    name = str(generator.choice(sorted(arrays)))
    values = arrays.pop(name)
    changes = [
        *(values[:-1], values[None], np.zeros((2, 3)), np.zeros(0), values.astype("S4")),
        *(values.astype(float) * np.nan, np.full(values.shape, 10**6), values.astype(np.int8)),
        np.full(values.shape, -7).astype(values.dtype),
    ]
    k = int(generator.integers(len(changes) + 1))
    if k < len(changes):
        arrays[name] = changes[k]
    np.savez(path, **arrays)


def damage_tensors(path: Path, generator: np.random.Generator) -> None:
    """Change, replace or remove a tensor or a field of the state in a safetensors file."""
    tensors = load_file(path)
    with safe_open(path, "pt") as file:
        metadata = dict(file.metadata() or {})
    if metadata and generator.random() < 0.5:
        state = mutate_document(json.loads(metadata["state"]), generator)
        metadata = {"state": json.dumps(state)} if generator.random() < 0.9 else {"other": ""}
    else:
        name = str(generator.choice(sorted(tensors)))
        value = tensors.pop(name)
        changes = [
            *(value.flatten()[:-1].clone(), value[None].clone(), torch.zeros(3, 0)),
            *(torch.full_like(value.float(), math.nan), torch.full_like(value.float(), 1e38)),
            *(value.to(torch.int8), value.double(), torch.zeros((), dtype=torch.bool)),
        ]
        k = int(generator.integers(len(changes) + 2))
        if k < len(changes):
            tensors[name] = changes[k]
        elif k == len(changes):
            tensors[f"{name}.more"] = value
    save_file(tensors, path, metadata=metadata)


# --- Readers ---


def scene_file(folder: Path) -> Reader:
    path = folder / "scene.yaml"
    path.write_text(to_yaml(DOCUMENT))
    return Reader([path], lambda: load_scene(path, CATALOG))


def config_file(folder: Path) -> Reader:
    path = folder / "config.yaml"
    path.write_text(to_yaml(SCENARIO))
    return Reader([path], lambda: load_config_as(Scenario(), path, upgrade=upgrade_config))


def cell_file(folder: Path) -> Reader:
    path = folder / "cell.yaml"
    path.write_text(to_yaml(to_plain(DEFAULT_CELL)))
    return Reader([path], lambda: load_cell(path))


def generator_checkpoint(folder: Path) -> Reader:
    path = folder / "generator.safetensors"
    metadata = {
        "kind": "generator",
        "network": rule_network_metadata(YCB_GRAMMAR, 8),
        "temperature": 0.25,
        "config": {"task": to_plain(GenerationTaskConfig())},
    }
    environment = ClutterGeneration(task=GenerationTaskConfig(nodes=6))
    learner = SoftQLearner(lambda: environment, SoftQConfig(width=8, num_envs=1), 0, CPU)
    save_checkpoint(path, learner.network, metadata)

    def read() -> None:
        LearnedGenerator(path, ClutterConfig())
        load_rule_network(load_generator_checkpoint(path), YCB_GRAMMAR)

    return Reader([path, path.with_suffix(".json")], read)


def explorer_checkpoint(folder: Path) -> Reader:
    path = folder / "explorer.safetensors"
    kinds = {"tray": 1, "cracker_box": 2, "sugar_box": 3}
    metadata = {"kind": STUDENT, "network": explorer_metadata(kinds, 8)}
    save_checkpoint(path, ExplorerNetwork(len(kinds), 8), metadata)
    return Reader(
        [path, path.with_suffix(".json")],
        lambda: LearnedExplorerFactory(path, ExplorationConfig(), ["sugar_box"]),
    )


def detector_checkpoint(folder: Path) -> Reader:
    path = folder / "detector.safetensors"
    metadata = {"kind": CHECKPOINT_KIND, "classes": ["sugar_box"], "use_color": False}
    save_checkpoint(path, SegmentationNetwork(["sugar_box"], False), metadata)
    return Reader([path, path.with_suffix(".json")], lambda: SegmentationNetwork.load(path))


def trajectory_file(folder: Path) -> Reader:
    path = folder / "trajectory.h5"
    path.write_bytes((Path(__file__).parent / "data/trajectory_v1.h5").read_bytes())
    return Reader([path], lambda: load_episode(path, CATALOG))


def recorded_episode(folder: Path) -> Reader:
    path = folder / "episode.h5"
    save_episode(path, synthetic_episode(rate=10.0, cameras={"overhead": 10}))
    return Reader([path], lambda: load_episode(path, CATALOG))


def recorded_dataset(folder: Path) -> Reader:
    """Return what reads a data set to check it, to summarize it and to go on with it."""
    path = folder / "episodes" / "episode_000000.h5"
    path.parent.mkdir()
    save_episode(path, synthetic_episode(rate=10.0))

    def read() -> None:
        inspection = inspect_files(find_episode_files(folder), CATALOG)
        describe_inspection(inspection_document(inspection))
        for problem in inspection.problems:
            raise InputError(f"{folder}: {problem}")
        summarize_dataset([read_summary(path)])

    return Reader([path], read)


def lists_of_options(folder: Path) -> Reader:
    """Return what reads the files of `--moves`, `--policy` and `--randomize`."""
    moves, randomization = folder / "moves.yaml", folder / "randomization.yaml"
    moves.write_text(to_yaml([{"pick": "a", "place": "tray"}, {"pick": "b", "place": "0.1,0,0,0"}]))
    fields = {
        name: value for group in RANDOMIZATION_GROUPS.values() for name, value in group.items()
    }
    randomization.write_text(to_yaml(to_plain(RandomizationConfig(**fields))))

    def read() -> None:
        read_moves(moves)
        load_randomization(str(randomization))

    return Reader([moves, randomization], read)


def reachability_map(folder: Path) -> Reader:
    """Return what reads and asks the inverse reachability map of a study that goes on."""
    path = folder / "map.npz"
    whole = disk_map(0.45)
    part = {name: getattr(whole, name)[:9, :6] for name in ("solutions", "lowest", "turns")}
    small = replace(whole, heights=whole.heights[:6], arm=Arm().geometry, **part)
    save_inverse_reachability(path, small)
    moves = move_rows((0.3, 0.0, 0.1), (0.3, 0.4, 0.2), 0.4)

    def read() -> None:
        reaches(load_inverse_reachability(path), moves, [[0.0, 0.2, 0.0, 0.0]], -1.0)

    return Reader([path], read)


def exploration() -> ClutterExploration:
    scenes = load_scene_dataset(DATASET, CATALOG)
    return ClutterExploration(
        replace(scenes, scenes=scenes.scenes[:2]), fidelity="static", max_moves=2
    )


def training_run(folder: Path, make_learner: Callable[[], Any]) -> Reader:
    """Return the reader of a training's folder."""
    learner = make_learner()
    run = TrainingRun(folder / "run", GenerationTaskConfig(), learner, 100)
    learner.train_iteration()
    run.report({"score": 0.5}, {"loss": 0.1})
    run.save()
    files = [folder / "run" / name for name in ("state.safetensors", "history.json", "config.yaml")]

    def resume() -> None:
        resumed = make_learner()
        TrainingRun(folder / "run", GenerationTaskConfig(), resumed, 100)

    return Reader(files, resume)


def soft_q_training(folder: Path) -> Reader:
    environment = ClutterGeneration(task=GenerationTaskConfig(nodes=5))
    config = SoftQConfig(
        num_envs=1, batch_size=4, sequence_length=2, buffer_size=20, learning_starts=0, width=4
    )
    return training_run(folder, lambda: SoftQLearner(lambda: environment, config, 0, CPU, 1))


def ppo_training(folder: Path) -> Reader:
    environment = exploration()
    config = PPOConfig(episodes_per_iteration=1, update_epochs=1, width=4)
    return training_run(folder, lambda: PPOLearner(environment, config, 0, CPU))


def cloning_training(folder: Path) -> Reader:
    environment = exploration()
    teacher = ExplorerNetwork(len(environment.node_kind_ids), 4)
    config = BehaviorCloningConfig(
        iterations=2, episodes_per_iteration=1, updates_per_iteration=1, batch_size=4, width=4
    )
    return training_run(
        folder, lambda: BehaviorCloningLearner(environment, teacher, config, 0, CPU)
    )


def job_file(folder: Path) -> Reader:
    job = feasibility_job(Path(__file__)).to_dict()
    with open_job_folder(folder, job):
        (folder / "moves.csv").touch()

    def read() -> None:
        with open_job_folder(folder, job):
            pass

    return Reader([folder / JOB_FILE], read)


def progress_file(folder: Path) -> Reader:
    path = folder / "progress.json"
    document = {"seconds": 3.5, "layout_failures": {"no room": 2}, "solvable": ["solvable", None]}
    write_json(path, document)
    return Reader([path], lambda: read_generation_progress(path))


def scene_dataset(folder: Path) -> Reader:
    path = folder / "set.json"
    document = json.loads(DATASET.read_text())
    document["scenes"] = document["scenes"][:2]
    digest = document.pop("sha256")
    head = {key: value for key, value in document.items() if key != "scenes"}
    document["sha256"] = _digest(head, document["scenes"])
    assert document["sha256"] != digest, "the shipped dataset has more scenes"
    write_json(path, document)

    def read() -> None:
        dataset = load_scene_dataset(path, CATALOG)
        for k in range(len(dataset.scenes)):
            dataset.derivation(k, YCB_GRAMMAR)

    read()
    return Reader([path], read)


def image_dataset(folder: Path) -> Reader:
    camera = replace_camera()
    shape = (camera.height, camera.width)
    label = np.full(shape, -1)
    label[4:8, 4:8] = 0
    image = LabeledImage(
        np.zeros((*shape, 3), np.uint8),
        np.full(shape, 1.5, np.float32),
        label,
        ("sugar_box",),
        (Pose((0.1, 0.0, 0.02)),),
        np.array([16]),
    )
    annotated = AnnotatedImage(image, label[None] == 0)
    write_images(folder / "000000", [annotated], camera, ["cracker_box", "sugar_box"])

    def read() -> None:
        for cached in (_read_cameras, _read_infos, _read_poses):
            cached.cache_clear()
        images = ImageDataset(folder)
        for k in range(len(images)):
            _ = images[k]

    return Reader(sorted(path for path in folder.rglob("*") if path.is_file()), read)


def replace_camera() -> Any:
    """Return a camera of small images."""
    return DEFAULT_CELL.camera.model_copy(update={"width": 16, "height": 16})


def record_file(folder: Path) -> Reader:
    path = folder / "records.jsonl.gz"
    header = {"seed": 3, "config": to_plain(ClutterConfig())}
    record = {
        **{"scene": "a", "agent": "random", "ended": "all found", "commit": "0"},
        **{"hidden": 3, "found": 3, "moves": 2, "found_after": [1, 3], "not_carried_out": 0},
    }
    write_jsonl(path, {**header, "commit": "0"}, [record] * 3)

    def read() -> None:
        for episode in read_jsonl(path, EpisodeRecord)[1:]:
            EpisodeResult.from_record(episode)
        with closing(
            resume_jsonl(path, header, lambda done: [record] * (3 - done), EpisodeRecord)
        ) as lines:
            list(lines)

    return Reader([path], read)


def results_file(folder: Path) -> Reader:
    file = ResultsFile(folder / "results.json", {"seed": 3}, ("agent",))
    file.add({"agent": "random", "hidden": 3.5}, {"agent": "student", "hidden": 2.5})
    return Reader([file.path], lambda: file.find({"agent": "student"}))


def feasibility_parts(folder: Path) -> Reader:
    move = to_plain(MoveRecord("setup", "scene", "a", "tray", "box", "flat", 0.1, 0.2, 0.3, 2))
    row = {k: None if v != v else v for k, v in move.items()}  # NaN is null
    noise = to_plain(NoiseRecord("setup", "scene", "a", "tray", "pose", 0.01, "placed", "b"))
    sequence = SequenceRecord("setup", "scene", "random", False, 3, 2, 4, 1, 0.5, "gave up")
    grid = [[[[0.5, 0.2], [1.0, 0.0]]]]
    target = {
        **{"setup": "setup", "target": "up", "num_solutions": 0, "reachable": False},
        **{"singular_value": 0.0, "q": None, "obstacles": ""},
    }
    found = {"scene": "a", "unstable": False}
    parts: dict[StudyPart, Any] = {
        StudyPart(PartKind.MAP, 0): {"tools": ["large"]},
        StudyPart(PartKind.BASES, 0, 0): {**found, "possible": 3, "reachable": [1, 3]},
        StudyPart(PartKind.SETUP, 0): {
            **{"unusable": None, "home": {"q": [0.1, 0.2], "is_given": True, "obstacle": ""}}
        },
        StudyPart(PartKind.SETUP, 1): {"unusable": "no home", "home": None},
        StudyPart(PartKind.MOVES, 0, 0): {**found, "moves": [row], "noise": [noise]},
        StudyPart(PartKind.SEQUENCE, 0, 0): {**found, "sequence": to_plain(sequence)},
        StudyPart(PartKind.REACH, 0): {
            **{"tilts_deg": [0.0], "x": [0.0, 0.1], "y": [0.0, 0.1], "heights": [0.2]},
            **{
                "targets": [target],
                **dict.fromkeys(("reachable_fraction", "singular_value"), grid),
            },
        },
    }
    for part, document in parts.items():
        write_json(folder / part.file_name, document)

    def read() -> None:
        for part in parts:
            load_part(folder, part)

    return Reader([folder / part.file_name for part in parts], read)


def mesh_files(folder: Path) -> Reader:
    """Return a reader of meshes in all formats, with textures and vertex colors."""
    box = trimesh.creation.box((0.06, 0.04, 0.03))
    box.export(folder / "stl.stl")
    textured = box.copy()
    textured.unmerge_vertices()
    uv = rng().random((len(textured.vertices), 2))
    pixels = rng().integers(0, 256, (8, 8, 3), np.uint8)
    textured.visual = trimesh.visual.TextureVisuals(uv=uv, image=Image.fromarray(pixels))  # type: ignore[no-untyped-call]
    textured.export(folder / "glb.glb")
    colored = box.copy()
    colored.visual.vertex_colors = rng().integers(0, 256, (len(box.vertices), 4), np.uint8)
    colored.export(folder / "ply.ply")
    obj = write_cube_with_seams(folder)
    meshes = [folder / "stl.stl", folder / "glb.glb", folder / "ply.ply", obj]

    def read() -> None:
        for path in meshes:
            parts = load_object_mesh(path, f"{folder}: classes.brick.mesh")
            if path.suffix != ".stl":
                textured_parts(parts, path)

    return Reader(sorted(path for path in folder.iterdir() if path.name != "catalog.yaml"), read)


def own_catalog(folder: Path) -> Reader:
    """Return a reader of an asset folder with a mesh."""
    box = trimesh.creation.box((0.06, 0.04, 0.03))
    box.export(folder / "brick.stl")
    (folder / "catalog.yaml").write_text(
        "classes:\n  brick: {shape: mesh, mesh: brick.stl, mass_g: 200}\n"
    )
    build_assets(folder)
    names = ("mesh.json", "surface.npy", "convex_000.obj", "model.sdf")
    built = [folder / "brick" / name for name in names]

    def read() -> None:
        load_catalog.cache_clear()
        classes = load_catalog(folder).classes
        if "brick" not in classes:
            raise InputError(f"{folder}: no class")
        brick = classes["brick"]
        _ = brick.center_of_mass, brick.convex_pieces, brick.surface_triangles
        builder = DiagramBuilder()
        add_scene_plant(builder, [("brick", brick)], TRAY, 0.01, visuals=False)

    return Reader([folder / "catalog.yaml", folder / "brick.stl", *built], read)


def visual_files(folder: Path) -> Reader:
    """Return a reader of built and of users' visual meshes with textures."""
    box = trimesh.creation.box((0.06, 0.04, 0.03))
    box.unmerge_vertices()
    uv = rng().random((len(box.vertices), 2))
    image = Image.fromarray(rng().integers(0, 256, (24, 24, 3), np.uint8))
    box.visual = trimesh.visual.TextureVisuals(uv=uv, image=image)  # type: ignore[no-untyped-call]
    box.export(folder / "visual.glb")
    parts = textured_parts(load_object_mesh(folder / "visual.glb", ""), folder / "visual.glb")
    (folder / "visual.gltf").write_text(gltf_text(parts))
    obj = write_cube_with_seams(folder)
    visuals = [folder / "visual.glb", folder / "visual.gltf", obj]

    def read() -> None:
        for path in visuals:
            check_visual_mesh(path)

    return Reader([folder / "label.png", *visuals[:2]], read)


def robot_files(folder: Path) -> Reader:
    """Return a reader of an arm in URDF and a fixture in SDF."""
    spec = arm(folder, "revolute", "0 0 1", 0.5)
    post = folder / "post.sdf"
    post.write_text(STATIC)
    fixture = {"name": "post", "model": str(post), "pose": {"translation": [0.6, 0.0, 0.25]}}
    cell = override_config(DEFAULT_CELL, {"robot": to_plain(spec), "fixtures": [fixture]}, "cell")

    def read() -> None:
        for cached in (load_robot, read_model_text, read_torque_limits):
            cached.cache_clear()
        load_robot(cell.robot)
        CollisionModel(cell, [])

    return Reader([Path(spec.model), post], read)


def target_set(folder: Path) -> Reader:
    scenes = load_scene_dataset(DATASET, CATALOG)
    path = folder / "targets.json"
    pairs = [
        TargetPair(scene=0, target="box", solvable="solvable", moves=2, is_optimal=True),
        TargetPair(scene=1, target="can", solvable="unsolvable", moves=None, is_optimal=False),
    ]
    save_target_set(path, {"seed": 3}, scenes, pairs)

    def read() -> None:
        for pair in load_target_set(path, scenes).pairs:
            _ = scenes.scenes[pair.scene]

    return Reader([path], read)


def target_poses(folder: Path) -> Reader:
    """Return what reads the file of `feasibility --targets`."""
    path = folder / "targets.yaml"
    pose = {"translation": [0.1, 0.0, 0.2], "quaternion": [0.0, 1.0, 0.0, 0.0]}
    path.write_text(to_yaml([{"name": "up", **pose}, {"name": "down", **pose}]))
    return Reader([path], lambda: read_targets(path))


def reaching_policy(folder: Path) -> Reader:
    path = folder / "policy.safetensors"
    metadata = {"kind": "reaching policy", "observation": "state", "num_joints": 6}
    save_checkpoint(path, ReachingPolicy("state", 6), metadata)
    return Reader([path, path.with_suffix(".json")], lambda: ReachingPolicy.load(path))


READERS = [
    *(mesh_files, visual_files, own_catalog, robot_files),
    *(scene_file, config_file, cell_file, generator_checkpoint, explorer_checkpoint),
    *(detector_checkpoint, trajectory_file, recorded_episode, recorded_dataset),
    *(lists_of_options, reachability_map),
    *(soft_q_training, ppo_training, cloning_training),
    *(job_file, progress_file, scene_dataset, image_dataset, record_file, results_file),
    *(feasibility_parts, target_set, target_poses),
    reaching_policy,
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("make_reader", READERS, ids=lambda make: make.__name__)
def test_damaged_files_are_read_or_refused_in_one_line(
    make_reader: Callable[[Path], Reader], tmp_path: Path
) -> None:
    reader = make_reader(tmp_path)
    reader.read()
    contents = {path: path.read_bytes() for path in reader.files}
    num_refused = 0
    for number in range(NUM_MUTANTS):
        generator = rng(number)
        path = reader.files[number % len(reader.files)]
        damage(path, generator)
        try:
            reader.read()
        except InputError as error:
            message = str(error)
            num_refused += 1
            assert message.isprintable(), (number, message)
            assert len(message) <= MAX_ERROR_LENGTH, (number, message)
            assert str(tmp_path) in message or path.name in message, (number, message)
        except Exception as error:
            error.add_note(f"mutant {number} of {path.name}")
            raise
        for path, content in contents.items():
            path.write_bytes(content)
    assert num_refused > 0.3 * NUM_MUTANTS
    reader.read()
