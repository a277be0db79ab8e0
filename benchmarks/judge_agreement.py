"""Measure the agreement of the static stability model with Drake, and of Drake with itself.

    python benchmarks/collect_drake_verdicts.py FOLDER --workers 2
    python benchmarks/judge_agreement.py FOLDER --out judges.json --figure disagreements.png

The verdicts are compared on scenes of the random generator, and the outcomes of random moves.
"""

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import matplotlib.pyplot as plt
import numpy as np
import typer

from benchmarks.collect_drake_verdicts import (
    NUM_MOVES,
    SCENES_BY_BATCH,
    RandomMove,
    Record,
    SceneBatch,
    WorkerPool,
    collect_moves,
    collect_verdicts,
    execute,
    hidden_objects,
    moves_path,
)
from drake_clutter.files import write_json
from drake_clutter.records import read_jsonl
from drake_clutter.reports.scene_images import SceneRenderer
from drake_clutter.scenes.interfaces import (
    InconclusiveReason,
    InconclusiveVerdict,
    Instability,
    Move,
    MoveResult,
)
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Scene
from drake_clutter.stability.static_executor import StaticExecutor
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.statistics import wilson_interval
from drake_clutter.validation import to_plain
from training.evaluate_generators import verdict_name
from training.results_file import Row, provenance
from training.script import ResultsOption, print_table, progress, run_script

MARGINS = (0.0005, 0.001, 0.0015, 0.00205, 0.0025, 0.003, 0.004)
"""Margins of the static model that are compared [m]."""
FRICTIONS = (0.0, 0.3, 0.5)
"""Friction coefficients of the static model that are compared."""
NUM_PICTURES = 8
"""Number of disagreements in the figure."""
SAME_PLACE = 0.001
"""Distance along each axis within which two placements count as the same [m]."""


@dataclass
class Confusion:
    """Confusion matrix of the static model and Drake.

    Attributes:
        pairs: How often each pair of verdicts, static and Drake's, occurred.
    """

    pairs: Counter[tuple[str, str]] = field(default_factory=Counter)

    def metrics(self) -> Row:
        """Return the agreement over the conclusive verdicts, and the rate of each error."""
        judged = Counter({pair: n for pair, n in self.pairs.items() if pair[0] != "inconclusive"})
        equal = sum(n for (static, drake), n in judged.items() if static == drake)
        count = judged.total()
        total = self.pairs.total()
        num_unstable = sum(n for (_, drake), n in judged.items() if drake == "unstable")
        called_stable = sum(n for (static, _), n in judged.items() if static == "stable")
        false_stable = judged["stable", "unstable"]
        return {
            "count": total,
            "agreement": equal / count,
            "agreement_ci95": wilson_interval(equal, count),
            "inconclusive_fraction": 1 - count / total,
            "false_stable_rate": false_stable / count,
            "false_stable_of_unstable": false_stable / num_unstable if num_unstable else None,
            "false_stable_of_called_stable": false_stable / called_stable
            if called_stable
            else None,
            "false_unstable_rate": judged["unstable", "stable"] / count,
            "confusion": self.counts(),
        }

    def counts(self) -> dict[str, int]:
        """Return the matrix for a results file."""
        pairs = sorted(self.pairs.items())
        return {f"static {static}, Drake {drake}": n for (static, drake), n in pairs}


@dataclass(frozen=True)
class Disagreement:
    """A stack on which the verdicts differ.

    Attributes:
        scene: The scene with this stack only.
        static: The static model's reason of instability, or "stable".
        drake: Reason of the instability in Drake, or "stable".
    """

    scene: Scene
    static: str
    drake: str


