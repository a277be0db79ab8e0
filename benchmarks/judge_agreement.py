"""How far the fast judge and executor agree with Drake, and Drake with itself, on RG scenes and random moves.

python benchmarks/collect_drake_verdicts.py FOLDER --workers 2     # Drake's side, about an hour and a half; resumes
python benchmarks/judge_agreement.py FOLDER --out benchmarks/results/judges.json --picture docs/images/judges_disagree.png
"""

import itertools
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.collect_drake_verdicts import (
    BATCHES,
    MOVES,
    Batch,
    Pool,
    RandomMove,
    config_of,
    drake_moves,
    drake_verdicts,
    hidden,
    laid_out,
    move_rng,
    settled_scene,
)
from drake_clutter.files import write_json
from drake_clutter.reports.scene_images import SceneRenderer
from drake_clutter.resources import git_commit
from drake_clutter.scenes.interfaces import (
    InconclusiveReason,
    InconclusiveVerdict,
    Move,
    MoveResult,
    Outcome,
)
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Scene
from drake_clutter.stability.static_executor import StaticExecutor
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.statistics import wilson_interval

MARGINS = (0.0005, 0.001, 0.0015, 0.00205, 0.0025, 0.003, 0.004)
FRICTIONS = (0.0, 0.3, 0.5)
SHOWN = 8
"""Disagreements in the picture."""


@dataclass
class Confusion:
    """Verdicts of two judges on the same things: (the fast one's, Drake's), each with how often."""

    pairs: Counter[tuple[str, str]] = field(default_factory=Counter)

    def row(self) -> dict[str, Any]:
        """Agreement over what was judged, with 95 % interval, and each kind of error."""
        judged = Counter({pair: n for pair, n in self.pairs.items() if pair[0] != "cannot judge"})
        equal = sum(n for (fast, drake), n in judged.items() if fast == drake)
        count, total = judged.total(), self.pairs.total()
        falling = sum(n for (_, drake), n in judged.items() if drake == "falls")
        called_stable = sum(n for (fast, _), n in judged.items() if fast == "stable")
        false_stable = judged["stable", "falls"]
        return {
            "count": total,
            "agreement": equal / count,
            "agreement_ci95": wilson_interval(equal, count),
            "cannot_judge_share": 1 - count / total,
            "false_stable_rate": false_stable / count,
            "false_stable_of_falling": false_stable / falling if falling else None,
            "false_stable_of_called_stable": false_stable / called_stable
            if called_stable
            else None,
            "false_fall_rate": judged["falls", "stable"] / count,
            "confusion": {
                f"fast {fast}, drake {drake}": n for (fast, drake), n in sorted(self.pairs.items())
            },
        }


@dataclass
class Disagreement:
    """A stack of which the judges say different things, for the picture."""

    objects: Scene
    fast: str
    drake: str


def said(found: Any) -> str:
    """One word for what a judge found."""
    return (
        "cannot judge"
        if isinstance(found, InconclusiveVerdict)
        else "stable"
        if found is None
        else "falls"
    )


