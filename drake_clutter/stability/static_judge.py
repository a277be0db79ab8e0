"""The judge that training needs: verdicts from equilibrium and rays, without simulating."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.interfaces import (
    InconclusiveReason,
    InconclusiveVerdict,
    Instability,
    InstabilityReason,
    Verdict,
)
from drake_clutter.scenes.scene import TRAY, Pose, Scene, SceneObject, sample_offsets
from drake_clutter.stability import contacts, equilibrium
from drake_clutter.stability.ray_caster import RayCaster
from drake_clutter.stability.shape_table import Floats, Ints, ShapeTable

CONSERVATIVE_FRICTION = 0.3
"""Coefficient of the friction that is relied on, of the 0.5 that there is: bodies at rest do not find every force that could
hold them."""
_ROUNDING_MARGIN = 5e-5
"""m, added to the margin: stacks that differ from balance by just the offsets' reach are common, since sizes are round."""
_TOUCHING_MARGIN = 0.003
"""m; objects further apart do not touch."""
_CACHE_RESOLUTION = 1e-6
"""m; stacks whose objects stand alike to within this share their verdict."""
_MARGIN_RANGE = (-0.030, 0.150)
_MARGIN_RESOLUTION = 1e-4
_MAX_CACHED_STACKS = 100_000
_KEY_BYTES_PER_OBJECT = 32
"""Bytes of a row of `equilibrium.canonical_order`."""
_INCONCLUSIVE_REASONS = {
    contacts.LEANING: InconclusiveReason.LEANING,
    contacts.NOT_CONVEX: InconclusiveReason.NOT_CONVEX,
    contacts.OUTSIDE: InconclusiveReason.OUTSIDE_TRAY,
    contacts.OVERLAPPING: InconclusiveReason.INTERPENETRATING,
    contacts.FLOATING: InconclusiveReason.FLOATING,
    contacts.EDGE: InconclusiveReason.EDGE_CONTACT,
    contacts.UNSUPPORTED: InconclusiveReason.UNSUPPORTED,
}


class _ContactGraph(NamedTuple):
    """See `contacts.find_contacts`."""

    shapes: Ints
    p_T: Floats
    pairs: Ints
    stack: Ints