@dataclass
class BatchComparison:
    """Comparison of the static model with Drake on a batch of scenes.

    Attributes:
        batch: The batch.
        scenes: Verdicts on whole scenes.
        stacks: Verdicts on the groups of objects that may touch.
        by_drake_reason: Verdicts on unstable groups by Drake's reason.
        by_class: Verdicts on unstable groups by the class of the object that is unstable in Drake.
        by_static_reason: Verdicts on groups that are not stable in the static model, by its reason.
        num_stable_in_both: Number of scenes that both call stable.
        num_same_hidden: Number of these with the same hidden objects.
        disagreements: The groups on which the verdicts differ.
    """

    batch: SceneBatch
    scenes: Confusion = field(default_factory=Confusion)
    stacks: Confusion = field(default_factory=Confusion)
    by_drake_reason: dict[str, Confusion] = field(default_factory=lambda: defaultdict(Confusion))
    by_class: dict[str, Confusion] = field(default_factory=lambda: defaultdict(Confusion))
    by_static_reason: dict[str, Confusion] = field(default_factory=lambda: defaultdict(Confusion))
    num_stable_in_both: int = 0
    num_same_hidden: int = 0
    disagreements: list[Disagreement] = field(default_factory=list)

    def run(self, records: Iterable[Record]) -> None:
        """Compare the verdicts on scenes.

        Args:
            records: Drake's records of the scenes.
        """
        config = self.batch.config
        judge = StaticStabilityJudge(config)
        threshold = config.cell.camera.visibility_threshold
        for record in records:
            scene, rng = self.batch.lay_out(record["index"])
            verdict = judge.judge(scene, rng)
            drake = "stable" if "settled" in record else "unstable"
            if isinstance(verdict, InconclusiveVerdict):
                self.scenes.pairs[verdict_name(verdict), drake] += 1
            else:
                self.scenes.pairs[verdict_name(verdict.instability), drake] += 1
                if verdict.stable and drake == "stable":
                    self.num_stable_in_both += 1
                    self.num_same_hidden += verdict.hidden == hidden_objects(record, threshold)
            for group in record["groups"]:
                self._compare_group(judge, scene, group, record["groups"])

    def _compare_group(
        self, judge: StaticStabilityJudge, scene: Scene, group: Row, all_groups: Sequence[Row]
    ) -> None:
        part = replace(scene, objects=tuple(scene[name] for name in group["objects"]))
        fall = group["fall"]
        verdict: Instability | InconclusiveVerdict | None = judge.find_instability(part)
        is_floating = (
            isinstance(verdict, InconclusiveVerdict)
            and verdict.reason is InconclusiveReason.FLOATING
        )
        if is_floating:  # The support is in another group: judge again with all stable groups.
            stable_names = [
                n for other in all_groups if not other["fall"] for n in other["objects"]
            ]
            stable_objects = tuple(scene[name] for name in stable_names)
            verdict = judge.find_instability(replace(scene, objects=part.objects + stable_objects))
        pair = verdict_name(verdict), "stable" if fall is None else "unstable"
        self.stacks.pairs[pair] += 1
        if fall is not None:
            reason, name, *_ = fall
            self.by_drake_reason[reason].pairs[pair] += 1
            self.by_class[scene[name].object_class.name].pairs[pair] += 1
        if verdict is not None:
            self.by_static_reason[verdict.reason.value].pairs[pair] += 1
        if pair[0] not in ("inconclusive", pair[1]):
            static = "stable" if verdict is None else str(verdict.reason.value)
            drake = str(fall[0]) if fall else "stable"
            self.disagreements.append(Disagreement(part, static, drake))

    def row(self) -> Row:
        """Return the row of the results."""
        both = self.num_stable_in_both
        return self.scenes.metrics() | {
            "hidden_agreement": self.num_same_hidden / both if both else None,
            "hidden_agreement_ci95": wilson_interval(self.num_same_hidden, both),
            "stacks": self.stacks.metrics(),
        }

    def details(self) -> dict[str, dict[str, dict[str, int]]]:
        """Return the confusion matrices by reason and by class."""
        parts = {
            "by_drake_reason": self.by_drake_reason,
            "by_class": self.by_class,
            "by_static_reason": self.by_static_reason,
        }
        return {
            key: {name: confusion.counts() for name, confusion in sorted(part.items())}
            for key, part in parts.items()
        }


def compare_variants(
    batch: SceneBatch, default: Sequence[Record], variant: Sequence[Record]
) -> Row:
    """Return how often Drake's verdicts on the same scenes agree under other settings.

    Args:
        batch: The batch with the other settings.
        default: Records of the scenes with the default settings.
        variant: Records of the scenes with the other settings.
    """
    pairs = list(zip(default, variant, strict=False))
    num_equal = sum(("settled" in a) == ("settled" in b) for a, b in pairs)
    falls = [(falls_by_object(a), falls_by_object(b)) for a, b in pairs]
    threshold = batch.config.cell.camera.visibility_threshold
    same_hidden = [
        hidden_objects(a, threshold) == hidden_objects(b, threshold)
        for a, b in pairs
        if "settled" in a and "settled" in b
    ]
    return {
        "count": len(pairs),
        "agreement": num_equal / len(pairs),
        "agreement_ci95": wilson_interval(num_equal, len(pairs)),
        "stacks_agreement": sum(x == y for a, b in falls for x, y in zip(a, b, strict=True))
        / sum(len(a) for a, _ in falls),
        "hidden_agreement": sum(same_hidden) / len(same_hidden),
        "hidden_agreement_ci95": wilson_interval(sum(same_hidden), len(same_hidden)),
    }


