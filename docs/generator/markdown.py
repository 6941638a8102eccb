"""Markdown of the generated pages: tables, lists, and texts of the code."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table, or nothing where it has no rows."""
    lines = [" | ".join(cells) for cells in rows]
    if not lines:
        return ""
    lines = [" | ".join(head), " | ".join(["---"] * len(head)), *lines]
    return "\n".join(f"| {line} |" for line in lines)


def section(title: str, *parts: str, level: int = 2) -> str:
    """Return a heading with what is below it, or nothing where nothing is."""
    below = [part for part in parts if part]
    return "\n\n".join([f"{'#' * level} {title}", *below]) if below else ""


def page(title: str, *parts: str) -> str:
    """Return the text of a page."""
    return "\n\n".join([f"# {title}", *(part for part in parts if part)]) + "\n"


def cell(text: object) -> str:
    """Return a text of the code as the cell of a table."""
    return plain(" ".join(str(text).split())).replace("|", "\\|")


def code(text: object) -> str:
    """Return a text as code in the cell of a table; nothing for an empty one."""
    shown = str(text).replace("|", "\\|")
    return f"`{shown}`" if shown else ""


def plain(text: str) -> str:
    """Escape what Markdown would take for HTML, emphasis or links, outside of code."""
    parts = re.split(r"(`[^`\n]*`)", text)
    special = r"([<*\[\]]|(?<!\w)_|_(?!\w))"
    return "".join(part if number % 2 else re.sub(special, r"\\\1", part) for number, part in enumerate(parts))


def docstring(text: str | None) -> str:
    """Return a docstring as Markdown: lines that begin with a name become a list, indented ones stay as they are."""
    lines: list[str] = []
    for line in inspect.cleandoc(text or "").splitlines():
        before = lines[-1] if lines else ""
        is_item = bool(re.match(r"`[^`]+`(, `[^`]+`)*:? ", line))
        in_list = before.startswith(("- ", "  ")) and not before.startswith("    ")
        if line.startswith("    "):
            lines.append(line)
        elif is_item:
            lines += [""] * bool(before and not in_list) + [f"- {plain(line)}"]
        elif in_list and line and not before.endswith("."):
            lines.append(f"  {plain(line)}")
        else:
            lines += [""] * bool(in_list and line) + [plain(line)]
    return "\n".join(lines)
