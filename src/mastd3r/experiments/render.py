"""Tables as markdown and as one HTML page that needs no other file."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

from .protocol import protocol
from .suite import SequenceSpec, suite_from_dict
from .tables import Cell, Table, tables_of

STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1200px; margin: 0 auto; padding: 24px 16px 64px; }
h1 { font-size: 24px; } h2 { font-size: 18px; margin-top: 36px; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 14px; }
th, td { padding: 5px 10px; border-bottom: 1px solid #8884; text-align: left; white-space: nowrap; }
th { border-bottom: 2px solid #8888; vertical-align: bottom; }
td.best { font-weight: 700; }
li, .note { font-size: 13px; opacity: .85; }
code { font-size: 13px; background: #8882; padding: 1px 4px; border-radius: 3px; }
img { max-width: 100%; height: auto; background: #fff; border-radius: 6px; margin-top: 12px; }
"""


def as_markdown(results: dict[str, Any], plots: Sequence[str] = (), level: int = 1) -> str:
    """The whole page; ``plots`` are paths of pictures relative to it, ``level`` is the depth of its title."""
    mark = "#" * level
    suite = suite_from_dict(results["definition"], results["suite"])
    lines = [f"{mark} {suite.title}", "", f"By `{results['command']}`.", ""]
    for table in tables_of(results):
        lines += [f"{mark}# {table.title}", "", *_rows(table), "", *(f"{note}  " for note in table.notes), ""]
    lines += ["Bold: the best of our own in its group.", ""]
    for name in plots:
        lines += [f"![{_alt(name)}]({name})", ""]
    lines += [f"{mark}# Protocol", "", *(f"- {line}" for line in protocol(results)), ""]
    lines += _list(f"{mark}# Missing", absent(results)) + _list(f"{mark}# Failed", failures(results))
    lines += [f"{mark}# Runs", "", "<details><summary>command of every run</summary>", ""]
    lines += ["| run | command | wall [s] | state |", "|---|---|---|---|"]
    lines += [f"| {r['id']} | `{r['command']}` | {r['wall_s']} | {r['status']} |" for r in results["entries"]]
    return "\n".join([*lines, "", "</details>"]) + "\n"


def as_html(results: dict[str, Any], plots: Sequence[str] = ()) -> str:
    """The same as one page; ``plots`` are SVG texts, which it holds."""
    suite = suite_from_dict(results["definition"], results["suite"])
    body = [f"<h1>{escape(suite.title)}</h1>", f"<p>By <code>{escape(results['command'])}</code>.</p>"]
    for table in tables_of(results):
        body += [f"<h2>{escape(table.title)}</h2>", _html_table(table.head, table.rows)]
        body += [f'<div class="note">{escape(note)}</div>' for note in table.notes]
    body += ["<p>Bold: the best of our own in its group.</p>", *plots]
    sections = {"Protocol": protocol(results), "Missing": absent(results), "Failed": failures(results)}
    for title, lines in sections.items():
        if lines:
            body += [f"<h2>{title}</h2>", "<ul>", *(f"<li>{_code(line)}</li>" for line in lines), "</ul>"]
    cells = [[Cell(str(r[k])) for k in ("id", "command", "wall_s", "status")] for r in results["entries"]]
    body += ["<h2>Runs</h2>", _html_table(["run", "command", "wall [s]", "state"], cells)]
    head = f'<meta charset="utf-8"><title>{escape(suite.title)}</title><style>{STYLE}</style>'
    view = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}{view}</head>\n<body>\n' + "\n".join(body) + "\n</body></html>\n"
    )


def absent(results: dict[str, Any]) -> list[str]:
    """Sequences that are not there, and the command that brings them."""
    suite = suite_from_dict(results["definition"], results["suite"])
    known = {s.name: s for s in suite.sequences or ()}
    lines = []
    for name in results["missing"]:
        how = known.get(name, SequenceSpec(name)).how_to_get()
        lines.append(f"{name}: not in the data folder" + (f"; `{how}` brings it" if how else ""))
    return lines


def failures(results: dict[str, Any]) -> list[str]:
    """Runs that gave no figures, and what they said."""
    return [f"{r['id']}: {r['error']}" for r in results["entries"] if r["status"] == "failed"]


def _rows(table: Table) -> list[str]:
    lines = ["| " + " | ".join(table.head) + " |", "|---" * len(table.head) + "|"]
    for row in table.rows:
        lines.append("| " + " | ".join(f"**{c.text}**" if c.best else c.text for c in row) + " |")
    return lines


def _html_table(head: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    out = ['<div class="scroll"><table><thead><tr>', *(f"<th>{escape(h)}</th>" for h in head), "</tr></thead><tbody>"]
    for row in rows:
        cells = [f"<td{' class=best' if c.best else ''}>{escape(c.text)}</td>" for c in row]
        out += ["<tr>", *cells, "</tr>"]
    return "".join([*out, "</tbody></table></div>"])


def _list(title: str, lines: list[str]) -> list[str]:
    return [title, "", *(f"- {line}" for line in lines), ""] if lines else []


def _code(line: str) -> str:
    """Back quotes to code."""
    parts = escape(line).split("`")
    return "".join(f"<code>{p}</code>" if i % 2 else p for i, p in enumerate(parts))


def _alt(name: str) -> str:
    return name.rpartition("/")[2].removesuffix(".svg").replace("_", " ").replace("-", " ")
