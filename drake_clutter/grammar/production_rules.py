"""Production rules of the clutter grammar, each a pair of graphs (G_L, G_R).

Nodes in both graphs are kept, nodes only in G_L are removed, and nodes only in G_R are new. In G_L,
nodes and edges state the kinds that they match. In G_R, they state the kind that they get, or
`KEEP` for an unchanged kind.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drake_clutter.catalog import ObjectClass, PairArrangement
from drake_clutter.grammar.clutter_graph import (
    DUMMY,
    END,
    OBJECT_SLOT,
    OPEN_SLOT,
    PRIMITIVE,
    TRAY,
    EdgeKind,
)
from drake_clutter.grammar.orientation import Orientation

KEEP = "keep"
"""Kind in G_R of a node that keeps its kind."""

PAIR_ORIENTATION = {
    PairArrangement.LYING: Orientation.FLAT_0,
    PairArrangement.STANDING: Orientation.UPRIGHT_0,
}
"""Orientation of both objects of a pair, by the arrangement of the pair."""


@dataclass(frozen=True)
class Pattern:
    """The left-hand side G_L of a rule: a tree, its root first.

    Attributes:
        nodes: Kinds that match, by the node's name in the rule.
        edges: (parent, child), all primitive. The parent of each edge is the root or an earlier
            child.
        target: Node that a rule replaces or orients, or to which it adds a child.
    """

    nodes: Mapping[str, frozenset[str]]
    edges: tuple[tuple[str, str], ...]
    target: str


@dataclass(frozen=True)
class ProductionRule:
    """A rule G_L -> G_R.

    Attributes:
        name: Unique name in the grammar, such as `insert_meta_pudding_box_1`.
        left: Left-hand side G_L.
        right_nodes: Kind of each node of G_R, or `KEEP`.
        right_edges: Kind of each edge of G_R.
    """

    name: str
    left: Pattern
    right_nodes: Mapping[str, str]
    right_edges: Mapping[tuple[str, str], EdgeKind]

    @property
    def nodes_added(self) -> int:
        """Number of nodes that the rule adds."""
        return len(self.right_nodes) - len(self.left.nodes)

    @property
    def open_slots_added(self) -> int:
        """Number of open slots that the rule adds."""
        before = sum(kinds == {OPEN_SLOT} for kinds in self.left.nodes.values())
        return sum(kind == OPEN_SLOT for kind in self.right_nodes.values()) - before


def make_production_rules(classes: Sequence[ObjectClass]) -> tuple[ProductionRule, ...]:
    """Return the rules for a set of object classes.

    There are 3 structural rules, one insertion for each class and pair, and 10 orientations: 30
    rules for the 7 objects of Kumar et al. (2022), 49 for 14. Unlike the paper's rules, an
    insertion requires a terminal parent; otherwise the outgoing edges of an object could be
    oriented before the object itself is chosen.
    """
    names = frozenset(object_class.name for object_class in classes)
    terminal_parents = names | {TRAY, DUMMY}
    tray = Pattern({"tray": frozenset({TRAY})}, (), target="tray")
    slot_below_open = Pattern(
        {"slot": frozenset({OBJECT_SLOT}), "top": frozenset({OPEN_SLOT})},
        (("slot", "top"),),
        target="top",
    )
    slot = Pattern(
        {
            "parent": terminal_parents,
            "slot": frozenset({OBJECT_SLOT}),
            "child": frozenset({OBJECT_SLOT, END}),
        },
        (("parent", "slot"), ("slot", "child")),
        target="slot",
    )
    unoriented = Pattern(
        {"parent": terminal_parents, "child": names}, (("parent", "child"),), target="child"
    )

    rules = [
        ProductionRule(
            "drop_object",
            tray,
            {"tray": KEEP, "slot": OBJECT_SLOT, "top": OPEN_SLOT},
            {("tray", "slot"): PRIMITIVE, ("slot", "top"): PRIMITIVE},
        ),
        ProductionRule(
            "stack_object",
            slot_below_open,
            {"slot": KEEP, "top": OBJECT_SLOT, "new_top": OPEN_SLOT},
            {("slot", "top"): PRIMITIVE, ("top", "new_top"): PRIMITIVE},
        ),
        ProductionRule(
            "end", slot_below_open, {"slot": KEEP, "top": END}, {("slot", "top"): PRIMITIVE}
        ),
    ]
    for object_class in classes:
        name = object_class.name
        rules.append(
            ProductionRule(
                f"insert_{name}",
                slot,
                {"parent": KEEP, "slot": name, "child": KEEP},
                {("parent", "slot"): PRIMITIVE, ("slot", "child"): PRIMITIVE},
            )
        )
        for number, arrangement in enumerate(object_class.pairs, start=1):
            orientation = PAIR_ORIENTATION[arrangement]
            rules.append(
                ProductionRule(
                    f"insert_meta_{name}_{number}",
                    slot,
                    {"parent": KEEP, "slot": name, "twin": name, "dummy": DUMMY, "child": KEEP},
                    {
                        ("parent", "slot"): orientation,
                        ("parent", "twin"): orientation,
                        ("slot", "dummy"): orientation,
                        ("twin", "dummy"): orientation,
                        ("dummy", "child"): PRIMITIVE,
                    },
                )
            )
    rules += [
        ProductionRule(
            f"orient_{orientation.name.lower()}",
            unoriented,
            {"parent": KEEP, "child": KEEP},
            {("parent", "child"): orientation},
        )
        for orientation in Orientation
    ]
    return tuple(rules)
