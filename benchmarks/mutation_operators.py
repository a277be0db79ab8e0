"""Mutants of a module: its source with one small change each.

The operators are those of mutmut and cosmic-ray that change a value: arithmetic, comparison and
Boolean operators, constants, conditions, loops. Added are exchanged functions, such as `min` for
`max`, and deleted statements. Changes that raise an exception wherever they run, such as None in
place of an argument, are left out: any test that runs the line catches them.
"""

import ast
import hashlib
import re
from dataclasses import dataclass
from itertools import pairwise

ARITHMETIC = {
    "+": "-",
    "-": "+",
    "*": "/",
    "/": "*",
    "//": "/",
    "%": "*",
    "**": "*",
    "&": "|",
    "|": "&",
    "^": "&",
    "<<": ">>",
    ">>": "<<",
}
"""Replacement of each binary operator."""
COMPARISONS = {
    "<": ("<=", ">="),
    "<=": ("<", ">"),
    ">": (">=", "<="),
    ">=": (">", "<"),
    "==": ("!=",),
    "!=": ("==",),
    "is": ("is not",),
    "is not": ("is",),
    "in": ("not in",),
    "not in": ("in",),
}
"""Replacements of each comparison: the same with the other boundary, and the opposite."""
FUNCTIONS = {
    name: other
    for pair in (
        ("min", "max"),
        ("minimum", "maximum"),
        ("amin", "amax"),
        ("argmin", "argmax"),
        ("nanmin", "nanmax"),
        ("any", "all"),
        ("sin", "cos"),
        ("floor", "ceil"),
        ("zeros", "ones"),
        ("append", "remove"),
    )
    for name, other in (pair, pair[::-1])
}
"""Function or method that replaces another one of the same arguments."""
ROUNDING_TOLERANCE = 1e-5
"""Largest number that counts as a tolerance of rounding errors. It is increased by 1, other
floating-point numbers are doubled."""
UNMUTATED_KEYWORDS = frozenset({"strict"})
"""Keyword arguments that only check what is right anyway."""


@dataclass(frozen=True)
class Mutant:
    """One change of a module.

    Attributes:
        path: The module's file, from the root of the repository.
        function: Qualified name of the function or class; empty at module level.
        line: First changed line.
        statement: First and last line of the statement; of a compound statement, of its head.
        operator: Kind of the change.
        original: The replaced text.
        replacement: The new text.
        start: Offset of the replaced text in the file [bytes].
        key: Identifies the mutant, also after changes in other parts of the file.
    """

    path: str
    function: str
    line: int
    statement: tuple[int, int]
    operator: str
    original: str
    replacement: str
    start: int
    key: str

    def apply(self, source: str) -> str:
        """Return the mutated source."""
        code = source.encode()
        end = self.start + len(self.original.encode())
        assert code[self.start : end].decode() == self.original
        return (code[: self.start] + self.replacement.encode() + code[end:]).decode()


def find_mutants(path: str, source: str) -> list[Mutant]:
    """Return all mutants of a module in the order of the source.

    Args:
        path: The module's file, from the root of the repository.
        source: Its text.
    """
    finder = _Finder(path, source)
    finder.visit(ast.parse(source))
    return sorted(finder.mutants, key=lambda mutant: (mutant.start, mutant.replacement))


def rank(key: str, seed: int) -> str:
    """Return a pseudo-random sorting key of the key of a mutant.

    The first mutants in this order are a sample. It stays the same where the code stays the same.
    """
    return hashlib.sha256(f"{seed} {key}".encode()).hexdigest()