def falls_by_object(record: Record) -> list[bool]:
    """Return whether the group of each object is unstable, in the order of the names."""
    falls = {name: g["fall"] is not None for g in record["groups"] for name in g["objects"]}
    return [falls[name] for name in sorted(falls)]


def compare_moves(batch: SceneBatch, records: Sequence[Record], scenes: dict[int, Record]) -> Row:
    """Return how often the outcomes of moves agree.

    Args:
        batch: Batch of the scenes.
        records: Records of the moves in Drake.
        scenes: Records of the scenes by index.
    """
    config = batch.config
    judge = StaticStabilityJudge(config)
    executor = StaticExecutor(config, judge)
    outcomes = Counter[tuple[str, str]]()
    disagreements = defaultdict[str, Counter[str]](Counter)
    num_placed = num_same_place = 0
    for record in progress(records, "moves"):
        item = RandomMove(batch, record["index"], record["draw"], scenes[record["index"]])
        scene, rng = item.scene(), item.rng()
        observation, _ = judge.ray_caster.observe(scene)
        move = Move(*record["move"])
        command = resolve_placement(move, observation, config.exploration, rng)
        outcome = execute(executor, scene, command, rng)
        static = outcome.result.value
        outcomes[static, record["result"]] += 1
        if outcome.result is not MoveResult.INCONCLUSIVE and static != record["result"]:
            instability = outcome.instability
            cause = instability.reason.value if instability else static
            drake_cause = record["fall"][0] if record["fall"] else record["result"]
            disagreements[f"static: {cause}"][f"Drake: {drake_cause}"] += 1
        if command is not None and record["place"] is not None:
            num_placed += 1
            p, p_drake = command.X_TO_place.translation, record["place"][:3]
            distances = [abs(a - b) for a, b in zip(p, p_drake, strict=True)]
            num_same_place += max(distances) < SAME_PLACE
    judged = {pair: n for pair, n in outcomes.items() if pair[0] != MoveResult.INCONCLUSIVE.value}
    num_equal = sum(n for (static, drake), n in judged.items() if static == drake)
    count = sum(judged.values())
    return {
        "count": outcomes.total(),
        "agreement": num_equal / count,
        "agreement_ci95": wilson_interval(num_equal, count),
        "inconclusive_fraction": 1 - count / outcomes.total(),
        "false_placed_rate": outcomes[MoveResult.PLACED.value, MoveResult.COLLAPSED.value] / count,
        "same_placement_fraction": num_same_place / num_placed,
        "confusion": {f"static {a}, Drake {b}": n for (a, b), n in sorted(outcomes.items())},
        "disagreements": {cause: dict(counts) for cause, counts in disagreements.items()},
    }


def measure_sensitivity(batch: SceneBatch, records: Sequence[Record]) -> list[Row]:
    """Return the agreement on scenes with other margins and friction coefficients."""
    scenes = [batch.lay_out(record["index"])[0] for record in records]
    rows = []
    settings = list(itertools.product(MARGINS, FRICTIONS))
    for margin, friction in progress(settings, "margins and friction coefficients"):
        judge = StaticStabilityJudge(batch.config, margin, friction)
        confusion = Confusion()
        for scene, record in zip(scenes, records, strict=True):
            drake = "stable" if "settled" in record else "unstable"
            confusion.pairs[verdict_name(judge.find_instability(scene)), drake] += 1
        metrics = confusion.metrics()
        rates = {
            key: metrics[key] for key in ("agreement", "false_stable_rate", "false_unstable_rate")
        }
        rows.append({"margin_mm": 1000 * margin, "friction": friction} | rates)
    return rows


