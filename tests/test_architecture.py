"""The rules of docs/architecture.md, read from the code itself; and what the documents say of files and options."""

from __future__ import annotations

import argparse
import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from mastd3r import __version__
from mastd3r.cli.parser import parser
from mastd3r.config import Config, with_override

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "mastd3r"
MODULES = sorted(PACKAGE.rglob("*.py"))
WRITTEN = [*MODULES, *sorted((ROOT / "tests").rglob("*.py")), *sorted((ROOT / "benchmarks").rglob("*.py"))]
WRITTEN += sorted((ROOT / "docs").glob("*.py"))

MAX_FILE_LINES, MAX_FUNCTION_LINES, MAX_TRACK_LINES, MAX_TOP_FILES = 400, 60, 40, 12

# From the bottom up. A folder or top-level file sees what lies in rows above its own here, and nothing of its own row.
ROWS: tuple[tuple[str, ...], ...] = (
    ("errors", "concurrency", "progress"),
    ("reading",),
    ("registry", "geometry", "download"),
    ("camera", "config"),
    ("types",),
    ("protocols",),
    (
        "sources",
        "pointmap",
        "features",
        "dynamics",
        "alignment",
        "graph",
        "mapping",
        "mvs",
        "evaluation",
        "export",
        "networks",
    ),
    ("tasks",),  # what bench and batch run by: it knows run folders (export), and nothing of what runs
    ("parts", "experiments", "viewer", "metric"),
    ("tracking",),
    ("offline",),
    ("slam",),
    ("pipeline", "live"),
    ("cli",),
    ("", "__main__"),
)
RANK = {name: rank for rank, row in enumerate(ROWS) for name in row}
STAGES = set(ROWS[5])

# (importing module, imported module): reason
EXCEPTIONS = {
    ("config", "dynamics.config"): "the mask's options stand with the mask; config only joins them",
    ("export.machine", ""): "the version number of the package goes into run.json",
    ("cli.parser", ""): "the version number",
    ("tasks.cluster", ""): "the version number: nodes must have the same",
    ("protocols", "alignment.problem"): "for type checkers alone: what an aligner is given",
    ("protocols", "alignment.result"): "for type checkers alone: what it gives back",
    ("protocols", "dynamics.data"): "for type checkers alone: what a mask is told, and is",
}

HEAVY = {  # package: who may import it
    "torch": {"mapping", "networks", "concurrency"},  # concurrency: to hold it to one thread, where it is there
    "transformers": {"networks"},
    "safetensors": {"networks"},
    "gsplat": {"mapping"},
    "av": {"sources", "export"},  # reads videos, writes them
    "numba": {"geometry", "dynamics", "mapping", "pointmap", "mvs", "networks"},
    "rich": {"cli"},
    "viser": {"viewer"},  # the optional browser viewer
    "ray": {"tasks"},  # optional clusters
}
# recordings are CUDA's; config: mapping.device; gsplat's backend
NAMES_A_DEVICE = {"mapping.rasterise", "mapping.rasterise_gsplat", "networks.record", "config"}
READS_TRUTH = {"evaluation", "sources", "types"}  # sources make it, types define it
PASSES_TRUTH_ON = {"offline.job", "offline.reconstruction", "pipeline"}
TRUTH_GOES_TO = {"evaluate", "evaluate_cloud", "score"}
EXITS = {"cli.main", "__main__"}

DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
GENERATED = {"docs/picture.png", "docs/results.md"}  # made by a command after the code is there