class _Finder(ast.NodeVisitor):
    """Collects the mutants of a syntax tree."""

    def __init__(self, path: str, source: str) -> None:
        self.mutants = list[Mutant]()
        self._path = path
        self._code = source.encode()
        lines = self._code.splitlines(keepends=True)
        self._line_starts = [sum(map(len, lines[:index])) for index in range(len(lines) + 1)]
        self._scope = list[str]()
        self._statement = (1, 1)
        self._keys = dict[str, int]()

    # Positions and texts.

    def _start(self, node: ast.expr | ast.stmt) -> int:
        return self._line_starts[node.lineno - 1] + node.col_offset

    def _end(self, node: ast.expr | ast.stmt) -> int:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self._line_starts[node.end_lineno - 1] + node.end_col_offset

    def _add(self, operator: str, start: int, end: int, replacement: str) -> None:
        original = self._code[start:end].decode()
        line = self._code[:start].count(b"\n")
        text = self._code[self._line_starts[line] : self._line_starts[line + 1]].decode()
        scope = ".".join(self._scope)
        change = f"{self._path} {scope}: {text.strip()}: {operator}: {original} -> {replacement}"
        occurrence = self._keys[change] = self._keys.get(change, -1) + 1
        key = hashlib.sha256(f"{change} {occurrence}".encode()).hexdigest()[:12]
        self.mutants.append(
            Mutant(
                path=self._path,
                function=scope,
                line=line + 1,
                statement=self._statement,
                operator=operator,
                original=original,
                replacement=replacement,
                start=start,
                key=key,
            )
        )

    def _replace(self, operator: str, node: ast.expr | ast.stmt, replacement: str) -> None:
        self._add(operator, self._start(node), self._end(node), replacement)

    def _negate(self, node: ast.expr) -> None:
        """Negate a condition, unless another operator negates it."""
        if isinstance(node, ast.UnaryOp) or (
            isinstance(node, ast.Compare) and len(node.comparators) == 1
        ):
            return
        text = self._code[self._start(node) : self._end(node)].decode()
        self._replace("condition", node, f"(not ({text}))")

    def _operator_between(self, left: ast.expr, right: ast.expr, symbol: str) -> tuple[int, int]:
        """Return start and end of an operator between two operands."""
        begin = self._end(left)
        between = self._code[begin : self._start(right)].decode()
        code = re.sub(r"#[^\n]*", lambda comment: " " * len(comment[0].encode()), between)
        found = re.search(re.escape(symbol).replace(r"\ ", r"\s+"), code)
        assert found is not None
        return begin + found.start(), begin + found.end()

    def visit(self, node: ast.AST) -> None:
        """Visit a node; remember the lines of a statement."""
        if isinstance(node, ast.stmt):
            assert node.end_lineno is not None
            body = getattr(node, "body", None)
            last = max(node.lineno, body[0].lineno - 1) if body else node.end_lineno
            self._statement = node.lineno, last
        super().visit(node)

    # What is left out.

    def visit_Raise(self, node: ast.Raise) -> None:
        """Leave out messages."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """Leave out assertions, which only check what is right anyway."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Leave out messages."""

    def visit_arg(self, node: ast.arg) -> None:
        """Leave out annotations."""

    def visit_Subscript(self, node: ast.Subscript) -> None:
        """Leave out the bounds of annotated types."""
        if not (isinstance(node.value, ast.Name) and node.value.id in ("Annotated", "Literal")):
            self.generic_visit(node)

    def visit_keyword(self, node: ast.keyword) -> None:
        """Leave out `strict` of zip."""
        if node.arg not in UNMUTATED_KEYWORDS:
            self.generic_visit(node)

    # Scopes.

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        """Visit the body without decorators."""
        self._visit_scope(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        """Visit defaults and body without decorators and annotations."""
        if node.name in ("__repr__", "__str__"):
            return
        for default in (*node.args.defaults, *node.args.kw_defaults):
            if default is not None:
                self.visit(default)
        self._visit_scope(node)

    def _visit_scope(self, node: ast.ClassDef | ast.FunctionDef) -> None:
        self._scope.append(node.name)
        for statement in node.body:
            self.visit(statement)
        self._scope.pop()

    # Operators.

    def visit_BinOp(self, node: ast.BinOp) -> None:
        """Replace an arithmetic operator."""
        symbol = _SYMBOLS.get(type(node.op))
        if symbol is not None and not _is_type_union(node):
            start, end = self._operator_between(node.left, node.right, symbol)
            self._add("arithmetic", start, end, ARITHMETIC[symbol])
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        """Replace the operator of an augmented assignment, or delete the statement."""
        symbol = _SYMBOLS.get(type(node.op))
        if symbol is not None:
            start, end = self._operator_between(node.target, node.value, symbol + "=")
            self._add("arithmetic", start, end, ARITHMETIC[symbol] + "=")
        self._replace("statement", node, "pass")
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        """Replace a comparison."""
        operands = pairwise((node.left, *node.comparators))
        for (left, right), op in zip(operands, node.ops, strict=True):
            symbol = _COMPARISON_SYMBOLS[type(op)]
            start, end = self._operator_between(left, right, symbol)
            for replacement in COMPARISONS[symbol]:
                self._add("comparison", start, end, replacement)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        """Exchange `and` and `or`."""
        symbol, other = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        for left, right in pairwise(node.values):
            self._add("Boolean", *self._operator_between(left, right, symbol), other)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        """Remove a sign or a negation."""
        self._add("sign or negation", self._start(node), self._start(node.operand), "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        """Change a number or a truth value."""
        value = node.value
        if isinstance(value, bool):
            self._replace("constant", node, str(not value))
        elif isinstance(value, int):
            self._replace("constant", node, str(value + 1))
        elif isinstance(value, float):
            changed = value + 1 if abs(value) <= ROUNDING_TOLERANCE else 2 * value
            self._replace("constant", node, repr(changed))

    def visit_If(self, node: ast.If) -> None:
        """Negate the condition."""
        self._negate(node.test)
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        """Negate the condition."""
        self._negate(node.test)
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        """Negate the conditions of a comprehension."""
        for condition in node.ifs:
            self._negate(condition)
        self.generic_visit(node)

    def visit_For(self, node: ast.For) -> None:
        """Let the loop have no iteration."""
        self._replace("loop", node.iter, "()")
        self.generic_visit(node)

    def visit_Break(self, node: ast.Break) -> None:
        """Continue instead."""
        self._replace("loop", node, "continue")

    def visit_Continue(self, node: ast.Continue) -> None:
        """Break instead."""
        self._replace("loop", node, "break")

    def visit_Name(self, node: ast.Name) -> None:
        """Exchange a function."""
        if node.id in FUNCTIONS:
            self._replace("function", node, FUNCTIONS[node.id])

    def visit_Attribute(self, node: ast.Attribute) -> None:
        """Exchange a function or a method."""
        if node.attr in FUNCTIONS:
            end = self._end(node)
            self._add("function", end - len(node.attr), end, FUNCTIONS[node.attr])
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        """Delete a call that stands alone; leave out docstrings."""
        if isinstance(node.value, ast.Constant):
            return
        if isinstance(node.value, ast.Call):
            self._replace("statement", node, "pass")
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        """Delete the assignment of an element or an attribute; leave out `__all__`."""
        if isinstance(node.targets[0], ast.Name) and node.targets[0].id == "__all__":
            return
        if isinstance(node.targets[0], ast.Attribute | ast.Subscript):
            self._replace("statement", node, "pass")
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        """Visit the value without the annotation."""
        if node.value is not None:
            self.visit(node.value)


_SYMBOLS: dict[type[ast.operator], str] = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.FloorDiv: "//",
    ast.Mod: "%",
    ast.Pow: "**",
    ast.BitAnd: "&",
    ast.BitOr: "|",
    ast.BitXor: "^",
    ast.LShift: "<<",
    ast.RShift: ">>",
}
_COMPARISON_SYMBOLS: dict[type[ast.cmpop], str] = {
    type(comparison.ops[0]): symbol
    for symbol in COMPARISONS
    if isinstance(comparison := ast.parse(f"a {symbol} b", mode="eval").body, ast.Compare)
}


def _is_type_union(node: ast.BinOp) -> bool:
    """Return whether `|` joins types or None, as in `Grasp | None`."""
    return isinstance(node.op, ast.BitOr) and any(
        (isinstance(side, ast.Constant) and side.value is None)
        or (isinstance(side, ast.Name) and side.id[:1].isupper())
        for side in (node.left, node.right)
    )
