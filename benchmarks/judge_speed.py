"""Time stability verdicts, visibility and search, beside PyBullet on the same scenes and core.

python benchmarks/judge_speed.py --out judge_speed.json
"""

import os

# Before numpy is imported.
os.environ.update({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"})

import itertools
import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import pybullet
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.measurement import describe_machine
from benchmarks.pybullet_world import load_world, object_poses, render_labels
from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.config import ClutterConfig
from drake_clutter.export import ExportFormat, export_scene
from drake_clutter.files import write_json
from drake_clutter.scenes.interfaces import InconclusiveVerdict
from drake_clutter.scenes.scene import Scene, perturb_poses, tilt_between
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.stability.ray_caster import RayCaster
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.oracle_search import OracleSearch, Solvability
from drake_clutter.validation import to_plain
from training.results_file import Row, provenance
from training.script import ResultsOption, SeedOption, run_script

CONFIG = ClutterConfig()
"""Configuration of the scenes and judges."""
NODES = 25
"""Number of nodes of the scene graphs in the main comparison."""
NEVER = 1_000_000
"""Number of samples that is never reached: disables the early stop of the settling."""
REPEATS = 5
"""Number of rounds of calls that take less than a millisecond; a scene's time is the median."""
SLOW_SCENES = 6
"""Number of scenes of each size for Drake and PyBullet, and of Drake's untimed first calls."""
SEARCH_BUDGET = 2000
"""Number of moves that the oracle search may evaluate."""
HIDDEN_GROUPS = ("0", "1", "2", "3", "4-5", "4-5", "6+")
"""Row of the search's table by number of hidden objects; the last for more."""
PYBULLET_STEPS = 480
"""Number of steps that PyBullet simulates, 2 s."""
PYBULLET_STEPS_BEFORE_REST = 360
"""Number of steps after which objects should rest in PyBullet, 0.5 s before the end."""

# Names of judges and renderers in results files.
STATIC_COLD = "static judge, empty cache"
STATIC_WARM = "static judge, cached stacks"
DRAKE = "Drake"
DRAKE_ACCURATE = "Drake without early stop"
BULLET = f"PyBullet, {PYBULLET_STEPS} steps"
RAY_LABELS = "ray caster, label image"
VTK_LABELS = "Drake VTK, label image"
BULLET_LABELS = "PyBullet TinyRenderer, label image"
RAY_FRACTIONS = "ray caster, visible fractions"
VTK_FRACTIONS = "Drake VTK, visible fractions"

NOTES = {
    "core": "One process on one core; wall-clock times.",
    "scenes": f"Random generator, {NODES} nodes, ycb7. All judges get the same random offsets.",
    "growth": "Half of the scenes of each size are stable by the static model; Drake and PyBullet"
    f" judge the first {SLOW_SCENES}. 30 objects may be one more or less, 60 two.",
    STATIC_COLD: "Stability and visibility. The cache of stacks is cleared before every scene.",
    STATIC_WARM: "Second verdict on the same scenes.",
    DRAKE: "Default settings with early stop. One judge for all scenes, which caches objects"
    f" that stand alone; untimed verdicts on the first {SLOW_SCENES} scenes come first. Its engine"
    " is rebuilt when a scene has more objects of a class than any before.",
    DRAKE_ACCURATE: "Without the early stop: stable scenes are simulated for 2 s.",
    BULLET: f"{PYBULLET_STEPS} steps of 1/240 s in a new world for every scene, friction 0.5,"
    " Drake's limits at the end, stability only. Loading is given as load_mean_ms; the export is"
    " not included. Lying markers roll away.",
    "agreement": "With the accurate settings. agrees: stability; agrees_on_hidden: hidden objects"
    " of scenes that both call stable; unchanged: both.",
    "renderers": "640 x 480; visible fractions: of all objects. Every scene was rendered once"
    " before, untimed; PyBullet without shadows.",
    "repeats": f"Static judge and ray caster: median of {REPEATS} rounds; all others: one call.",
    "search": f"Budget {SEARCH_BUDGET} moves; the cache of stacks is cleared before every scene.",
}
"""What the results mean, for the results file."""
TARGETS = {
    "static_ms_16_objects": "< 0.5",
    "static_ms_16_objects_stable": "< 0.5",
    "ratio_to_pybullet": ">= 300",
    "drake_median_s": "< 1.0",
    "drake_verdicts_unchanged": ">= 0.99",
}
"""Target of each headline number."""

Answer = TypeVar("Answer")
Verdict = tuple[bool | None, tuple[str, ...] | None]
"""Whether a scene is stable, and its hidden objects; None if the judge is inconclusive."""
AnyJudge = StaticStabilityJudge | DrakeJudge


@dataclass(frozen=True)
class SceneSize:
    """Scenes with a given number of objects.

    Attributes:
        objects: Number of objects.
        nodes: Number of nodes of the scene graphs.
        tray_side: Side of the tray that they need [m].
        scenes: Number of scenes.
    """

    objects: int
    nodes: int
    tray_side: float
    scenes: int


SIZES = (
    SceneSize(5, 9, 0.7, 40),
    SceneSize(10, 18, 0.7, 40),
    SceneSize(16, 29, 0.7, 40),
    SceneSize(30, 53, 1.0, 20),
    SceneSize(60, 104, 1.2, 10),
)
"""Sizes of the comparison by number of objects."""


@dataclass(frozen=True)
class Case:
    """A scene as laid out.

    Attributes:
        scene: The scene.
        rng: Random generator that laid it out; its next values are the random offsets.
    """

    scene: Scene
    rng: np.random.Generator

    @cached_property
    def perturbed(self) -> Scene:
        """The scene with its random offsets."""
        objects = perturb_poses(self.scene.objects, CONFIG.settle.jitter, deepcopy(self.rng))
        return replace(self.scene, objects=tuple(objects))


def make_generator(nodes: int, tray_side: float, seed: int) -> SceneGenerator:
    """Return the random generator on a tray of a given side length [m]."""
    support = CONFIG.cell.support.model_copy(update={"size": (tray_side, tray_side)})
    config = replace(CONFIG, cell=CONFIG.cell.with_support(support))
    return SceneGenerator(GenerationJob("random", "ycb7", None, nodes, seed, config))


def sample_cases(count: int, seed: int) -> list[Case]:
    """Return random scenes of the main comparison."""
    generator = make_generator(NODES, CONFIG.cell.support.size[0], seed)
    cases = []
    for index in range(count):
        rng = item_rng(seed, index)
        cases.append(Case(generator.lay_out(rng)[0], rng))
    return cases


def sample_half_stable(size: SceneSize, count: int, seed: int) -> tuple[list[Case], float]:
    """Return scenes of a size, alternately stable and unstable by the static model.

    Args:
        size: The size.
        count: Number of scenes.
        seed: Seed of the scenes.

    Returns:
        The scenes, and the fraction of stable ones among all that were sampled.
    """
    generator = make_generator(size.nodes, size.tray_side, seed)
    judge = StaticStabilityJudge(CONFIG)
    cases: dict[bool, list[Case]] = {True: [], False: []}
    for draw in itertools.count():
        rng = item_rng(seed, size.objects, draw)
        scene, _ = generator.lay_out(rng)
        if abs(len(scene.objects) - size.objects) <= size.objects // 30:
            cases[judge.find_instability(scene) is None].append(Case(scene, rng))
        if min(map(len, cases.values())) >= count // 2:
            break
    pairs = itertools.islice(zip(cases[True], cases[False], strict=False), count // 2)
    stable_fraction = len(cases[True]) / sum(map(len, cases.values()))
    return list(itertools.chain(*pairs)), stable_fraction


def time_call(call: Callable[..., Answer], *arguments: Any) -> tuple[float, Answer]:
    """Return the time of a call [s], and its result."""
    start = time.perf_counter()
    answer = call(*arguments)
    return time.perf_counter() - start, answer


def time_cases(
    label: str,
    call: Callable[[Scene, np.random.Generator], Answer],
    cases: Sequence[Case],
    warm_up: int = NEVER,
    repeats: int = 1,
    before: Callable[[], None] = lambda: None,
) -> tuple[list[float], list[Answer]]:
    """Return the time [s] and the result of a call for each scene.

    Args:
        label: Text of the progress bar.
        call: The function.
        cases: The scenes.
        warm_up: Number of scenes for which it is called once before, untimed.
        repeats: Number of rounds; a scene's time is their median.
        before: Function that is called before each timed call.
    """
    for case in cases[:warm_up]:
        call(case.scene, deepcopy(case.rng))
    seconds = list[float]()
    answers = list[Answer]()
    # A progress bar would disturb the measurement of short calls.
    is_short = repeats > 1
    for case in track([*cases] * repeats, label, console=Console(stderr=True), disable=is_short):
        rng = deepcopy(case.rng)
        before()
        elapsed, answer = time_call(call, case.scene, rng)
        seconds.append(elapsed)
        answers.append(answer)
    medians = np.median(np.reshape(seconds, (repeats, -1)), axis=0).tolist()
    return medians, answers[: len(cases)]


@dataclass(frozen=True)
class BulletRun:
    """A scene in PyBullet.

    Attributes:
        load_seconds: Time to load it [s].
        frame_seconds: Time to render a frame [s].
        step_seconds: Time of all steps [s].
        is_stable: Whether it is stable by the limits of the settle configuration.
    """

    load_seconds: float
    frame_seconds: float
    step_seconds: float
    is_stable: bool


def run_in_bullet(case: Case) -> BulletRun:
    """Load, render and simulate a scene in PyBullet."""
    scene, limits = case.perturbed, CONFIG.settle

    def step(count: int) -> float:
        seconds, _ = time_call(lambda: [pybullet.stepSimulation() for _ in range(count)])
        return seconds

    with tempfile.TemporaryDirectory() as folder:
        exported = export_scene(scene, ExportFormat.SDF, Path(folder))
        load_seconds, _ = time_call(load_world, exported)
        render_labels()
        frame_seconds, _ = time_call(render_labels)
        first = object_poses(scene)
        step_seconds = step(PYBULLET_STEPS_BEFORE_REST)
        late = object_poses(scene)
        step_seconds += step(PYBULLET_STEPS - PYBULLET_STEPS_BEFORE_REST)
        last = object_poses(scene)
        is_stable = all(
            scene.support.contains(*X.p[:2])
            and X.p[2] >= 0
            and np.linalg.norm(X.p - X_first.p) < limits.max_displacement
            and np.linalg.norm(X.p - X_late.p) <= limits.max_rest_displacement
            and tilt_between(o.object_class, X_first, X) < math.radians(limits.max_tilt_deg)
            for o, X, X_first, X_late in zip(scene.objects, last, first, late, strict=True)
        )
        pybullet.disconnect()
    return BulletRun(load_seconds, frame_seconds, step_seconds, is_stable)


def time_metrics(seconds: Sequence[float]) -> Row:
    """Return the median, mean and 95th percentile of times, and the calls per second."""
    ms = 1000 * np.array(seconds)
    metrics = {
        "median_ms": np.median(ms),
        "mean_ms": ms.mean(),
        "p95_ms": np.percentile(ms, 95),
        "per_second": 1000 / ms.mean(),
    }
    return {"count": len(ms)} | {key: float(value) for key, value in metrics.items()}


def judge_metrics(
    seconds: Sequence[float], verdicts: Sequence[Verdict], reference: Sequence[Verdict] | None
) -> Row:
    """Return the times of a judge, and its agreement with a reference."""
    is_stable = [stable is True for stable, _ in verdicts]
    on_stable = [s for s, stable in zip(seconds, is_stable, strict=True) if stable]
    row = time_metrics(seconds)
    row["stable_fraction"] = float(np.mean(is_stable))
    row["stable_median_ms"] = 1000 * float(np.median(on_stable)) if on_stable else None
    if reference:
        pairs = list(zip(verdicts, reference, strict=True))
        row["agrees"] = float(np.mean([a[0] == b[0] for a, b in pairs]))
        same_hidden = [a[1] == b[1] for a, b in pairs if a[0] and b[0]]
        if verdicts[0][1] is not None:
            row["agrees_on_hidden"] = float(np.mean(same_hidden)) if same_hidden else None
            row["unchanged"] = float(np.mean([a == b for a, b in pairs]))
    return row


def render_ray_labels(rays: RayCaster, scene: Scene) -> NDArray[np.int16]:
    """Return the label image of a scene by one ray cast. Shape (H, W)."""
    _, rectangle = rays._cast(*rays._shapes.rows_and_positions(scene.objects))
    image = np.full(rays._hit.shape, -1, np.int16)
    image[rectangle] = rays._hit[rectangle]
    return image


def to_verdict(answer: Any) -> Verdict:
    """Return a judge's answer as a verdict."""
    if isinstance(answer, InconclusiveVerdict):
        return None, None
    return answer.stable, answer.hidden


def measure_scenes(
    label: str, cases: Sequence[Case], num_slow: int, judges: Mapping[str, AnyJudge]
) -> Row:
    """Return the metrics of all judges and cameras on some scenes.

    Args:
        label: Text of the progress bars.
        cases: The scenes.
        num_slow: Number of scenes, the first, for Drake's and PyBullet's judges.
        judges: The judges by name.
    """
    measured: dict[str, tuple[list[float], list[Verdict]]] = {}
    for name, judge in judges.items():
        if isinstance(judge, StaticStabilityJudge):
            clear = judge._cache.clear if name == STATIC_COLD else lambda: None
            seconds, answers = time_cases(
                f"{label}: {name}", judge.judge, cases, repeats=REPEATS, before=clear
            )
            measured[name] = seconds, [to_verdict(answer) for answer in answers]
        else:
            slow_seconds, slow_answers = time_cases(
                f"{label}: {name}", judge.judge, cases[:num_slow], SLOW_SCENES
            )
            measured[name] = slow_seconds, [to_verdict(answer) for answer in slow_answers]
    progress_bar = track(cases[:num_slow], f"{label}: {BULLET}", console=Console(stderr=True))
    runs = [run_in_bullet(case) for case in progress_bar]
    measured[BULLET] = [r.step_seconds for r in runs], [(r.is_stable, None) for r in runs]
    reference = measured[DRAKE_ACCURATE][1] if DRAKE_ACCURATE in measured else None
    judge_rows = {name: judge_metrics(*pair, reference) for name, pair in measured.items()}
    judge_rows[BULLET]["load_mean_ms"] = 1000 * float(np.mean([r.load_seconds for r in runs]))

    rays = RayCaster(CONFIG.cell.camera)
    camera = CameraRenderer(CONFIG.cell.camera)
    cameras: dict[str, tuple[Callable[[Scene, np.random.Generator], Any], int]] = {
        RAY_LABELS: (lambda scene, _: render_ray_labels(rays, scene), REPEATS),
        VTK_LABELS: (lambda scene, _: camera.render_label(scene), 1),
        RAY_FRACTIONS: (lambda scene, _: rays.visible_fractions(scene.objects), REPEATS),
        VTK_FRACTIONS: (lambda scene, _: camera.visible_fractions(scene), 1),
    }
    camera_rows = {BULLET_LABELS: time_metrics([r.frame_seconds for r in runs])}
    for name, (render, repeats) in cameras.items():
        seconds, _ = time_cases(f"{label}: {name}", render, cases, repeats=repeats)
        camera_rows[name] = time_metrics(seconds)
    return {"judges": judge_rows, "renderers": camera_rows}


def measure_growth(count: int, seed: int, judges: Mapping[str, AnyJudge]) -> list[Row]:
    """Return the metrics by number of objects.

    Args:
        count: Number of scenes of each size at most.
        seed: Seed of the scenes.
        judges: The judges by name.
    """
    rows = []
    for size in SIZES:
        cases, stable_fraction = sample_half_stable(size, min(size.scenes, count), seed)
        row: Row = {
            "objects": size.objects,
            "objects_mean": float(np.mean([len(case.scene.objects) for case in cases])),
            "nodes": size.nodes,
            "tray_side": size.tray_side,
            "stable_fraction_of_samples": stable_fraction,
        }
        rows.append(row | measure_scenes(f"{size.objects} objects", cases, SLOW_SCENES, judges))
    return rows


def measure_search(cases: Sequence[Case]) -> dict[str, Row]:
    """Return the metrics of the oracle search by number of hidden objects.

    Args:
        cases: Scenes; those that are not stable or hide nothing are left out.
    """
    judge = StaticStabilityJudge(CONFIG)
    search = OracleSearch(CONFIG, judge)
    groups: dict[str, list[Case]] = {name: [] for name in HIDDEN_GROUPS}
    for case in cases:
        if judge.find_instability(case.scene) is None:
            fractions = judge.ray_caster.visible_fractions(case.scene.objects).values()
            hidden = sum(f < CONFIG.cell.camera.visibility_threshold for f in fractions)
            groups[HIDDEN_GROUPS[min(hidden, len(HIDDEN_GROUPS) - 1)]].append(case)
    del groups["0"]
    rows: dict[str, Row] = {name: {"count": len(group)} for name, group in groups.items()}
    for name, group in groups.items():
        if group:
            search.solve(group[0].scene, budget=20)
            seconds, solutions = time_cases(
                f"{name} hidden",
                lambda scene, _: search.solve(scene, 0, SEARCH_BUDGET),
                group,
                0,
                before=judge._cache.clear,
            )
            moves = [solution.moves_evaluated for solution in solutions]
            rows[name] |= {
                "median_s": float(np.median(seconds)),
                "max_s": max(seconds),
                "median_moves_evaluated": float(np.median(moves)),
            }
            rows[name] |= {
                answer.value: float(np.mean([s.solvability is answer for s in solutions]))
                for answer in Solvability
            }
    return rows


def make_table(
    title: str, rows: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str]
) -> Table:
    """Return a table.

    Args:
        title: Title of the first column.
        rows: Values of each row by key, by name of the row.
        columns: Key of each column's values by its title.
    """
    table = Table(title, *columns, padding=0)
    table.columns[0].no_wrap = True
    for name, row in rows.items():
        table.add_row(name, *(format_cell(row.get(key)) for key in columns.values()))
    return table


def format_cell(value: Any) -> str:
    """Return a value as a cell of a table: numbers with three digits or more."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def show_results(results: Row, console: Console) -> None:
    """Print the tables."""
    times = {"median": "median_ms", "mean": "mean_ms", "95 %": "p95_ms", "per s": "per_second"}
    judge_columns = times | {
        "of stable": "stable_median_ms",
        "stable": "stable_fraction",
        "agrees": "agrees",
        "on hidden": "agrees_on_hidden",
    }
    console.print(make_table("ms per scene", results["judges"], judge_columns))
    console.print(make_table("ms per frame", results["renderers"], times))
    growth = {
        name: {str(row["objects"]): row[part][name]["mean_ms"] for row in results["growth"]}
        for part in ("judges", "renderers")
        for name in results["growth"][0][part]
    }
    sizes = {str(size.objects): str(size.objects) for size in SIZES}
    console.print(make_table("mean ms by objects", growth, sizes))
    search_columns = {
        "scenes": "count",
        "median s": "median_s",
        "max s": "max_s",
        "moves": "median_moves_evaluated",
    } | {answer.value: answer.value for answer in Solvability}
    console.print(make_table("search: hidden", results["search"], search_columns))
    targets = {
        name: {"target": TARGETS[name], "measured": value}
        for name, value in results["targets"].items()
    }
    console.print(make_table("headline", targets, {"target": "target", "measured": "measured"}))


def headline_numbers(results: Row) -> dict[str, float]:
    """Return the numbers that have `TARGETS`."""
    (sixteen,) = (row["judges"][STATIC_COLD] for row in results["growth"] if row["objects"] == 16)
    judges = results["judges"]
    return {
        "static_ms_16_objects": sixteen["median_ms"],
        "static_ms_16_objects_stable": sixteen["stable_median_ms"],
        "ratio_to_pybullet": judges[BULLET]["mean_ms"] / judges[STATIC_COLD]["mean_ms"],
        "drake_median_s": judges[DRAKE]["median_ms"] / 1000,
        "drake_verdicts_unchanged": judges[DRAKE]["unchanged"],
    }


def main(
    count: Annotated[
        int,
        typer.Option(
            min=2,
            help=f"Number of scenes of {NODES} nodes, and of the other sizes at most.",
        ),
    ] = 60,
    seed: SeedOption = 0,
    out: ResultsOption = None,
) -> None:
    """Measure all judges, cameras and the search; print and write the results."""
    # PyBullet prints to the standard output of the process: keep it for the tables alone.
    console = Console(file=os.fdopen(os.dup(1), "w"))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    if hasattr(os, "sched_setaffinity"):  # Renderers start threads.
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    static = StaticStabilityJudge(CONFIG)
    accurate_settle = replace(CONFIG.settle, early_stop_samples=NEVER)
    accurate = DrakeJudge(replace(CONFIG, settle=accurate_settle))
    judges: dict[str, AnyJudge] = {
        STATIC_COLD: static,
        STATIC_WARM: static,
        DRAKE: DrakeJudge(CONFIG),
    }
    cases = sample_cases(count, seed)
    results: Row = {
        "config": to_plain(CONFIG),
        "seed": seed,
        "count": count,
        "nodes": NODES,
        **provenance(),
        "machine": describe_machine("drake", "pybullet", "numba", "numpy"),
        "notes": NOTES,
        "objects_mean": float(np.mean([len(case.scene.objects) for case in cases])),
        **measure_scenes(f"{NODES} nodes", cases, count, judges | {DRAKE_ACCURATE: accurate}),
        "growth": measure_growth(count, seed, judges),
        "search": measure_search(cases),
    }
    results["targets"] = headline_numbers(results)
    results["seconds"] = time.monotonic() - start
    if out is not None:
        write_json(out, results)
    show_results(results, console)


if __name__ == "__main__":
    run_script(main)
