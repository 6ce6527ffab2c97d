"""One owner: poses, depths, intrinsics and the weights of matches are written by the keyframe graph alone."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "mastd3r"

OWNED = {
    *("cam_from_world", "inv_depth", "prior_depth", "prior_info", "depth_info"),  # KeyframeVariables
    *("cam_from_kf", "state", "points", "target", "weight"),  # FrameRecord, ReprojectionFactor
    *("intrinsics", "values", "static", "moving"),  # KeyframeGraph, Intrinsics, Keyframe
}
WRITES_IN_PLACE = {"fill", "sort", "put", "partition", "itemset", "resize", "setfield", "byteswap"}
WRITES_FIRST = {"copyto", "put", "place", "putmask", "fill_diagonal", "put_along_axis", "at"}
WRITERS = {
    "graph/keyframe_graph.py": "the owner",
    "graph/bundle_adjustment.py": "solves the variables that the graph has handed to it",
}
# base of an attribute of the same name that is something else: reason
NOT_OF_THE_GRAPH = {
    "ctx": "what torch keeps for the way back of a function",
    "bits": "a random generator's own",
    "run": "how far a source of a batch is",
    "out": "the masks of the smoothing pass, while they are collected",
}


def owned(node: ast.AST) -> str | None:
    """The attribute of the graph's that an expression is, or is a part of: ``x.inv_depth``, ``x.inv_depth[2:4]``.

    ``self.weight`` in another class is its own business.
    """
    while isinstance(node, ast.Subscript | ast.Starred):
        node = node.value
    if not isinstance(node, ast.Attribute) or node.attr not in OWNED:
        return None
    if isinstance(node.value, ast.Name) and node.value.id in {"self", *NOT_OF_THE_GRAPH}:
        return None
    return ast.unparse(node)


def targets(node: ast.AST) -> Iterator[ast.AST]:
    """What a statement or a call writes to, tuples taken apart."""
    found: list[ast.AST] = []
    if isinstance(node, ast.Assign):
        found = list(node.targets)
    elif isinstance(node, ast.AugAssign | ast.AnnAssign | ast.For | ast.NamedExpr):
        found = [node.target]
    elif isinstance(node, ast.Delete):
        found = list(node.targets)
    elif isinstance(node, ast.With):
        found = [item.optional_vars for item in node.items if item.optional_vars is not None]
    elif isinstance(node, ast.Call):
        found = [word.value for word in node.keywords if word.arg == "out"]
        if isinstance(node.func, ast.Attribute) and node.func.attr in WRITES_IN_PLACE:
            found.append(node.func.value)
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in WRITES_FIRST and node.args:
            found.append(node.args[0])
    while found:
        target = found.pop()
        if isinstance(target, ast.Tuple | ast.List):
            found += target.elts
        else:
            yield target


def writes(source: str) -> list[str]:
    """Attributes of the graph's that a text writes to, with their lines."""
    found = [(n.lineno, owned(t)) for n in ast.walk(ast.parse(source)) if hasattr(n, "lineno") for t in targets(n)]
    return [f"{line}: {name}" for line, name in sorted(found, key=lambda f: f[0]) if name is not None]


def test_only_the_graph_writes_what_it_owns() -> None:
    wrong = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        found = writes(path.read_text(encoding="utf-8"))
        if name in WRITERS:
            assert found, f"{name}: an exception that nothing needs any more"
        elif found:
            wrong[name] = found
    assert wrong == {}


@pytest.mark.parametrize(
    "line",
    [
        "graph.variables[k].cam_from_world = pose",
        "v.cam_from_world[:3, 3] *= 2",
        "v.inv_depth, other = a, b",
        "(a, [v.prior_depth]) = b",
        "graph.intrinsics.values = g",
        "graph.intrinsics = g",
        "graph.intrinsics.values[0] += 1.0",
        "r.state: str = 'lost'",
        "np.minimum(kf.static, static, out=kf.static)",
        "np.multiply(a, b, out=e.weight[3:])",
        "np.copyto(r.cam_from_kf, pose)",
        "np.add.at(v.depth_info, rows, 1.0)",
        "v.inv_depth.fill(1.0)",
        "del v.depth_info",
        "for v.inv_depth in depths: pass",
    ],
)
def test_every_way_of_writing_is_seen(line: str) -> None:
    assert len(writes(line)) == 1


@pytest.mark.parametrize(
    "line", ["x = v.inv_depth", "self.weight = w", "ctx.state = s", "f(weight=v.weight)", "v.inv_depth.copy()"]
)
def test_reading_is_free(line: str) -> None:
    assert writes(line) == []