def dotted(path: Path) -> str:
    """ "graph.bundle" for src/mastd3r/graph/bundle.py; "" for the package itself."""
    parts = list(path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def owner(module: str) -> str:
    """The stage folder or top-level module that a module belongs to."""
    return module.partition(".")[0]


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def own_imports(path: Path) -> Iterator[tuple[str, int]]:
    """(module of this package, line) of every import, relative or absolute, wherever it stands."""
    package = list(path.relative_to(PACKAGE).parent.parts)
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            for name in node.names:
                if name.name.partition(".")[0] == "mastd3r":
                    yield name.name.partition(".")[2], node.lineno
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                base = [*package[: len(package) - node.level + 1], *(node.module or "").split(".")]
            elif (node.module or "").partition(".")[0] == "mastd3r":
                base = (node.module or "").split(".")[1:]
            else:
                continue
            base = [part for part in base if part]
            for name in node.names:
                target = PACKAGE.joinpath(*base, name.name)
                is_module = target.with_suffix(".py").is_file() or target.is_dir()
                yield ".".join([*base, name.name] if is_module else base), node.lineno


def foreign_imports(path: Path) -> Iterator[tuple[str, int]]:
    """(top-level package, line) of every absolute import."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from ((name.name.partition(".")[0], node.lineno) for name in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield (node.module or "").partition(".")[0], node.lineno


def test_every_module_has_a_row() -> None:
    assert {owner(dotted(p)) for p in MODULES} == set(RANK)


def test_no_import_points_upward_or_aside() -> None:
    wrong, used = [], set()
    for path in MODULES:
        module = dotted(path)
        for imported, line in own_imports(path):
            if owner(imported) == owner(module) and module:
                continue
            if (module, imported) in EXCEPTIONS:
                used.add((module, imported))
            elif RANK[owner(imported)] >= RANK[owner(module)]:
                wrong.append(f"{path.relative_to(ROOT)}:{line} imports mastd3r.{imported}")
    assert not wrong
    assert used == set(EXCEPTIONS), "an exception that nothing needs any more"


def test_networks_are_brought_in_by_name_only() -> None:
    """``parts.py`` builds them where they are chosen; nothing else knows them."""
    importers = {dotted(p) for p in MODULES for name, _ in own_imports(p) if owner(name) == "networks"}
    assert {m for m in importers if owner(m) != "networks"} == {"parts"}


def test_the_top_level_is_small() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= MAX_TOP_FILES


def test_the_loop_fits_on_a_screen_and_repairs_nothing() -> None:
    """``track`` is straight: no loop, no handler, no thread, no recovery of its own; and every stage names its file."""
    path = PACKAGE / "slam.py"
    track = next(n for n in ast.walk(tree(path)) if isinstance(n, ast.FunctionDef) and n.name == "track")
    assert (track.end_lineno or 0) - track.lineno + 1 <= MAX_TRACK_LINES
    bends = (ast.If, ast.For, ast.While, ast.Try, ast.Lambda)
    assert not [n for n in ast.walk(track) if isinstance(n, bends)]
    source = path.read_text(encoding="utf-8").splitlines()
    named = re.findall(r"\w+/\w+\.py", "\n".join(source[track.lineno - 1 : track.end_lineno]))
    assert named and all((PACKAGE / file).is_file() for file in named)


def test_heavy_packages_stay_where_they_are_needed() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {package}"
        for path in MODULES
        for package, line in foreign_imports(path)
        if package in HEAVY and owner(dotted(path)) not in HEAVY[package]
    ]
    assert not wrong


def test_threads_are_made_in_one_file() -> None:
    """Locks and what a thread keeps for itself may stand anywhere; the command line watches its standard input."""
    makers = {"concurrent", "ThreadPoolExecutor", "Thread"}
    allowed = {"concurrency", "cli.commands"}
    naming = {
        dotted(path)
        for path in MODULES
        for node in ast.walk(tree(path))
        if {ast.Name: "id", ast.Attribute: "attr"}.get(type(node)) is not None
        and getattr(node, "id", getattr(node, "attr", "")) in makers
    }
    assert naming == allowed


def test_files_are_short() -> None:
    lengths = {str(p.relative_to(ROOT)): len(p.read_text(encoding="utf-8").splitlines()) for p in WRITTEN}
    assert {name: n for name, n in lengths.items() if n > MAX_FILE_LINES} == {}


def test_functions_are_short() -> None:
    long = {
        f"{path.relative_to(ROOT)}:{node.name}": (node.end_lineno or 0) - node.lineno + 1
        for path in WRITTEN
        for node in ast.walk(tree(path))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.end_lineno or 0) - node.lineno + 1 > MAX_FUNCTION_LINES
    }
    assert long == {}


def test_only_the_command_line_prints_and_exits() -> None:
    wrong = []
    for path in MODULES:
        module = dotted(path)
        for node in ast.walk(tree(path)):
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            if called == "print" and owner(module) != "cli":
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno} prints")
            if called in ("exit", "quit", "sys.exit", "os._exit") and module not in EXITS:
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno} exits")
    assert not wrong


def test_no_error_is_swallowed() -> None:
    """But at the boundary of the command line, and where an ended run is saved in whatever state it is.

    A thread that reads a camera hands its error to whoever takes the frames.
    """
    wrong = []
    boundaries = ("src/mastd3r/cli/main.py", "src/mastd3r/offline/job.py", "src/mastd3r/concurrency.py")
    found = dict.fromkeys(boundaries, 0)
    for path in WRITTEN:
        for node in ast.walk(tree(path)):
            if not isinstance(node, ast.ExceptHandler):
                continue
            kinds = {n.id for n in ast.walk(node.type) if isinstance(n, ast.Name)} if node.type else {""}
            cleans_up = kinds == {"BaseException"} and isinstance(node.body[-1], ast.Raise)
            if kinds & {"", "Exception", "BaseException"} and not cleans_up:
                name = path.relative_to(ROOT).as_posix()
                if name in found:
                    found[name] += 1
                else:
                    wrong.append(f"{name}:{node.lineno}")
    assert not wrong
    assert found == dict.fromkeys(boundaries, 1)


def test_whether_something_is_there_is_asked_without_raising() -> None:
    """pathlib's own questions raise where a folder on the way may not be looked into; these two turn that to a line."""
    wraps = {"src/mastd3r/export/claim.py", "src/mastd3r/export/export_folder.py", "src/mastd3r/__init__.py"}
    wrong = []
    for path in MODULES:
        name = path.relative_to(ROOT).as_posix()
        for node in ast.walk(tree(path)) if name not in wraps else ():
            if not isinstance(node, ast.Attribute) or node.attr not in ("is_file", "is_dir", "exists"):
                continue
            if ast.unparse(node.value) not in ("os.path", "info"):  # info: a member of an archive
                wrong.append(f"{name}:{node.lineno}: take those of reading/files.py")
    assert not wrong


def test_one_file_chooses_the_device() -> None:
    naming = {dotted(p) for p in MODULES if "cuda" in p.read_text(encoding="utf-8")}
    assert naming == NAMES_A_DEVICE


def test_truth_is_read_by_the_evaluation_only() -> None:
    wrong = []
    for path in MODULES:
        module = dotted(path)
        if owner(module) in READS_TRUTH:
            continue
        allowed = _truth_calls_passed_on(path) if module in PASSES_TRUTH_ON else set()
        for node in ast.walk(tree(path)):
            name = {ast.Name: "id", ast.Attribute: "attr", ast.alias: "name"}.get(type(node))
            if name is None or node in allowed:
                continue
            called = getattr(node, name)
            if called in ("Truth", "moving_files") or (called == "truth" and _is_called(path, node)):
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno} reads truth")
    assert not wrong


