"""How fast scenes are judged, seen and searched: this project's judges and cameras, and PyBullet, on the same scenes and one core.

python benchmarks/speed.py --out benchmarks/results/speed.json
"""

import math
import os

os.environ.update({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"})  # before numpy is imported

import itertools
import platform
import tempfile
import time
from collections.abc import Callable, Sequence
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
from calibrate import commit
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from drake_clutter.agents.generation import GenerationJob, SceneGenerator
from drake_clutter.config import CameraConfig, ClutterConfig, SettleConfig, config_yaml
from drake_clutter.export import ExportFormat, export_scene
from drake_clutter.fast.judge import FastJudge
from drake_clutter.fast.visibility import RayCaster
from drake_clutter.files import write_json
from drake_clutter.runner import item_rng
from drake_clutter.scenes.scene import Pose, Scene, jittered, tilt_between
from drake_clutter.scenes.seams import CannotJudge, SceneJudge
from drake_clutter.simulation.camera import OverheadCamera
from drake_clutter.simulation.judge import DrakeJudge
from drake_clutter.tasks.full_knowledge import Answer, FullKnowledgeSearch

NODES = 25
NEVER = 1_000_000
REPEATS = 5
"""Times that what takes less than a millisecond is measured; a scene's time is their median."""
SLOW = 4
"""Scenes of each size that Drake and PyBullet judge; and the scenes that Drake judges beforehand, not timed."""
BUDGET = 2000
"""Moves that the search may try."""
HIDDEN = {"1": (1, 1), "2": (2, 2), "3": (3, 3), "4-5": (4, 5), "6+": (6, NEVER)}
FAST, WARM, EARLY, ACCURATE, BULLET = "FastJudge, cold", "FastJudge, warm", "DrakeJudge", "DrakeJudge, accurate", "PyBullet"
RAYS, VTK, TINY = "ray caster", "Drake VTK labels", "PyBullet TinyRenderer"
RAY_SHARES, VTK_SHARES = "shares, ray caster", "shares, Drake VTK"
NOTES = {
    "core": "one process on one core; times are of the wall clock",
    "scenes": "RG's, ycb7, as `generate --seed` draws them; every judge gets the same random offsets",
    "growth": f"half of the scenes of each size stable, half not, by the fast judge; the first {SLOW} for Drake and PyBullet; "
    "a size may be missed by one object in thirty",
    FAST: f"its memory of stacks is emptied before every scene, shape table and compiled code are kept; median of {REPEATS}",
    WARM: f"asked about scenes that it has judged before; median of {REPEATS}",
    EARLY: "as by default: stops when all is calm; one judge for all scenes, so its memory of objects on their own fills as it "
    f"goes; the first {SLOW} scenes were judged once before",
    ACCURATE: "the same without the early stop: whatever does not fall is simulated for 2 s",
    BULLET: "480 steps of 1/240 s in a new world for every scene, friction 0.5, no early stop; loading the export is not counted "
    "but given as load_mean_ms; judged by the limits of Drake's judge, and sees nothing",
    "agreement": "with the accurate form: stable or not; hidden objects, of the scenes that both call stable; both ('unchanged')",
    "eyes": "640 x 480. Ray caster and Drake: every scene is drawn once before, with the same engine; PyBullet: one frame in every "
    f"scene's world before the one that is timed, without shadows. Ray caster: median of {REPEATS}. same_pixels: of those on "
    "which an eye or Drake VTK sees an object, how many show the same one",
    "search": f"budget {BUDGET} moves; its judge's memory is emptied before every scene",
}
AIMS = {
    "fast_ms_16_objects": "< 0.5",
    "fast_ms_16_objects_stable": "< 0.5",
    "ratio_to_pybullet": ">= 300",
    "drake_median_s": "< 1.0",
    "drake_verdicts_unchanged": ">= 0.99",
}

T = TypeVar("T")
Labels = NDArray[np.int16]
Row = dict[str, Any]


@dataclass(frozen=True)
class Size:
    """Scenes of a number of objects: how large a graph and a tray (m) they need, and how many are drawn."""

    objects: int
    nodes: int
    tray_side: float
    scenes: int


SIZES = (Size(5, 9, 0.7, 40), Size(10, 18, 0.7, 40), Size(16, 29, 0.7, 40), Size(30, 53, 1.0, 20), Size(60, 104, 1.2, 10))


@dataclass(frozen=True)
class Case:
    """A scene as laid out, and the generator that did it: its next draws are the random offsets."""

    scene: Scene
    after: np.random.Generator

    def rng(self) -> np.random.Generator:
        """A generator that draws this scene's offsets."""
        return deepcopy(self.after)

    @cached_property
    def start(self) -> Scene:
        """The scene with its offsets."""
        return replace(self.scene, objects=tuple(jittered(self.scene.objects, SettleConfig().jitter, self.rng())))


def generator(nodes: int, tray_side: float, seed: int) -> SceneGenerator:
    """RG on a tray."""
    config = ClutterConfig()
    config.layout.tray_side = tray_side
    return SceneGenerator(GenerationJob("random", "ycb7", None, nodes, seed, config))


def half_stable(size: Size, count: int, seed: int) -> tuple[list[Case], float]:
    """Scenes of a size, stable and unstable in turn by the fast judge, and the share of all drawn that were stable."""
    rg, judge = generator(size.nodes, size.tray_side, seed), FastJudge(ClutterConfig())
    kept: dict[bool, list[Case]] = {True: [], False: []}
    for draw in itertools.count():
        rng = item_rng(seed, size.objects, draw)
        scene, _ = rg.lay_out(rng)
        if abs(len(scene.objects) - size.objects) <= size.objects // 30:
            kept[judge.stability(scene) is None].append(Case(scene, rng))
        if min(map(len, kept.values())) >= count // 2:
            break
    pairs = list(zip(*kept.values(), strict=False))[: count // 2]
    return [case for pair in pairs for case in pair], len(kept[True]) / sum(map(len, kept.values()))


def timed(function: Callable[..., T], *arguments: Any) -> tuple[float, T]:
    """Seconds that a call takes, and what it returns."""
    start = time.perf_counter()
    result = function(*arguments)
    return time.perf_counter() - start, result


def figures(seconds: Sequence[float]) -> Row:
    """Median, mean and 95th percentile, and how many a second by the mean."""
    ms = 1000 * np.array(seconds)
    return {
        "count": len(ms),
        "median_ms": float(np.median(ms)),
        "mean_ms": float(ms.mean()),
        "p95_ms": float(np.percentile(ms, 95)),
        "per_second": float(1000 / ms.mean()),
    }


@dataclass
class Measured:
    """What a judge took for each scene, whether it called it stable, and what it said is hidden (None: it does not say)."""

    seconds: list[float]
    stable: list[bool | None]
    hidden: list[tuple[str, ...] | None]

    def row(self, truth: "Measured | None") -> Row:
        """Its figures, and how its verdicts agree with another judge's."""
        calm = [s for s, held in zip(self.seconds, self.stable, strict=True) if held]
        row = figures(self.seconds) | {"stable_share": self.stable.count(True) / len(self.stable)}
        row["stable_median_ms"] = 1000 * float(np.median(calm)) if calm else None
        if truth is not None:
            same = np.equal(self.stable, truth.stable)
            row["agrees"] = float(same.mean())
            if None not in self.hidden:
                same_hidden = np.array([a == b for a, b in zip(self.hidden, truth.hidden, strict=True)])
                both = np.array([bool(a and b) for a, b in zip(self.stable, truth.stable, strict=True)])
                row["agrees_on_hidden"] = float(same_hidden[both].mean()) if both.any() else None
                row["unchanged"] = float((same & same_hidden).mean())
        return row


def judged(
    what: str, judge: SceneJudge, cases: Sequence[Case], warm_up: int, repeats: int = 1, before: Callable[[], None] = lambda: None
) -> Measured:
    """Has scenes judged, the first `warm_up` of them once more beforehand; `before` is called ahead of each and not timed."""
    for case in cases[:warm_up]:
        judge.judge(case.scene, case.rng())
    measured = Measured([], [], [])
    for case in track(cases, what, console=Console(stderr=True)):
        seconds = []
        for _ in range(repeats):
            before()
            took, verdict = timed(judge.judge, case.scene, case.rng())
            seconds.append(took)
        measured.seconds.append(float(np.median(seconds)))
        measured.stable.append(None if isinstance(verdict, CannotJudge) else verdict.stable)
        measured.hidden.append(() if isinstance(verdict, CannotJudge) else verdict.hidden)
    return measured


class BulletWorld:
    """A scene in a PyBullet world of its own, loaded from its export."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        self._scene = scene
        path = str(export_scene(scene, ExportFormat.SDF, folder))
        self.load_seconds, bodies = timed(self._load, path)
        assert bodies == tuple(range(len(scene.objects) + 1))  # the tray first

    def _load(self, path: str) -> tuple[int, ...]:
        self._client = pybullet.connect(pybullet.DIRECT)
        bodies: tuple[int, ...] = pybullet.loadSDF(path, physicsClientId=self._client)
        for body in bodies:
            # The coefficients of the two that touch are multiplied.
            pybullet.changeDynamics(body, -1, lateralFriction=math.sqrt(0.5), physicsClientId=self._client)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=self._client)
        pybullet.setTimeStep(1 / 240, physicsClientId=self._client)
        return bodies

    def close(self) -> None:
        pybullet.disconnect(self._client)

    def label(self, camera: CameraConfig) -> NDArray[np.int64]:
        """The segmentation that the overhead camera sees."""
        view = pybullet.computeViewMatrix([0, 0, camera.altitude], [0, 0, 0], [0, 1, 0])
        projection = pybullet.computeProjectionMatrixFOV(camera.fov_y_deg, camera.width / camera.height, 0.05, 20)
        image = pybullet.getCameraImage(
            camera.width,
            camera.height,
            view,
            projection,
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        return np.maximum(np.asarray(image[4]).reshape(camera.height, camera.width) - 1, -1)

    def _step(self, count: int) -> None:
        for _ in range(count):
            pybullet.stepSimulation(physicsClientId=self._client)

    def _poses(self) -> list[Pose]:
        found = []
        for body in range(1, len(self._scene.objects) + 1):
            X_TCm = pybullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
            X_OCm = pybullet.getDynamicsInfo(body, -1, physicsClientId=self._client)[3:5]
            p, (x, y, z, w) = pybullet.multiplyTransforms(*X_TCm, *pybullet.invertTransform(*X_OCm))
            found.append(Pose(p, (w, x, y, z)))
        return found

    def settle(self, config: SettleConfig) -> tuple[float, bool]:
        """Seconds of stepping through 2 s, and whether everything stayed."""
        before = self._poses()
        first, _ = timed(self._step, 360)
        late = self._poses()
        last, _ = timed(self._step, 120)
        stable = all(
            max(abs(X.p[:2])) <= self._scene.tray_side / 2
            and X.p[2] >= 0
            and np.linalg.norm(X.p - X_before.p) < config.max_displacement
            and np.linalg.norm(X.p - X_late.p) <= config.rest_drift
            and tilt_between(o.object_class, X_before, X) < math.radians(config.max_tilt_deg)
            for o, X, X_before, X_late in zip(self._scene.objects, self._poses(), before, late, strict=True)
        )
        return first + last, stable


@dataclass
class Seen:
    """What an eye took for each scene, and the labels that it saw, if it makes an image."""

    seconds: list[float]
    images: list[Labels]

    def row(self, truth: "Seen") -> Row:
        """Its figures, and how many pixels are as in the truth."""
        pairs = list(zip(self.images, truth.images, strict=False))
        same = [np.mean((a == b)[(a >= 0) | (b >= 0)]) for a, b in pairs]
        return figures(self.seconds) | ({"same_pixels": float(np.mean(same))} if same else {})


def in_bullet(what: str, cases: Sequence[Case], config: ClutterConfig) -> tuple[Measured, Seen, list[float]]:
    """Has PyBullet look at scenes and settle them; also the seconds that loading took."""
    measured, seen, loads = Measured([], [], []), Seen([], []), []
    for case in track(cases, what, console=Console(stderr=True)):
        with tempfile.TemporaryDirectory() as folder:
            world = BulletWorld(case.start, Path(folder))
            loads.append(world.load_seconds)
            world.label(config.camera)
            seconds, image = timed(world.label, config.camera)
            seen.seconds.append(seconds)
            seen.images.append(image.astype(np.int16))
            seconds, stable = world.settle(config.settle)
            measured.seconds.append(seconds)
            measured.stable.append(stable)
            measured.hidden.append(None)
            world.close()
    return measured, seen, loads


def looked(draw: Callable[[Scene], T], scenes: Sequence[Scene], repeats: int = 1) -> tuple[list[float], list[T]]:
    """Seconds by scene, and what was seen before these, when each was drawn once without being timed."""
    first = [draw(scene) for scene in scenes]
    passes = [[timed(draw, scene)[0] for scene in scenes] for _ in range(repeats)]
    return np.median(passes, axis=0).tolist(), first


def ray_labels(rays: RayCaster, scene: Scene) -> Labels:
    """The whole label image, from one cast."""
    _, rectangle = rays._cast(scene.objects, None)
    image = np.full(rays._hit.shape, -1, np.int16)
    image[rectangle] = rays._hit[rectangle]
    return image


class Bench:
    """The judges and eyes, made once."""

    def __init__(self, config: ClutterConfig) -> None:
        accurate = replace(config, settle=replace(config.settle, calm_samples=NEVER))
        self._config = config
        self.fast, self._drake, self._accurate = FastJudge(config), DrakeJudge(config), DrakeJudge(accurate)

    def measure(self, what: str, cases: Sequence[Case], slow: int, accurate: bool) -> Row:
        """Figures by judge and by eye: of all cases, of Drake and PyBullet only for the first `slow`."""
        found = {}
        for name, before in ((FAST, self.fast._known.clear), (WARM, lambda: None)):
            found[name] = judged(f"{what}: {name}", self.fast, cases, len(cases), REPEATS, before)
        found[EARLY] = judged(f"{what}: {EARLY}", self._drake, cases[:slow], SLOW)
        if accurate:
            found[ACCURATE] = judged(f"{what}: {ACCURATE}", self._accurate, cases[:slow], SLOW)
        found[BULLET], tiny, loads = in_bullet(f"{what}: {BULLET}", cases[:slow], self._config)
        judges = {name: measured.row(found.get(ACCURATE)) for name, measured in found.items()}
        judges[BULLET]["load_mean_ms"] = 1000 * float(np.mean(loads))

        rays, camera = RayCaster(self._config.camera), OverheadCamera(self._config.camera)
        starts = [case.start for case in cases]
        seen = {
            VTK: Seen(*looked(lambda scene: camera.label(scene).astype(np.int16), starts)),
            RAYS: Seen(*looked(lambda scene: ray_labels(rays, scene), starts, REPEATS)),
            TINY: tiny,
            VTK_SHARES: Seen(looked(camera.visible_shares, starts)[0], []),
            RAY_SHARES: Seen(looked(lambda scene: rays.visible_shares(scene.objects), starts, REPEATS)[0], []),
        }
        return {"judges": judges, "eyes": {name: eye.row(seen[VTK]) for name, eye in seen.items()}}


def searched(cases: Sequence[Case], config: ClutterConfig) -> list[Row]:
    """The search on the stable scenes that hide something, by how many objects are hidden."""
    judge = FastJudge(config)
    search = FullKnowledgeSearch(config, judge)
    hiding = []
    for scene in (case.scene for case in cases if judge.stability(case.scene) is None):
        hidden = sum(share < config.camera.hidden_below for share in judge.rays.visible_shares(scene.objects).values())
        if hidden:
            hiding.append((hidden, scene))
    for _, scene in hiding[:SLOW]:
        search.solve(scene, budget=50)
    found = []
    for hidden, scene in track(hiding, "search", console=Console(stderr=True)):
        judge._known.clear()
        found.append((hidden, *timed(search.solve, scene, 0, BUDGET)))
    rows = []
    for name, (least, most) in HIDDEN.items():
        part = [(seconds, solution) for hidden, seconds, solution in found if least <= hidden <= most]
        row: Row = {"hidden": name, "count": len(part)}
        if part:
            row["median_s"] = float(np.median([seconds for seconds, _ in part]))
            row["max_s"] = max(seconds for seconds, _ in part)
            row["median_moves_tried"] = float(np.median([solution.moves_tried for _, solution in part]))
            row |= {answer.value: sum(solution.answer is answer for _, solution in part) / len(part) for answer in Answer}
        rows.append(row)
    return rows


def cpu() -> str:
    """The processor's model."""
    info = Path("/proc/cpuinfo")
    models = (
        [line.split(":")[1].strip() for line in info.read_text().splitlines() if "model name" in line] if info.exists() else []
    )
    return models[0] if models else platform.processor()


def show(result: Row, console: Console) -> None:
    """Prints the tables."""
    table = Table("ms per scene", "median", "mean", "p95", "scenes/s", "stable", "agrees", "on hidden", title=f"{NODES} nodes")
    for name, row in result["judges"].items():
        shares = [f"{row[key]:.3f}" if row.get(key) is not None else "" for key in ("stable_share", "agrees", "agrees_on_hidden")]
        table.add_row(name, *(f"{row[key]:.4g}" for key in ("median_ms", "mean_ms", "p95_ms", "per_second")), *shares)
    console.print(table)
    table = Table("ms per frame", "median", "mean", "p95", "frames/s", "same pixels", title=f"{NODES} nodes")
    for name, row in result["eyes"].items():
        pixels = f"{row['same_pixels']:.3f}" if "same_pixels" in row else ""
        table.add_row(name, *(f"{row[key]:.4g}" for key in ("median_ms", "mean_ms", "p95_ms", "per_second")), pixels)
    console.print(table)
    table = Table("mean ms", *(str(row["objects"]) for row in result["growth"]), title="by number of objects")
    for part in ("judges", "eyes"):
        for name in result["growth"][0][part]:
            table.add_row(name, *(f"{row[part][name]['mean_ms']:.4g}" for row in result["growth"]))
    console.print(table)
    table = Table("hidden", "scenes", "median s", "max s", "moves", *(answer.value for answer in Answer), title="search")
    for row in result["search"]:
        keys = ("median_s", "max_s", "median_moves_tried", *(answer.value for answer in Answer))
        table.add_row(row["hidden"], str(row["count"]), *(f"{row[key]:.3g}" if key in row else "" for key in keys))
    console.print(table)
    table = Table("target", "aim", "measured")
    for name, value in result["targets"].items():
        table.add_row(name, AIMS[name], "" if value is None else f"{value:.4g}")
    console.print(table)


def draw_growth(growth: Sequence[Row], path: Path) -> None:
    """Time by number of objects, of judges and of eyes."""
    plt.rcParams.update({"font.size": 17, "lines.linewidth": 2.5, "lines.markersize": 9})
    objects = [row["objects_mean"] for row in growth]
    figure, panels = plt.subplots(1, 2, figsize=(15, 7), layout="constrained")
    for panel, part, names, unit in (
        (panels[0], "judges", (BULLET, EARLY, FAST), "scene"),
        (panels[1], "eyes", (TINY, VTK, RAYS), "frame"),
    ):
        for name, marker in zip(names, "sDo", strict=True):
            panel.loglog(objects, [row[part][name]["mean_ms"] for row in growth], marker=marker, label=name)
        panel.set_xticks(objects, [f"{n:.0f}" for n in objects])
        panel.minorticks_off()
        panel.set(xlabel="objects in the scene", ylabel=f"mean time per {unit} (ms)")
        panel.grid(alpha=0.4)
        low, high = panel.get_ylim()
        panel.set_ylim(low, high * 8)  # room for the legend
        panel.legend(loc="upper left")
    figure.savefig(path, dpi=100)


def main(
    count: Annotated[int, typer.Option(help=f"Scenes of {NODES} nodes; of the other sizes no more than this.", min=2)] = 60,
    seed: int = 0,
    out: Annotated[Path | None, typer.Option(help="JSON to write.")] = None,
    picture: Annotated[Path | None, typer.Option(help="PNG to draw the growth with the number of objects in.")] = None,
) -> None:
    """Prints the tables and writes everything."""
    console = Console(file=os.fdopen(os.dup(1), "w"))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # where PyBullet complains, see docs/export.md
    if hasattr(os, "sched_setaffinity"):  # the renderers would start threads
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    began, config = time.monotonic(), ClutterConfig()
    packages = {name: version(name) for name in ("drake", "pybullet", "numba", "numpy", "scipy")}
    head = {"config": config_yaml(config), "seed": seed, "count": count, "commit": commit(), "cpu": cpu(), "notes": NOTES}
    result: Row = head | {"versions": {"python": platform.python_version()} | packages, "nodes": NODES}

    bench, rg = Bench(config), generator(NODES, config.layout.tray_side, seed)
    cases = []
    for index in range(count):
        rng = item_rng(seed, index)
        cases.append(Case(rg.lay_out(rng)[0], rng))
    result["objects_mean"] = float(np.mean([len(case.scene.objects) for case in cases]))
    result |= bench.measure(f"{NODES} nodes", cases, count, accurate=True)
    result["growth"] = []
    for size in SIZES:
        grown, share = half_stable(size, min(size.scenes, count), seed)
        row = {"objects": size.objects, "objects_mean": float(np.mean([len(case.scene.objects) for case in grown]))}
        row |= {"nodes": size.nodes, "tray_side": size.tray_side, "stable_share_of_drawn": share}
        result["growth"].append(row | bench.measure(f"{size.objects} objects", grown, SLOW, accurate=False))
    result["search"] = searched(cases, config)

    judges, sixteen = result["judges"], next(row for row in result["growth"] if row["objects"] == 16)["judges"][FAST]
    result["targets"] = {
        "fast_ms_16_objects": sixteen["median_ms"],
        "fast_ms_16_objects_stable": sixteen["stable_median_ms"],
        "ratio_to_pybullet": judges[BULLET]["mean_ms"] / judges[FAST]["mean_ms"],
        "drake_median_s": judges[EARLY]["median_ms"] / 1000,
        "drake_verdicts_unchanged": judges[EARLY]["unchanged"],
    }
    result["seconds"] = time.monotonic() - began
    if out is not None:
        write_json(out, result)
    if picture is not None:
        draw_growth(result["growth"], picture)
    show(result, console)


if __name__ == "__main__":
    typer.run(main)
