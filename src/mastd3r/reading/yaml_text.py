"""YAML of plain values: no dates, no objects, no small text that stands for a huge one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from .files import Refusal, whole_text

MOST_YAML_BYTES = 2**20
MOST_NODES = 50_000  # with what aliases stand for
MOST_DEEP = 50
EXPECTED = "readable YAML"
BROKEN = (yaml.YAMLError, ValueError, LookupError, TypeError, OverflowError)


class _Loader(yaml.SafeLoader):
    """Dates and the like are text; nothing is nested deeply."""

    deep = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.deep += 1
        if self.deep > MOST_DEEP:
            raise ValueError(f"nesting of more than {MOST_DEEP}")
        node = super().compose_node(parent, index)
        self.deep -= 1
        return node

    def as_text(self, node: Any) -> Any:
        return self.construct_scalar(node)


for _tag in ("timestamp", "binary", "omap", "pairs", "set"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _Loader.as_text)


def yaml_value(text: str, where: str, refusal: Refusal, expected: str = EXPECTED) -> Any:
    """The value that a YAML text stands for. Raises ``refusal``, which ``where`` begins."""
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        if _nodes(node, {}) > MOST_NODES:
            raise ValueError(f"more than {MOST_NODES} values")
        return loader.construct_document(node)
    except BROKEN as e:
        said = " ".join(str(e).split()) or type(e).__name__
        raise refusal(f"{where}: expected {expected}, got {said}") from e


def yaml_file(path: Path, where: str, refusal: Refusal) -> Any:
    """The value of a file. Raises ``refusal``."""
    text = whole_text(path, EXPECTED, lambda said: refusal(f"{where} {said}"), MOST_YAML_BYTES)
    return yaml_value(text, f"{where} {path}", refusal)


def _nodes(node: Any, known: dict[int, int]) -> int:
    """How many nodes there are below, aliases written out. Raises ValueError for one that holds itself."""
    if id(node) in known:
        if known[id(node)] < 0:
            raise ValueError("an alias within what it stands for")
        return known[id(node)]
    known[id(node)] = -1
    inner = node.value if isinstance(node, yaml.SequenceNode) else ()
    if isinstance(node, yaml.MappingNode):
        inner = [n for pair in node.value for n in pair]
    count = 1 + sum(_nodes(n, known) for n in inner)
    known[id(node)] = count
    return count
