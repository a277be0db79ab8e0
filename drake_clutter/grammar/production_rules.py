"""The production rules as data: each a pair of small graphs (G_L, G_R), as on the authors' rule sheet.

Nodes that both graphs name are kept, nodes that only G_L names are removed, nodes that only G_R names are new. In G_L a
node or edge states the kinds it may match. In G_R it states the kind it gets, `KEEP` for the one it had.
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

PAIR_ORIENTATION = {
    PairArrangement.LYING: Orientation.FLAT_0,
    PairArrangement.STANDING: Orientation.UPRIGHT_0,
}
"""The predefined orientation of a pair; it tells the two arrangements of a class apart."""


@dataclass(frozen=True)
class Pattern:
    """G_L: a tree, its root first.

    Attributes:
        nodes: allowed kinds by the node's name in the rule.
        edges: (parent, child) in an order in which the parent of each edge is the root or an earlier child; all primitive.
        rewritten: the node that the rules are about: they replace it, orient it, or, of the tray, put something on it.
    """

    nodes: Mapping[str, frozenset[str]]
    edges: tuple[tuple[str, str], ...]
    rewritten: str


@dataclass(frozen=True)
class ProductionRule:
    """A rule G_L -> G_R.

    Attributes:
        name: unique in its grammar, e.g. `insert_meta_pudding_box_1`.
        left: G_L.
        right_nodes: G_R's nodes, the kind of each, or KEEP.
        right_edges: G_R's edges, the kind of each.
        nodes_added: nodes that it adds.
        open_slots_added: open slots that it adds.
    """

    name: str
    left: Pattern
    right_nodes: Mapping[str, str]
    right_edges: Mapping[tuple[str, str], EdgeKind]

    @property
    def nodes_added(self) -> int:
        return len(self.right_nodes) - len(self.left.nodes)

    @property
    def open_slots_added(self) -> int:
        before = sum(kinds == {OPEN_SLOT} for kinds in self.left.nodes.values())
        return sum(kind == OPEN_SLOT for kind in self.right_nodes.values()) - before


def make_production_rules(classes: Sequence[ObjectClass]) -> tuple[ProductionRule, ...]:
    """The rules for a set of object classes: 3 of structure, the insertions of singles and pairs, 10 orientations.

    Source: `paper/grammar_rules.png`; 30 rules for the paper's 7 objects, 49 for 14. Beyond the sheet, an insertion asks that
    its slot's parent be terminal: an object placed below a slot that is filled already would find its outgoing edge oriented.
    """
    names = frozenset(object_class.name for object_class in classes)
    terminal_parents = names | {TRAY, DUMMY}
    tray = Pattern({"tray": frozenset({TRAY})}, (), rewritten="tray")
    slot_below_open = Pattern(
        {"slot": frozenset({OBJECT_SLOT}), "top": frozenset({OPEN_SLOT})},
        (("slot", "top"),),
        rewritten="top",
    )
    slot = Pattern(
        {
            "parent": terminal_parents,
            "slot": frozenset({OBJECT_SLOT}),
            "child": frozenset({OBJECT_SLOT, END}),
        },
        (("parent", "slot"), ("slot", "child")),
        rewritten="slot",
    )
    unoriented = Pattern(
        {"parent": terminal_parents, "child": names}, (("parent", "child"),), rewritten="child"
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