class StaticStabilityJudge:
    """Says whether a scene can stand, by quasi-static equilibrium, and what its camera sees (a `SceneJudge`).

    Objects must be convex, level and in contact as scenes are laid out or come to rest; of others it says that it cannot
    judge. Contacts are shrunk by a margin: the most that the random offsets of two objects can take away. Verdicts are
    remembered by stack, wherever it stands on the tray: after a change, only the stacks that changed are judged again.
    """

    def __init__(
        self,
        config: ClutterConfig,
        margin: float | None = None,
        friction: float = CONSERVATIVE_FRICTION,
    ) -> None:
        """Makes a judge.

        Args:
            config: the world.
            margin: m, by which contacts are shrunk; None: twice the radius of the random offsets, and rounding.
            friction: coefficient that is relied on.
        """
        self._config = config
        self._margin, self._friction = (
            2 * config.settle.jitter + _ROUNDING_MARGIN if margin is None else margin,
            friction,
        )
        self._shapes = ShapeTable()
        self.ray_caster = RayCaster(config.cell.camera, self._shapes)
        self._cache: dict[bytes, tuple[int, int]] = {}  # see `_weakest`
        self._generation = 0

    def judge(self, scene: Scene, rng: np.random.Generator) -> Verdict | InconclusiveVerdict:
        """See `SceneJudge.judge`. The offsets move what the camera sees; what they do to balance, the margin stands for."""
        shapes, p_T = self._arrays(scene.objects)
        found = self._find_instability(scene, shapes, p_T)
        if isinstance(found, InconclusiveVerdict):
            return found
        moved = p_T + sample_offsets(len(p_T), self._config.settle.jitter, rng)
        settled = {
            o.name: Pose((x, y, z), o.X_TO.quaternion)
            for o, (x, y, z) in zip(scene.objects, moved.tolist(), strict=True)
        }
        if found is not None:
            return Verdict(found, settled, {}, ())
        shares = dict(
            zip(settled, self.ray_caster.visible_fractions_of_rows(shapes, moved), strict=True)
        )
        below = self._config.cell.camera.visibility_threshold
        return Verdict(
            None, settled, shares, tuple(name for name, share in shares.items() if share < below)
        )

    def find_instability(self, scene: Scene) -> Instability | InconclusiveVerdict | None:
        """What does not stand, or None if everything does."""
        return self._find_instability(scene, *self._arrays(scene.objects))

    def _find_instability(
        self, scene: Scene, shapes: Ints, p_T: Floats
    ) -> Instability | InconclusiveVerdict | None:
        standing = self._contact_graph(scene, shapes, p_T)
        if isinstance(standing, InconclusiveVerdict):
            if standing.reason is InconclusiveReason.UNSUPPORTED:
                return Instability(InstabilityReason.UNSUPPORTED, standing.object)
            return standing
        for weakest, rolls in self._least_stable_objects(standing, standing.stack):
            if weakest >= 0:
                reason = InstabilityReason.ROLLS if rolls else InstabilityReason.UNBALANCED
                return Instability(reason, scene.objects[weakest].name)
        return None

    def find_supports(self, scene: Scene) -> dict[str, frozenset[str]] | InconclusiveVerdict:
        """What each object stands on, by name; `TRAY` for the tray."""
        standing = self._contact_graph(scene, *self._arrays(scene.objects))
        if isinstance(standing, InconclusiveVerdict):
            return standing
        found: dict[str, set[str]] = {name: set() for name in scene.names}
        for lower, upper in standing.pairs.tolist():
            found[scene.names[upper]].add(TRAY if lower < 0 else scene.names[lower])
        return {name: frozenset(below) for name, below in found.items()}

    def contact_group(self, scene: Scene, name: str) -> Scene:
        """The named object and all that may touch it, directly or through others.

        Raises:
            KeyError: no such object.
        """
        scene[name]
        shapes, p_T = self._arrays(scene.objects)
        reached = contacts.connected_objects(
            self._shapes.arrays.records, shapes, p_T, scene.names.index(name), _TOUCHING_MARGIN
        )
        return replace(scene, objects=tuple(itertools.compress(scene.objects, reached)))

    def objects_losing_support(
        self, scene: Scene, name: str
    ) -> tuple[str, ...] | InconclusiveVerdict:
        """The objects, in the scene's order, that would not stay if the named one were taken away; its group alone is looked at.

        Of a stack that loses its balance these are what is furthest from equilibrium, without it the next, and so on.

        Raises:
            KeyError: no such object.
        """
        scene = self.contact_group(scene, name)
        standing = self._contact_graph(scene, *self._arrays(scene.objects))
        if isinstance(standing, InconclusiveVerdict):
            return standing
        shapes, _, pairs, stack = standing
        removed = scene.names.index(name)
        remaining = [
            row for row in np.flatnonzero(stack == stack[removed]).tolist() if row != removed
        ]
        falling = []
        while remaining:
            supported = {
                upper
                for lower, upper in pairs.tolist()
                if upper in remaining and (lower in remaining or lower < 0)
            }
            unsupported = [row for row in remaining if row not in supported]
            if not unsupported:
                ((weakest, _),) = self._least_stable_objects(
                    standing, _single_stack(remaining, len(shapes))
                )
                if weakest < 0:
                    break
                unsupported = [weakest]
            falling += unsupported
            remaining = [row for row in remaining if row not in unsupported]
        return tuple(scene.objects[row].name for row in sorted(falling))

    def stability_margins(self, scene: Scene) -> dict[str, float] | InconclusiveVerdict:
        """How much narrower the contacts under each object may become before its stack loses balance, m, by name.

        Under vertical forces. Negative: how much wider they would have to be. Known to 0.1 mm, within -30 and 150 mm. What rolls
        has none.
        """
        standing = self._contact_graph(scene, *self._arrays(scene.objects))
        if isinstance(standing, InconclusiveVerdict):
            return standing
        shapes, p_T, pairs, stack = standing
        found = {}
        for row, scene_object in enumerate(scene.objects):
            rows = np.flatnonzero(stack == stack[row])
            own, members = (
                int(np.flatnonzero(rows == row)[0]),
                _contacts_among(pairs, rows.tolist()),
            )
            low, high = _MARGIN_RANGE
            while high - low > _MARGIN_RESOLUTION / 2:
                margin = np.zeros(len(rows))
                margin[own] = (low + high) / 2
                aside = np.zeros((len(rows), 2))
                rest = equilibrium.equilibrium_residuals(
                    self._shapes.arrays.records,
                    shapes[rows],
                    p_T[rows],
                    members,
                    margin,
                    aside,
                    0.0,
                    equilibrium.NO_LOADS,
                )
                low, high = (low, margin[own]) if rest.max() > 0 else (margin[own], high)
            found[scene_object.name] = (
                round((low + high) / 2 / _MARGIN_RESOLUTION) * _MARGIN_RESOLUTION
            )
            ((weakest, rolls),) = self._least_stable_objects(
                standing, _single_stack(rows.tolist(), len(shapes))
            )
            if rolls and weakest == row:
                found[scene_object.name] = 0.0
        return found

    def is_disassemblable(self, scene: Scene) -> bool | InconclusiveVerdict:
        """Whether all objects can be taken away one by one, each with nothing on it, while what is left always stands."""
        standing = self._contact_graph(scene, *self._arrays(scene.objects))
        if isinstance(standing, InconclusiveVerdict):
            return standing
        pairs, dead_ends = standing.pairs.tolist(), set[frozenset[int]]()

        def can_be_emptied(rows: frozenset[int]) -> bool:
            if len(rows) < 2:
                return True
            loaded = {lower for lower, upper in pairs if upper in rows}
            for row in sorted(rows - loaded):
                rest = rows - {row}
                if rest not in dead_ends:
                    ((weakest, _),) = self._least_stable_objects(
                        standing, _single_stack(rest, len(standing.shapes))
                    )
                    if weakest < 0 and can_be_emptied(rest):
                        return True
            dead_ends.add(rows)
            return False

        return all(
            can_be_emptied(frozenset(np.flatnonzero(standing.stack == stack).tolist()))
            for stack in set(standing.stack.tolist())
        )

    def immovable_objects(self, scene: Scene) -> frozenset[str] | InconclusiveVerdict:
        """Objects that no sequence of moves can pick without a collapse, whatever is put down on the others before.

        The largest set of objects of which none can be taken away while the rest of the set stands: not even if the others,
        which may be gone by then, press straight down wherever the tops are free. (A bridge to another stack that pushes sideways
        is not thought of.) What is not in the set may still be impossible to move.
        """
        standing = self._contact_graph(scene, *self._arrays(scene.objects))
        if isinstance(standing, InconclusiveVerdict):
            return standing
        shapes, p_T, pairs, _ = standing
        fixed = set(range(len(shapes)))
        while True:
            free = [
                row
                for row in sorted(fixed)
                if self._could_be_removed(shapes, p_T, pairs, fixed, row)
            ]
            if not free:
                return frozenset(scene.objects[row].name for row in fixed)
            fixed -= set(free)

    def _could_be_removed(
        self, shapes: Ints, p_T: Floats, pairs: Ints, fixed: set[int], removed: int
    ) -> bool:
        """Whether the rest of the fixed objects could stand without one of them, what is not fixed helping."""
        stack = {removed}
        while True:  # all fixed objects that it is in contact with, directly or not
            more = {
                row
                for pair in pairs.tolist()
                if stack & set(pair) - {contacts.GROUND}
                for row in pair
                if row in fixed
            }
            if more <= stack:
                break
            stack |= more
        rest = sorted(stack - {removed})
        if not rest:
            return True
        records = self._shapes.arrays.records
        # What is not fixed holds like the ground does while it is there.
        number = {row: k for k, row in enumerate(rest)}
        held_pairs = [
            (number.get(a, contacts.GROUND), number[b])
            for a, b in pairs.tolist()
            if b in number and a != removed
        ]
        loads = [
            (x, y, p_T[row, 2] + records[shapes[row]]["top_z"], number[row])
            for row in rest
            for x, y in contacts.uncovered_top(
                records, shapes[row], shapes[removed], p_T[row], p_T[removed], self._margin
            )
        ]
        residuals = equilibrium.equilibrium_residuals(
            records,
            shapes[rest],
            p_T[rest],
            np.array(held_pairs, dtype=np.int64).reshape(-1, 2),
            np.full(len(rest), self._margin),
            np.zeros((len(rest), 2)),
            self._friction,
            np.array(loads).reshape(-1, 4),
        )
        return bool(residuals.max() == 0)

    def _contact_graph(
        self, scene: Scene, shapes: Ints, p_T: Floats
    ) -> "_ContactGraph | InconclusiveVerdict":
        """Who stands on whom, if all objects are within the model."""
        fault, culprit, pairs, stack = contacts.find_contacts(
            self._shapes.arrays.records, shapes, p_T, scene.support.half_size
        )
        if fault != contacts.NO_FAULT:
            return InconclusiveVerdict(_INCONCLUSIVE_REASONS[fault], scene.objects[culprit].name)
        return _ContactGraph(shapes, p_T, pairs, stack)

    def _arrays(self, objects: Sequence[SceneObject]) -> tuple[Ints, Floats]:
        arrays = self._shapes.rows_and_positions(objects)
        if self._generation != self._shapes.generation or len(self._cache) > _MAX_CACHED_STACKS:
            self._cache.clear()
            self._generation = self._shapes.generation
        return arrays

    def _least_stable_objects(
        self, standing: "_ContactGraph", stack: Ints
    ) -> list[tuple[int, bool]]:
        """For each stack, the row of what is furthest from equilibrium, or -1, and whether it rolls.

        `stack`: its number for each object; objects of stack -1 are not there.
        """
        order, first, described = equilibrium.canonical_order(
            standing.shapes, standing.p_T, stack, _CACHE_RESOLUTION
        )
        rows, starts, content = order.tolist(), first.tolist(), described.tobytes()
        keys = [
            content[start * _KEY_BYTES_PER_OBJECT : end * _KEY_BYTES_PER_OBJECT]
            for start, end in itertools.pairwise(starts)
        ]
        unknown = [k for k, key in enumerate(keys) if key not in self._cache]
        if unknown:
            table, options = self._shapes.arrays.records, (self._margin, self._friction)
            found = equilibrium.least_stable_objects(
                table, *standing[:3], order, first, np.array(unknown), *options
            )
            self._cache.update(
                zip((keys[k] for k in unknown), map(tuple, found.tolist()), strict=True)
            )
        answers = [self._cache[key] for key in keys]
        return [
            (rows[start + at] if at >= 0 else -1, bool(rolls))
            for start, (at, rolls) in zip(starts, answers, strict=False)
        ]


def _single_stack(rows: Iterable[int], count: int) -> Ints:
    """(count,) the number of a stack: 0 for these rows, -1, no stack, for the others."""
    stack = np.full(count, -1)
    stack[list(rows)] = 0
    return stack


def _contacts_among(pairs: Ints, rows: list[int]) -> Ints:
    """The contacts among the rows and with the tray, with the rows numbered as they stand in the list."""
    number = {row: k for k, row in enumerate(rows)} | {contacts.GROUND: contacts.GROUND}
    chosen = [
        (number[a], number[b]) for a, b in pairs.tolist() if a in number and b in number and b >= 0
    ]
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)