def _truth_calls_passed_on(path: Path) -> set[ast.AST]:
    """The ``x.truth`` of every ``evaluate(..., x.truth(), ...)`` or ``evaluate_trajectory(…)``."""
    found: set[ast.AST] = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in TRUTH_GOES_TO:
            found |= {a.func for a in node.args if isinstance(a, ast.Call) and isinstance(a.func, ast.Attribute)}
    return found


def _is_called(path: Path, attribute: ast.AST) -> bool:
    return any(isinstance(node, ast.Call) and node.func is attribute for node in ast.walk(tree(path)))


@pytest.mark.parametrize("module", [dotted(p) for p in MODULES if p.name != "__main__.py"])
def test_every_module_imports_and_says_what_it_is(module: str) -> None:
    loaded = importlib.import_module(f"mastd3r.{module}".rstrip("."))
    assert loaded.__doc__


def test_the_package_runs_as_a_module() -> None:
    words = [sys.executable, "-m", "mastd3r", "--version"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == __version__


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: p.name)
def test_links_of_documents_lead_somewhere(path: Path) -> None:
    links = re.findall(r"\]\(([^)#:]+)\)", path.read_text(encoding="utf-8"))
    targets = {(path.parent / link).resolve().relative_to(ROOT).as_posix() for link in links}
    assert sorted(t for t in targets - GENERATED if not (ROOT / t).exists()) == []


def test_options_in_the_readme_exist() -> None:
    known = set(_options(parser()))
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", (ROOT / "README.md").read_text(encoding="utf-8")))
    assert named and sorted(named - known) == []


def _options(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Option words of a parser and of all its commands."""
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action.choices, dict):
            for command in action.choices.values():
                yield from _options(command)


def test_settings_in_the_documents_exist() -> None:
    text = "\n".join(p.read_text(encoding="utf-8") for p in DOCUMENTS)
    settings = set(re.findall(r"\b((?:source|camera|tracking|graph|dynamics|mapping|networks)\.\w+=\w+)", text))
    assert settings
    for setting in settings:
        with_override(Config(), setting)