def compare_scenes(
    batch: Batch, records: Sequence[dict[str, Any]], disagreements: list[Disagreement]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The row of a batch, and its confusions by reason and by class."""
    config = config_of(batch)
    judge = StaticStabilityJudge(config)
    scenes, stacks = Confusion(), Confusion()
    by_reason: dict[str, Confusion] = defaultdict(Confusion)
    by_class: dict[str, Confusion] = defaultdict(Confusion)
    fast_reasons: dict[str, Confusion] = defaultdict(Confusion)
    same_hidden = both_stable = 0
    for record in track(records, f"{batch.objects} {batch.nodes}", console=Console(stderr=True)):
        scene, rng = laid_out(batch, record["index"])
        verdict = judge.judge(scene, rng)
        found = verdict if isinstance(verdict, InconclusiveVerdict) else verdict.instability
        drake = "stable" if "settled" in record else "falls"
        scenes.pairs[said(found), drake] += 1
        if not isinstance(verdict, InconclusiveVerdict) and verdict.stable and drake == "stable":
            both_stable += 1
            same_hidden += verdict.hidden == hidden(record, config.cell.camera.visibility_threshold)
        for group in record["groups"]:
            part = replace(scene, objects=tuple(scene[name] for name in group["objects"]))
            fall = group["fall"]
            whole = judge.find_instability(part)
            if (
                isinstance(whole, InconclusiveVerdict)
                and whole.reason is InconclusiveReason.FLOATING
            ):
                # What it misses stands in another group: asked again together with all that stands.
                standing = tuple(
                    scene[n]
                    for other in record["groups"]
                    if not other["fall"]
                    for n in other["objects"]
                )
                whole = judge.find_instability(replace(scene, objects=part.objects + standing))
            pair = said(whole), "stable" if fall is None else "falls"
            stacks.pairs[pair] += 1
            if fall is not None:
                by_reason[fall[0]].pairs[pair] += 1
                by_class[scene[fall[1]].object_class.name].pairs[pair] += 1
            if whole is not None:
                fast_reasons[whole.reason.value].pairs[pair] += 1
            if pair[0] not in ("cannot judge", pair[1]):
                why = f"falls: {fall[0]}" if fall else "stable"
                disagreements.append(
                    Disagreement(part, "stable" if whole is None else str(whole.reason.value), why)
                )
    row = scenes.row() | {
        "hidden_agreement": same_hidden / both_stable if both_stable else None,
        "hidden_agreement_ci95": wilson_interval(same_hidden, both_stable),
        "stacks": stacks.row(),
    }
    details = {
        "by_drakes_reason": {
            reason: dict_of(confusion) for reason, confusion in sorted(by_reason.items())
        },
        "by_class_that_falls": {
            name: dict_of(confusion) for name, confusion in sorted(by_class.items())
        },
        "by_the_fast_judges_reason": {
            reason: dict_of(confusion) for reason, confusion in sorted(fast_reasons.items())
        },
    }
    return row, details


def dict_of(confusion: Confusion) -> dict[str, int]:
    """For JSON."""
    return {
        f"fast {fast}, drake {drake}": n for (fast, drake), n in sorted(confusion.pairs.items())
    }


def compare_variants(
    batch: Batch, default: Sequence[dict[str, Any]], other: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """How often Drake, asked in another way, says the same of the same scenes."""
    pairs = list(zip(default, other, strict=False))
    equal = [("settled" in a) == ("settled" in b) for a, b in pairs]
    falls = [(fall(a), fall(b)) for a, b in pairs]
    below = config_of(batch).cell.camera.visibility_threshold
    lists = [
        hidden(a, below) == hidden(b, below) for a, b in pairs if "settled" in a and "settled" in b
    ]
    return {
        "count": len(pairs),
        "agreement": sum(equal) / len(pairs),
        "agreement_ci95": wilson_interval(sum(equal), len(pairs)),
        "stacks_agreement": sum(x == y for a, b in falls for x, y in zip(a, b, strict=True))
        / sum(len(a) for a, _ in falls),
        "hidden_agreement": sum(lists) / len(lists),
        "hidden_agreement_ci95": wilson_interval(sum(lists), len(lists)),
    }


def fall(record: dict[str, Any]) -> list[bool]:
    """Whether each object's stack falls, in the order of the names."""
    return [
        falls
        for _, falls in sorted(
            (name, g["fall"] is not None) for g in record["groups"] for name in g["objects"]
        )
    ]


def compare_moves(
    batch: Batch, records: Sequence[dict[str, Any]], scenes: dict[int, dict[str, Any]]
) -> dict[str, Any]:
    """Outcomes of random moves under the fast executor, each on its own observation, against Drake's."""
    config = config_of(batch)
    judge = StaticStabilityJudge(config)
    executor = StaticExecutor(config, judge)
    outcomes: Counter[tuple[str, str]] = Counter()
    by_reason: dict[str, Counter[str]] = defaultdict(Counter)
    same_place = placed = 0
    for record in track(records, "moves", console=Console(stderr=True)):
        item = RandomMove(batch, record["index"], record["draw"], scenes[record["index"]])
        scene = settled_scene(laid_out(batch, item.index)[0], item.record)
        observation, _ = judge.ray_caster.observe(scene)
        pick, place = record["move"]
        rng = move_rng(item)
        command = resolve_placement(Move(pick, place), observation, config.exploration, rng)
        outcome = (
            Outcome(MoveResult.NO_FREE_PLACEMENT, scene)
            if command is None
            else executor.execute(
                scene,
                command,
                rng,
            )
        )
        outcomes[outcome.result.value, record["result"]] += 1
        if (
            outcome.result is not MoveResult.INCONCLUSIVE
            and outcome.result.value != record["result"]
        ):
            found = (
                outcome.instability.reason.value if outcome.instability else outcome.result.value
            )
            by_reason[f"fast: {found}"][
                f"drake: {record['fall'][0] if record['fall'] else record['result']}"
            ] += 1
        if command is not None and record["place"] is not None:
            placed += 1
            where = command.X_TO_place.translation
            apart = (abs(a - b) for a, b in zip(where, record["place"][:3], strict=True))
            same_place += max(apart) < 0.001
    judged = {pair: n for pair, n in outcomes.items() if pair[0] != MoveResult.INCONCLUSIVE.value}
    equal, count = sum(n for (a, b), n in judged.items() if a == b), sum(judged.values())
    return {
        "count": sum(outcomes.values()),
        "agreement": equal / count,
        "agreement_ci95": wilson_interval(equal, count),
        "cannot_judge_share": 1 - count / sum(outcomes.values()),
        "false_placed_rate": outcomes[MoveResult.PLACED.value, MoveResult.COLLAPSED.value] / count,
        "same_place_share": same_place / placed,
        "confusion": {f"fast {a}, drake {b}": n for (a, b), n in sorted(outcomes.items())},
        "disagreements": {a: dict(b) for a, b in by_reason.items()},
    }


def sensitivity(batch: Batch, records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """What other margins and coefficients of friction would have said of the same scenes."""
    scenes = [laid_out(batch, record["index"])[0] for record in records]
    rows = []
    for margin, friction in itertools.product(MARGINS, FRICTIONS):
        judge, confusion = StaticStabilityJudge(config_of(batch), margin, friction), Confusion()
        for scene, record in zip(scenes, records, strict=True):
            confusion.pairs[
                said(judge.find_instability(scene)), "stable" if "settled" in record else "falls"
            ] += 1
        row = confusion.row()
        rates = {key: row[key] for key in ("agreement", "false_stable_rate", "false_fall_rate")}
        rows.append({"margin_mm": 1000 * margin, "friction": friction} | rates)
    return rows


def draw(path: Path, disagreements: Sequence[Disagreement]) -> None:
    """A picture of stacks that the judges see differently, at most one of each kind and shape first."""
    seen: set[Any] = set()
    chosen: list[Disagreement] = []
    for item in disagreements:
        kind = (
            item.fast,
            item.drake,
            tuple(sorted(o.object_class.name for o in item.objects.objects)),
        )
        if kind not in seen:
            seen.add(kind)
            chosen.append(item)
    chosen = sorted(chosen, key=lambda item: item.fast != "stable")[:SHOWN]
    camera = SceneRenderer()
    figure, axes = plt.subplots(2, SHOWN // 2, figsize=(14, 8.4), layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, item in zip(axes.flat, chosen, strict=False):
        x, y, _ = np.mean([o.X_TO.translation for o in item.objects.objects], axis=0)
        centred = tuple(
            replace(o, X_TO=o.X_TO.translated((-x, -y, 0.0))) for o in item.objects.objects
        )
        picture = camera.render_oblique(replace(item.objects, objects=centred, graph=None))
        axis.imshow(picture[110:510, 290:690])
        axis.set_title(f"fast: {item.fast}\nDrake: {item.drake}", fontsize=13)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def main(
    folder: Annotated[Path, typer.Argument(help="What collect_drake_verdicts.py wrote.")],
    out: Annotated[Path | None, typer.Option(help="JSON to write.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="PNG of stacks that the judges see differently.")
    ] = None,
) -> None:
    """Prints and writes the tables."""
    disagreements: list[Disagreement] = []
    sides = {
        batch: list(drake_verdicts(batch, count, folder, Pool()))
        for batch, count in BATCHES.items()
    }
    (first, scenes), *_ = BATCHES.items()
    moves = list(drake_moves(first, scenes, MOVES, folder, Pool()))
    agreement, details, itself = [], {}, []
    for batch, (head, *records) in sides.items():
        key = {
            "objects": batch.objects,
            "nodes": batch.nodes,
            "seed": batch.seed,
            "drake_commit": head["commit"],
        }
        if batch.variant == "default":
            row, found = compare_scenes(batch, records, disagreements)
            agreement.append(key | row)
            details[f"{batch.objects}, {batch.nodes} nodes"] = found
        else:
            default = sides[replace(batch, variant="default")][1:]
            itself.append(
                key | {"variant": batch.variant} | compare_variants(batch, default, records)
            )
    by_index = {record["index"]: record for record in sides[first][1:]}
    of_moves = {"drake_commit": moves[0]["commit"]} | compare_moves(first, moves[1:], by_index)
    result = {
        "commit": git_commit(),
        "config": sides[first][0]["config"],
        "scene_agreement": {
            f"{r['objects']}, {r['nodes']} nodes": r["agreement"] for r in agreement
        },
        "false_stable_rate": {
            f"{r['objects']}, {r['nodes']} nodes": r["false_stable_rate"] for r in agreement
        },
        "hidden_agreement": {
            f"{r['objects']}, {r['nodes']} nodes": r["hidden_agreement"] for r in agreement
        },
        "move_agreement": of_moves["agreement"],
        "drake_self_agreement": {row["variant"]: row["agreement"] for row in itself},
        "scenes": agreement,
        "moves": of_moves,
        "drake_itself": itself,
        "sensitivity": sensitivity(first, sides[first][1:]),
        "details": details,
    }
    if out is not None:
        write_json(out, result)
    if picture is not None:
        draw(picture, disagreements)
    show(agreement, itself, of_moves)


def show(
    agreement: Sequence[dict[str, Any]], itself: Sequence[dict[str, Any]], of_moves: dict[str, Any]
) -> None:
    """The tables."""
    table = Table(
        "objects",
        "nodes",
        "scenes",
        "verdicts",
        "95 %",
        "false stable",
        "cannot judge",
        "hidden lists",
        title="fast, Drake",
    )
    for row in agreement:
        low, high = row["agreement_ci95"]
        shares = [
            f"{row[key]:.3f}"
            for key in ("false_stable_rate", "cannot_judge_share", "hidden_agreement")
        ]
        numbers = (
            str(row["nodes"]),
            str(row["count"]),
            f"{row['agreement']:.3f}",
            f"{low:.3f} to {high:.3f}",
        )
        table.add_row(row["objects"], *numbers, *shares)
    Console().print(table)
    table = Table(
        "Drake, asked with",
        "scenes",
        "verdicts",
        "stacks",
        "hidden lists",
        title="Drake and itself",
    )
    for row in itself:
        shares = [
            f"{row[key]:.3f}" for key in ("agreement", "stacks_agreement", "hidden_agreement")
        ]
        table.add_row(row["variant"], str(row["count"]), *shares)
    Console().print(table)
    print(
        f"moves: {of_moves['agreement']:.3f} of {of_moves['count']}",
        of_moves["confusion"],
        of_moves["disagreements"],
    )


if __name__ == "__main__":
    typer.run(main)
