"""How fast scenes are judged, seen and searched: this project and PyBullet, on the same scenes and one core.

python benchmarks/judge_speed.py --out benchmarks/results/speed.json
"""

import os

os.environ.update(
    {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
)  # before numpy is imported

import itertools
import math
import platform
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, TypeVar

import matplotlib.pyplot as plt
import numpy as np
import pybullet
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.pybullet_world import label_image, load, poses
from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.config import ClutterConfig
from drake_clutter.export import ExportFormat, export_scene
from drake_clutter.files import write_json
from drake_clutter.resources import git_commit
from drake_clutter.scenes.interfaces import InconclusiveVerdict
from drake_clutter.scenes.scene import Scene, perturb_poses, tilt_between
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.stability.ray_caster import RayCaster
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.oracle_search import OracleSearch, Solvability
from drake_clutter.validation import config_yaml

CONFIG = ClutterConfig()
NODES = 25
NEVER = 1_000_000
REPEATS = 5
"""Rounds through all scenes of what takes less than a millisecond; a scene's time is the median."""
SLOW = 6
"""Scenes of each size that Drake and PyBullet judge; and the scenes that Drake judges beforehand, not timed."""
BUDGET = 2000
"""Moves that the search may try."""
HIDDEN = ("0", "1", "2", "3", "4-5", "4-5", "6+")
"""Row of the search's table by hidden objects; the last for more."""
FAST, WARM, DRAKE, ACCURATE, BULLET = (
    "StaticStabilityJudge, cold",
    "StaticStabilityJudge, warm",
    "DrakeJudge",
    "DrakeJudge, accurate",
    "PyBullet",
)
RAYS, VTK, TINY = "ray caster", "Drake VTK labels", "TinyRenderer"
RAY_SHARES, VTK_SHARES = "shares, ray caster", "shares, Drake VTK"
NOTES = {
    "core": "one process on one core; times are of the wall clock",
    "scenes": f"RG's of {NODES} nodes, ycb7, as `generate` draws them; every judge gets the same random offsets",
    "growth": f"half of the scenes of each size stable, half not, by the fast judge; the first {SLOW} for Drake and PyBullet; "
    "30 objects may be one more or less, 60 two",
    FAST: "stability and visibility; its memory of stacks is emptied before every scene, shape table and compiled code are kept",
    WARM: "asked again about scenes that it has judged",
    DRAKE: "as by default, stops when all is calm; one judge for all scenes, which remembers objects that stand on their own; "
    f"the first {SLOW} scenes were judged once before; its engine is built anew when a scene has more of a class than any before",
    ACCURATE: "likewise, but without the early stop: what does not fall is simulated for 2 s",
    BULLET: "480 steps of 1/240 s in a new world for every scene, friction 0.5; loading the exported models is not counted but "
    "given as load_mean_ms, export not at all; Drake's limits at the end; stability only. Lying markers roll away in it",
    "agreement": "with the accurate form. agrees: stable or not; agrees_on_hidden: of the scenes that both call stable, those "
    "with the same objects hidden; unchanged: both",
    "eyes": "640 x 480, shares: the visible shares of all objects. Every scene was drawn once before with the same engine, not "
    "timed; in PyBullet, without shadows, by a frame in the same world",
    "repeats": f"StaticStabilityJudge and ray caster: a scene's time is the median of {REPEATS} rounds; all else is timed once",
    "search": f"budget {BUDGET} moves; the judge's memory of stacks is emptied before every scene",
}
AIMS = {
    "fast_ms_16_objects": "< 0.5",
    "fast_ms_16_objects_stable": "< 0.5",
    "ratio_to_pybullet": ">= 300",
    "drake_median_s": "< 1.0",
    "drake_verdicts_unchanged": ">= 0.99",
}

T = TypeVar("T")
Row = dict[str, Any]
Found = tuple[bool | None, tuple[str, ...] | None]
"""Whether a scene is stable, and what it hides; None: the judge does not say."""


@dataclass(frozen=True)
class Size:
    """Scenes of a number of objects: how large a graph and a tray (m) they need, and how many are drawn."""

    objects: int
    nodes: int
    tray_side: float
    scenes: int


SIZES = (
    Size(5, 9, 0.7, 40),
    Size(10, 18, 0.7, 40),
    Size(16, 29, 0.7, 40),
    Size(30, 53, 1.0, 20),
    Size(60, 104, 1.2, 10),
)


@dataclass(frozen=True)
class Case:
    """A scene as laid out, and the generator that did it: what it draws next are the random offsets."""

    scene: Scene
    after: np.random.Generator

    @cached_property
    def start(self) -> Scene:
        """The scene with its offsets."""
        return replace(
            self.scene,
            objects=tuple(
                perturb_poses(self.scene.objects, CONFIG.settle.jitter, deepcopy(self.after))
            ),
        )


def generator(nodes: int, tray_side: float, seed: int) -> SceneGenerator:
    """RG on a tray."""
    support = CONFIG.cell.support.model_copy(update={"size": (tray_side, tray_side)})
    config = replace(CONFIG, cell=CONFIG.cell.with_support(support))
    return SceneGenerator(GenerationJob("random", "ycb7", None, nodes, seed, config))


def half_stable(size: Size, count: int, seed: int) -> tuple[list[Case], float]:
    """Scenes of a size, stable and unstable in turn by the fast judge, and the share of stable ones among all of that size."""
    rg, judge = generator(size.nodes, size.tray_side, seed), StaticStabilityJudge(CONFIG)
    drawn: dict[bool, list[Case]] = {True: [], False: []}
    for draw in itertools.count():
        rng = item_rng(seed, size.objects, draw)
        scene, _ = rg.lay_out(rng)
        if abs(len(scene.objects) - size.objects) <= size.objects // 30:
            drawn[judge.find_instability(scene) is None].append(Case(scene, rng))
        if min(len(cases) for cases in drawn.values()) >= count // 2:
            break
    pairs = itertools.islice(zip(drawn[True], drawn[False], strict=False), count // 2)
    return list(itertools.chain(*pairs)), len(drawn[True]) / sum(
        len(cases) for cases in drawn.values()
    )


def timed(ask: Callable[..., T], *arguments: Any) -> tuple[float, T]:
    """Seconds that a call takes, and what it returns."""
    start = time.perf_counter()
    result = ask(*arguments)
    return time.perf_counter() - start, result


def asked(
    what: str,
    ask: Callable[[Scene, np.random.Generator], T],
    cases: Sequence[Case],
    warm_up: int = NEVER,
    repeats: int = 1,
    before: Callable[[], None] = lambda: None,
) -> tuple[list[float], list[T]]:
    """Seconds and answer by scene; not timed: asking about the first `warm_up` beforehand, and `before`, called before each."""
    for case in cases[:warm_up]:
        ask(case.scene, deepcopy(case.after))
    seconds, answers = [], []
    # Drawing a progress bar would disturb what is over in a moment.
    for case in track([*cases] * repeats, what, console=Console(stderr=True), disable=repeats > 1):
        rng = deepcopy(case.after)
        before()
        took, answer = timed(ask, case.scene, rng)
        seconds.append(took)
        answers.append(answer)
    return np.median(np.reshape(seconds, (repeats, -1)), axis=0).tolist(), answers[: len(cases)]


def in_bullet(case: Case) -> tuple[float, float, float, Found]:
    """PyBullet's seconds for loading a scene, a frame and 2 s of stepping; and its verdict."""
    scene, limits = case.start, CONFIG.settle
    with tempfile.TemporaryDirectory() as folder:
        loading, _ = timed(load, export_scene(scene, ExportFormat.SDF, Path(folder)))
        label_image()
        frame, _ = timed(label_image)
        first = poses(scene)
        steps, _ = timed(lambda: [pybullet.stepSimulation() for _ in range(360)])
        late = poses(scene)
        more_steps, _ = timed(lambda: [pybullet.stepSimulation() for _ in range(120)])
        stayed = all(
            scene.support.contains(*X.p[:2])
            and X.p[2] >= 0
            and np.linalg.norm(X.p - X_first.p) < limits.max_displacement
            and np.linalg.norm(X.p - X_late.p) <= limits.max_rest_displacement
            and tilt_between(o.object_class, X_first, X) < math.radians(limits.max_tilt_deg)
            for o, X, X_first, X_late in zip(scene.objects, poses(scene), first, late, strict=True)
        )
        pybullet.disconnect()
    return loading, frame, steps + more_steps, (stayed, None)


def figures(seconds: Sequence[float]) -> Row:
    """What is said of some times."""
    ms = 1000 * np.array(seconds)
    row = {
        "median_ms": np.median(ms),
        "mean_ms": ms.mean(),
        "p95_ms": np.percentile(ms, 95),
        "per_second": 1000 / ms.mean(),
    }
    return {"count": len(ms)} | {key: float(value) for key, value in row.items()}


def judge_row(
    seconds: Sequence[float], found: Sequence[Found], truth: Sequence[Found] | None
) -> Row:
    """Figures of a judge, and how often it agrees with the truth."""
    row = figures(seconds) | {
        "stable_share": float(np.mean([stable is True for stable, _ in found]))
    }
    on_stable = [s for s, (stable, _) in zip(seconds, found, strict=True) if stable]
    row["stable_median_ms"] = 1000 * float(np.median(on_stable)) if on_stable else None
    if truth:
        pairs = list(zip(found, truth, strict=True))
        row["agrees"] = float(np.mean([a[0] == b[0] for a, b in pairs]))
        same_hidden = [a[1] == b[1] for a, b in pairs if a[0] and b[0]]
        if found[0][1] is not None:
            row["agrees_on_hidden"] = float(np.mean(same_hidden)) if same_hidden else None
            row["unchanged"] = float(np.mean([a == b for a, b in pairs]))
    return row


def ray_labels(rays: RayCaster, scene: Scene) -> NDArray[np.int16]:
    """The whole label image, by one cast."""
    _, rectangle = rays._cast(*rays._shapes.rows_and_positions(scene.objects))
    image = np.full(rays._hit.shape, -1, np.int16)
    image[rectangle] = rays._hit[rectangle]
    return image


def measure(
    what: str,
    cases: Sequence[Case],
    slow: int,
    judges: Mapping[str, StaticStabilityJudge | DrakeJudge],
) -> Row:
    """Figures by judge and by eye, those of Drake and PyBullet's judge only on the first `slow` cases."""
    found: dict[str, tuple[list[float], list[Found]]] = {}
    for name, judge in judges.items():
        if isinstance(judge, StaticStabilityJudge):
            forget = judge._cache.clear if name == FAST else lambda: None
            seconds, verdicts = asked(
                f"{what}: {name}", judge.judge, cases, repeats=REPEATS, before=forget
            )
        else:
            seconds, verdicts = asked(f"{what}: {name}", judge.judge, cases[:slow], SLOW)
        found[name] = (
            seconds,
            [
                (None, None) if isinstance(v, InconclusiveVerdict) else (v.stable, v.hidden)
                for v in verdicts
            ],
        )
    progress = track(cases[:slow], f"{what}: {BULLET}", console=Console(stderr=True))
    loads, frames, steps, in_bullet_found = zip(*map(in_bullet, progress), strict=True)
    found[BULLET] = [*steps], [*in_bullet_found]
    truth = found[ACCURATE][1] if ACCURATE in found else None
    rows = {name: judge_row(*pair, truth) for name, pair in found.items()}
    rows[BULLET]["load_mean_ms"] = 1000 * float(np.mean(loads))

    rays, camera = RayCaster(CONFIG.cell.camera), CameraRenderer(CONFIG.cell.camera)
    eyes: dict[str, tuple[Callable[[Scene, np.random.Generator], Any], int]] = {
        RAYS: (lambda scene, _: ray_labels(rays, scene), REPEATS),
        VTK: (lambda scene, _: camera.render_label(scene), 1),
        RAY_SHARES: (lambda scene, _: rays.visible_fractions(scene.objects), REPEATS),
        VTK_SHARES: (lambda scene, _: camera.visible_fractions(scene), 1),
    }
    seen = {TINY: figures(frames)}
    for name, (look, repeats) in eyes.items():
        seen[name] = figures(asked(f"{what}: {name}", look, cases, repeats=repeats)[0])
    return {"judges": rows, "eyes": seen}


def searched(cases: Sequence[Case]) -> dict[str, Row]:
    """The search on the scenes that are stable and hide something, as laid out, by how much they hide."""
    judge = StaticStabilityJudge(CONFIG)
    search = OracleSearch(CONFIG, judge)
    parts: dict[str, list[Case]] = {name: [] for name in HIDDEN}
    for case in cases:
        if judge.find_instability(case.scene) is None:
            shares = judge.ray_caster.visible_fractions(case.scene.objects).values()
            hidden = sum(share < CONFIG.cell.camera.visibility_threshold for share in shares)
            parts[HIDDEN[min(hidden, len(HIDDEN) - 1)]].append(case)
    del parts["0"]
    rows: dict[str, Row] = {name: {"count": len(part)} for name, part in parts.items()}
    for name, part in parts.items():
        if part:
            search.solve(part[0].scene, budget=20)
            took, solutions = asked(
                f"{name} hidden",
                lambda scene, _: search.solve(scene, 0, BUDGET),
                part,
                0,
                before=judge._cache.clear,
            )
            rows[name] |= {"median_s": float(np.median(took)), "max_s": max(took)}
            rows[name]["median_moves_tried"] = float(
                np.median([solution.moves_evaluated for solution in solutions])
            )
            rows[name] |= {
                answer.value: float(np.mean([s.solvability is answer for s in solutions]))
                for answer in Solvability
            }
    return rows


def table(title: str, rows: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str]) -> Table:
    """Rows by name; columns by their head: which figure."""
    made = Table(title, *columns, padding=0)
    made.columns[0].no_wrap = True
    for name, row in rows.items():
        values = [row.get(key) for key in columns.values()]
        texts = [
            v
            if isinstance(v, str)
            else ""
            if v is None
            else f"{v:,.0f}"
            if v >= 100
            else f"{v:.3g}"
            for v in values
        ]
        made.add_row(name, *texts)
    return made


def show(result: Row, console: Console) -> None:
    """Prints the tables."""
    times = {"median": "median_ms", "mean": "mean_ms", "95 %": "p95_ms", "per s": "per_second"}
    agreement = {"stable": "stable_share", "agrees": "agrees", "on hidden": "agrees_on_hidden"}
    console.print(
        table(
            "ms per scene", result["judges"], times | {"of stable": "stable_median_ms"} | agreement
        )
    )
    console.print(table("ms per frame", result["eyes"], times))
    grown = {}
    for part in ("judges", "eyes"):
        for name in result["growth"][0][part]:
            grown[name] = {
                str(row["objects"]): row[part][name]["mean_ms"] for row in result["growth"]
            }
    console.print(
        table("mean ms by objects", grown, {str(size.objects): str(size.objects) for size in SIZES})
    )
    columns = {
        "scenes": "count",
        "median s": "median_s",
        "most": "max_s",
        "moves": "median_moves_tried",
    }
    console.print(
        table(
            "search: hidden",
            result["search"],
            columns | {answer.value: answer.value for answer in Solvability},
        )
    )
    targets = {
        name: {"aim": AIMS[name], "measured": value} for name, value in result["targets"].items()
    }
    console.print(table("target", targets, {"aim": "aim", "measured": "measured"}))


def draw_growth(growth: Sequence[Row], path: Path) -> None:
    """Time by number of objects, of judges and of eyes."""
    plt.rcParams.update({"font.size": 20, "lines.linewidth": 3, "lines.markersize": 11})
    objects = [row["objects"] for row in growth]
    figure, panels = plt.subplots(1, 2, figsize=(15, 7.5), layout="constrained", sharey=True)
    parts = (
        ("judges", (BULLET, DRAKE, FAST), "scene judged"),
        ("eyes", (TINY, VTK, RAYS), "frame"),
    )
    for panel, (part, names, what) in zip(panels, parts, strict=True):
        for name, marker in zip(names, "sDo", strict=True):
            panel.loglog(
                objects, [row[part][name]["mean_ms"] for row in growth], marker=marker, label=name
            )
        panel.set_xticks(objects, objects)
        panel.minorticks_off()
        panel.set(xlabel="objects in the scene", ylabel=f"mean ms per {what}")
        panel.tick_params(labelleft=True)
        panel.grid(alpha=0.4)
        panel.legend(
            loc="lower right",
            bbox_to_anchor=(1, 1),
            ncols=3,
            columnspacing=0.8,
            handletextpad=0.3,
            fontsize=16,
        )
    figure.savefig(path, dpi=100)
    plt.close(figure)


def cpu() -> str:
    """The processor's model."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next(
        (line.partition(": ")[2] for line in lines if line.startswith("model name")),
        platform.processor(),
    )


def main(
    count: Annotated[
        int,
        typer.Option(
            help=f"Scenes of {NODES} nodes; of the other sizes, no more than this.", min=2
        ),
    ] = 60,
    seed: int = 0,
    out: Annotated[Path | None, typer.Option(help="JSON to write.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="PNG to write: the growth with the number of objects.")
    ] = None,
) -> None:
    """Measures everything in one go; prints the tables and writes them."""
    console = Console(file=os.fdopen(os.dup(1), "w"))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for what PyBullet prints, see docs/export.md
    if hasattr(os, "sched_setaffinity"):  # renderers start threads
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    for path in filter(None, (out, picture)):
        path.parent.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    packages = {name: version(name) for name in ("drake", "pybullet", "numba", "numpy")}
    result: Row = {
        "config": config_yaml(CONFIG),
        "seed": seed,
        "count": count,
        "nodes": NODES,
        "commit": git_commit(),
        "cpu": cpu(),
    }
    result |= {"versions": {"python": platform.python_version()} | packages, "notes": NOTES}

    fast, drake = StaticStabilityJudge(CONFIG), DrakeJudge(CONFIG)
    accurate = DrakeJudge(replace(CONFIG, settle=replace(CONFIG.settle, early_stop_samples=NEVER)))
    rg, cases = generator(NODES, CONFIG.cell.support.size[0], seed), []
    for index in range(count):
        rng = item_rng(seed, index)
        cases.append(Case(rg.lay_out(rng)[0], rng))
    judges: dict[str, StaticStabilityJudge | DrakeJudge] = {FAST: fast, WARM: fast, DRAKE: drake}
    result |= {"objects_mean": float(np.mean([len(case.scene.objects) for case in cases]))}
    result |= measure(f"{NODES} nodes", cases, count, judges | {ACCURATE: accurate})
    result["growth"] = []
    for size in SIZES:
        grown, share = half_stable(size, min(size.scenes, count), seed)
        row: Row = {
            "objects": size.objects,
            "objects_mean": float(np.mean([len(case.scene.objects) for case in grown])),
        }
        row |= {"nodes": size.nodes, "tray_side": size.tray_side, "stable_share_of_drawn": share}
        result["growth"].append(row | measure(f"{size.objects} objects", grown, SLOW, judges))
    result["search"] = searched(cases)

    (sixteen,) = (row["judges"][FAST] for row in result["growth"] if row["objects"] == 16)
    rows = result["judges"]
    result["targets"] = {
        "fast_ms_16_objects": sixteen["median_ms"],
        "fast_ms_16_objects_stable": sixteen["stable_median_ms"],
        "ratio_to_pybullet": rows[BULLET]["mean_ms"] / rows[FAST]["mean_ms"],
        "drake_median_s": rows[DRAKE]["median_ms"] / 1000,
        "drake_verdicts_unchanged": rows[DRAKE]["unchanged"],
    }
    result["seconds"] = time.monotonic() - began
    if out is not None:
        write_json(out, result)
    if picture is not None:
        draw_growth(result["growth"], picture)
    show(result, console)


if __name__ == "__main__":
    typer.run(main)