def draw_disagreements(disagreements: Sequence[Disagreement], path: Path) -> None:
    """Render stacks on which the verdicts differ, one of each kind, false stable verdicts first."""
    by_kind = dict[Any, Disagreement]()
    for item in disagreements:
        classes = tuple(sorted(o.object_class.name for o in item.scene.objects))
        by_kind.setdefault((item.static, item.drake, classes), item)
    shown = sorted(by_kind.values(), key=lambda item: item.static != "stable")[:NUM_PICTURES]
    renderer = SceneRenderer()
    figure, axes = plt.subplots(2, NUM_PICTURES // 2, figsize=(14, 8.4), layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, item in zip(axes.flat, shown, strict=False):
        x, y, _ = np.mean([o.X_TO.translation for o in item.scene.objects], axis=0)
        centered = tuple(
            replace(o, X_TO=o.X_TO.translated((-x, -y, 0.0))) for o in item.scene.objects
        )
        picture = renderer.render_oblique(replace(item.scene, objects=centered, graph=None))
        axis.imshow(picture[:520, 230:750])
        axis.set_title(f"static judge: {item.static}\nDrake: {item.drake}", fontsize=13)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def show_results(results: Row) -> None:
    """Print the tables."""
    rows = [
        {
            "objects": row["objects"],
            "nodes": row["nodes"],
            "scenes": row["count"],
            "agreement": f"{row['agreement']:.3f}",
            "95 % interval": "{:.3f} to {:.3f}".format(*row["agreement_ci95"]),
            "false stable": f"{row['false_stable_rate']:.3f}",
            "inconclusive": f"{row['inconclusive_fraction']:.3f}",
            "hidden objects agree": f"{row['hidden_agreement']:.3f}",
        }
        for row in results["scenes"]
    ]
    print_table(rows, "Static model and Drake")
    rows = [
        {
            "settings of Drake": row["variant"],
            "scenes": row["count"],
            "agreement": f"{row['agreement']:.3f}",
            "on stacks": f"{row['stacks_agreement']:.3f}",
            "hidden objects agree": f"{row['hidden_agreement']:.3f}",
        }
        for row in results["drake_variants"]
    ]
    print_table(rows, "Drake and Drake with other settings")
    moves = results["moves"]
    print(f"moves: agreement {moves['agreement']:.3f} of {moves['count']}")
    print(moves["confusion"], moves["disagreements"])


def main(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder that collect_drake_verdicts.py wrote.")
    ],
    out: ResultsOption = None,
    figure: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Image of stacks on which the verdicts differ (PNG)."),
    ] = None,
) -> None:
    """Compare the verdicts, and print and write the results."""
    pool = WorkerPool()
    records = {
        batch: collect_verdicts(batch, count, folder, pool)
        for batch, count in SCENES_BY_BATCH.items()
    }
    (first, num_scenes), *_ = SCENES_BY_BATCH.items()
    moves = collect_moves(first, num_scenes, NUM_MOVES, folder, pool)
    agreement = list[Row]()
    self_agreement = list[Row]()
    details = dict[str, Any]()
    disagreements = list[Disagreement]()
    for batch, batch_records in records.items():
        header = read_jsonl(folder / f"{batch.name}.jsonl.gz")[0]
        key = {
            "objects": batch.objects,
            "nodes": batch.nodes,
            "seed": batch.seed,
            "drake_commit": header["commit"],
        }
        if batch.variant == "default":
            comparison = BatchComparison(batch)
            comparison.run(progress(batch_records, f"{batch.objects}, {batch.nodes} nodes"))
            agreement.append(key | comparison.row())
            details[f"{batch.objects}, {batch.nodes} nodes"] = comparison.details()
            disagreements += comparison.disagreements
        else:
            default = records[replace(batch, variant="default")]
            variant_row = {"variant": batch.variant} | compare_variants(
                batch, default, batch_records
            )
            self_agreement.append(key | variant_row)
    by_index = {record["index"]: record for record in records[first]}
    moves_header = read_jsonl(moves_path(first, folder))[0]
    moves_row = {"drake_commit": moves_header["commit"]} | compare_moves(first, moves, by_index)

    def by_size(key: str) -> dict[str, float]:
        return {f"{row['objects']}, {row['nodes']} nodes": row[key] for row in agreement}

    results: Row = {
        **provenance(),
        "config": to_plain(first.config),
        "scene_agreement": by_size("agreement"),
        "false_stable_rate": by_size("false_stable_rate"),
        "hidden_agreement": by_size("hidden_agreement"),
        "move_agreement": moves_row["agreement"],
        "drake_self_agreement": {row["variant"]: row["agreement"] for row in self_agreement},
        "scenes": agreement,
        "moves": moves_row,
        "drake_variants": self_agreement,
        "sensitivity": measure_sensitivity(first, records[first]),
        "details": details,
    }
    if out is not None:
        write_json(out, results)
    if figure is not None:
        draw_disagreements(disagreements, figure)
    show_results(results)


if __name__ == "__main__":
    run_script(main)
