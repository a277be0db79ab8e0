"""A judge that solves static equilibrium and casts rays instead of simulating."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drake_clutter.catalog import Shape
from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.geometry import penetration_depth
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
"""Coefficient of friction on which a stable scene may rely.

It is below `SURFACE_FRICTION` (0.5) of the simulation: contact forces that could hold an object do
not always arise.
"""
_ROUNDING_MARGIN = 5e-5
"""Addition to the contact margin [m].

Sizes are round numbers, so stacks whose balance equals the reach of the random offsets are common.
"""
_TOUCHING_MARGIN = 0.003
"""Objects farther apart than this do not touch [m]."""
_CACHE_RESOLUTION = 1e-6
"""Stacks with relative positions equal to within this share a result [m]."""
_MARGIN_RANGE = (-0.030, 0.150)
"""Range of the margins that `stability_margins` can return [m]."""
_MARGIN_RESOLUTION = 1e-4
"""Resolution of the margins that `stability_margins` returns [m]."""
_MAX_CACHED_STACKS = 100_000
"""Number of stacks after which the cache is emptied."""
_KEY_BYTES_PER_OBJECT = 32
"""Bytes of a row of the description that `equilibrium.canonical_order` returns."""
_INCONCLUSIVE_REASONS = {
    contacts.LEANING: InconclusiveReason.LEANING,
    contacts.OUTSIDE: InconclusiveReason.OUTSIDE_TRAY,
    contacts.OVERLAPPING: InconclusiveReason.INTERPENETRATING,
    contacts.FLOATING: InconclusiveReason.FLOATING,
    contacts.EDGE: InconclusiveReason.EDGE_CONTACT,
    contacts.UNSUPPORTED: InconclusiveReason.UNSUPPORTED,
}


class _ContactGraph(NamedTuple):
    """Objects and their contacts, see `contacts.find_contacts`.

    Attributes:
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        pairs: Lower and upper object of each contact. Shape (c, 2).
        stack: Number of the stack of each object. Shape (n,).
    """

    shapes: Ints
    p_T: Floats
    pairs: Ints
    stack: Ints


class StaticStabilityJudge:
    """Judges scenes by quasi-static equilibrium and ray casting (a `SceneJudge`).

    Objects must be level, and in contact as laid-out or settled scenes are; the verdict on other
    scenes is inconclusive. Objects that are not convex are judged by their convex pieces. Contact
    areas are shrunk by a margin, the most that the random offsets of two objects can remove.
    Results are cached by stack, independent of its position on the support, so that after a change
    only the changed stacks are solved again.

    Attributes:
        ray_caster: The caster for the camera, which shares the table of shapes.
    """

    def __init__(
        self,
        config: ClutterConfig,
        margin: float | None = None,
        friction: float = CONSERVATIVE_FRICTION,
    ) -> None:
        """Create a judge.

        Args:
            config: The simulated world.
            margin: Width by which contacts are shrunk [m]; by default twice the radius of the
                random offsets, plus rounding.
            friction: Coefficient of friction on which a stable scene may rely.
        """
        self._config = config
        default_margin = 2 * config.settle.jitter + _ROUNDING_MARGIN
        self._margin = default_margin if margin is None else margin
        self._friction = friction
        self._shapes = ShapeTable()
        self.ray_caster = RayCaster(config.cell.camera, self._shapes)
        self._cache: dict[bytes, tuple[int, int]] = {}
        self._generation = 0

    def judge(self, scene: Scene, rng: np.random.Generator) -> Verdict | InconclusiveVerdict:
        """Return the verdict; see `SceneJudge.judge`.

        The random offsets move what the camera sees. Their effect on the balance is covered by the
        margin.
        """
        shapes, p_T = self._arrays(scene.objects)
        instability = self._find_instability(scene, shapes, p_T)
        if isinstance(instability, InconclusiveVerdict):
            return instability
        moved = p_T + sample_offsets(len(p_T), self._config.settle.jitter, rng)
        settled = {
            o.name: Pose((x, y, z), o.X_TO.quaternion)
            for o, (x, y, z) in zip(scene.objects, moved.tolist(), strict=True)
        }
        if instability is not None:
            return Verdict(instability, settled, {}, ())
        visible = self.ray_caster.visible_fractions_of_rows(shapes, moved)
        fractions = dict(zip(settled, visible, strict=True))
        threshold = self._config.cell.camera.visibility_threshold
        hidden = tuple(name for name, fraction in fractions.items() if fraction < threshold)
        return Verdict(None, settled, fractions, hidden)

    def find_instability(self, scene: Scene) -> Instability | InconclusiveVerdict | None:
        """Return the first object that does not stand, or None if all do."""
        return self._find_instability(scene, *self._arrays(scene.objects))

    def _find_instability(
        self, scene: Scene, shapes: Ints, p_T: Floats
    ) -> Instability | InconclusiveVerdict | None:
        """Return the first object that does not stand, see `find_instability`."""
        graph = self._contact_graph(scene, shapes, p_T)
        if isinstance(graph, InconclusiveVerdict):
            if graph.reason is InconclusiveReason.UNSUPPORTED:
                return Instability(InstabilityReason.UNSUPPORTED, graph.object)
            return graph
        for least_stable, rolls in self._least_stable_objects(graph, graph.stack):
            if least_stable >= 0:
                reason = InstabilityReason.ROLLS if rolls else InstabilityReason.UNBALANCED
                return Instability(reason, scene.objects[least_stable].name)
        return None

    def find_supports(self, scene: Scene) -> dict[str, frozenset[str]] | InconclusiveVerdict:
        """Return what each object stands on, by name; `TRAY` for the support."""
        graph = self._contact_graph(scene, *self._arrays(scene.objects))
        if isinstance(graph, InconclusiveVerdict):
            return graph
        supports: dict[str, set[str]] = {name: set() for name in scene.names}
        for lower, upper in graph.pairs.tolist():
            supports[scene.names[upper]].add(TRAY if lower < 0 else scene.names[lower])
        return {name: frozenset(below) for name, below in supports.items()}

    def contact_group(self, scene: Scene, name: str) -> Scene:
        """Return the part of a scene that an object may touch, directly or indirectly.

        Raises:
            KeyError: No object has this name.
        """
        scene[name]
        shapes, p_T = self._arrays(scene.objects)
        reached = contacts.connected_objects(
            self._shapes.arrays.table, shapes, p_T, scene.names.index(name), _TOUCHING_MARGIN
        )
        return replace(scene, objects=tuple(itertools.compress(scene.objects, reached)))

    def objects_losing_support(
        self, scene: Scene, name: str
    ) -> tuple[str, ...] | InconclusiveVerdict:
        """Return the objects that would fall if an object were removed.

        They are in the scene's order. Of an unbalanced stack, the object farthest from equilibrium
        falls, then the next one without it, until the rest stands. Only the object's contact group
        is examined.

        Raises:
            KeyError: No object has this name.
        """
        scene = self.contact_group(scene, name)
        graph = self._contact_graph(scene, *self._arrays(scene.objects))
        if isinstance(graph, InconclusiveVerdict):
            return graph
        shapes, _, pairs, stack = graph
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
                ((least_stable, _),) = self._least_stable_objects(
                    graph, _single_stack(remaining, len(shapes))
                )
                if least_stable < 0:
                    break
                unsupported = [least_stable]
            falling += unsupported
            remaining = [row for row in remaining if row not in unsupported]
        return tuple(scene.objects[row].name for row in sorted(falling))

    def stability_margins(self, scene: Scene) -> dict[str, float] | InconclusiveVerdict:
        """Return by how much the contacts below each object may shrink [m].

        At the margin, the object's stack loses its balance. Only vertical forces count. A negative
        margin is the missing width. Margins are exact to 0.1 mm within -30 to 150 mm. An object
        that can roll has margin 0.
        """
        graph = self._contact_graph(scene, *self._arrays(scene.objects))
        if isinstance(graph, InconclusiveVerdict):
            return graph
        shapes, p_T, pairs, stack = graph
        margins = {}
        for row, scene_object in enumerate(scene.objects):
            rows = np.flatnonzero(stack == stack[row])
            own = int(np.flatnonzero(rows == row)[0])
            members = _contacts_among(pairs, rows.tolist())
            low, high = _MARGIN_RANGE
            while high - low > _MARGIN_RESOLUTION / 2:  # bisection
                margin = np.zeros(len(rows))
                margin[own] = (low + high) / 2
                com_offsets = np.zeros((len(rows), 2))
                residuals = equilibrium.equilibrium_residuals(
                    self._shapes.arrays.table,
                    shapes[rows],
                    p_T[rows],
                    members,
                    margin,
                    com_offsets,
                    0.0,
                    equilibrium.NO_LOADS,
                )
                low, high = (low, margin[own]) if residuals.max() > 0 else (margin[own], high)
            margins[scene_object.name] = (
                round((low + high) / 2 / _MARGIN_RESOLUTION) * _MARGIN_RESOLUTION
            )
            ((least_stable, rolls),) = self._least_stable_objects(
                graph, _single_stack(rows.tolist(), len(shapes))
            )
            if rolls and least_stable == row:
                margins[scene_object.name] = 0.0
        return margins

    def is_disassemblable(self, scene: Scene) -> bool | InconclusiveVerdict:
        """Return whether all objects can be removed one by one without a collapse.

        Only objects that carry nothing are removed.
        """
        graph = self._contact_graph(scene, *self._arrays(scene.objects))
        if isinstance(graph, InconclusiveVerdict):
            return graph
        pairs = graph.pairs.tolist()
        dead_ends = set[frozenset[int]]()

        def can_be_emptied(rows: frozenset[int]) -> bool:
            if len(rows) < 2:
                return True
            loaded = {lower for lower, upper in pairs if upper in rows}
            for row in sorted(rows - loaded):
                rest = rows - {row}
                if rest not in dead_ends:
                    ((least_stable, _),) = self._least_stable_objects(
                        graph, _single_stack(rest, len(graph.shapes))
                    )
                    if least_stable < 0 and can_be_emptied(rest):
                        return True
            dead_ends.add(rows)
            return False

        return all(
            can_be_emptied(frozenset(np.flatnonzero(graph.stack == stack).tolist()))
            for stack in set(graph.stack.tolist())
        )

    def immovable_objects(self, scene: Scene) -> frozenset[str] | InconclusiveVerdict:
        """Return objects that no sequence of moves can remove without a collapse.

        This is the largest set in which no object can be removed while the rest of the set stands,
        even if other objects press straight down on free tops. Horizontal forces of bridges to
        other stacks are ignored. Objects outside of the set may be immovable, too.
        """
        graph = self._contact_graph(scene, *self._arrays(scene.objects))
        if isinstance(graph, InconclusiveVerdict):
            return graph
        shapes, p_T, pairs, _ = graph
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
        """Return whether the other fixed objects could stand without one of them.

        Objects that are not fixed may help: they hold like the ground or press on free tops.
        """
        stack = {removed}
        while True:  # collect all fixed objects in contact with it, directly or not
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
        table = self._shapes.arrays.table
        # An object that is not fixed holds like the ground while it is present.
        number = {row: k for k, row in enumerate(rest)}
        held_pairs = [
            (number.get(a, contacts.GROUND), number[b])
            for a, b in pairs.tolist()
            if b in number and a != removed
        ]
        loads = [
            (x, y, p_T[row, 2] + table[shapes[row]]["top_z"], number[row])
            for row in rest
            for x, y in contacts.uncovered_top(
                table, shapes[row], shapes[removed], p_T[row], p_T[removed], self._margin
            )
        ]
        residuals = equilibrium.equilibrium_residuals(
            table,
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
    ) -> _ContactGraph | InconclusiveVerdict:
        """Return the contacts of a scene, or why the model does not cover it."""
        objects = scene.objects
        is_apart = np.zeros((len(objects), len(objects)), np.bool_)
        while True:
            fault, faulty, other, pairs, stack = contacts.find_contacts(
                self._shapes.arrays.table, shapes, p_T, scene.support.half_size, is_apart
            )
            # Pieces of meshes that overlap in height and seen from above may still be apart, as
            # what lies in a bowl.
            if (
                fault != contacts.OVERLAPPING
                or other < 0
                or Shape.MESH
                not in (o.object_class.shape for o in (objects[faulty], objects[other]))
                or penetration_depth(objects[faulty], objects[other]) > contacts.MAX_OVERLAP
            ):
                break
            is_apart[faulty, other] = is_apart[other, faulty] = True
        if fault != contacts.NO_FAULT:
            return InconclusiveVerdict(_INCONCLUSIVE_REASONS[fault], scene.objects[faulty].name)
        return _ContactGraph(shapes, p_T, pairs, stack)

    def _arrays(self, objects: Sequence[SceneObject]) -> tuple[Ints, Floats]:
        """Return rows and positions of objects; empty the cache if it is invalid or full."""
        arrays = self._shapes.rows_and_positions(objects)
        if self._generation != self._shapes.generation or len(self._cache) > _MAX_CACHED_STACKS:
            self._cache.clear()
            self._generation = self._shapes.generation
        return arrays

    def _least_stable_objects(self, graph: _ContactGraph, stack: Ints) -> list[tuple[int, bool]]:
        """Return the object farthest from equilibrium of each stack.

        Args:
            graph: Objects and contacts.
            stack: Number of each object's stack; objects of stack -1 are absent. Shape (n,).

        Returns:
            For each stack the index of the object, or -1 if the stack stands, and whether it rolls.
        """
        order, first, description = equilibrium.canonical_order(
            graph.shapes, graph.p_T, stack, _CACHE_RESOLUTION
        )
        rows = order.tolist()
        starts = first.tolist()
        content = description.tobytes()
        keys = [
            content[start * _KEY_BYTES_PER_OBJECT : end * _KEY_BYTES_PER_OBJECT]
            for start, end in itertools.pairwise(starts)
        ]
        unknown = [k for k, key in enumerate(keys) if key not in self._cache]
        if unknown:
            table = self._shapes.arrays.table
            options = (self._margin, self._friction)
            solved = equilibrium.least_stable_objects(
                table, *graph[:3], order, first, np.array(unknown), *options
            )
            self._cache.update(
                zip((keys[k] for k in unknown), map(tuple, solved.tolist()), strict=True)
            )
        results = [self._cache[key] for key in keys]
        return [
            (rows[start + position] if position >= 0 else -1, bool(rolls))
            for start, (position, rolls) in zip(starts, results, strict=False)
        ]


def _single_stack(rows: Iterable[int], count: int) -> Ints:
    """Return stack numbers with the given objects in stack 0, the others in none."""
    stack = np.full(count, -1)
    stack[list(rows)] = 0
    return stack


def _contacts_among(pairs: Ints, rows: list[int]) -> Ints:
    """Return the contacts among objects and with the ground, renumbered."""
    number = {row: k for k, row in enumerate(rows)} | {contacts.GROUND: contacts.GROUND}
    renumbered = [
        (number[a], number[b]) for a, b in pairs.tolist() if a in number and b in number and b >= 0
    ]
    return np.array(renumbered, dtype=np.int64).reshape(-1, 2)
