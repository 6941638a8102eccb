"""Markdown of the generated pages: tables, sections, and text from docstrings."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table, or an empty string without rows."""
    lines = [" | ".join(cells) for cells in rows]
    if not lines:
        return ""
    lines = [" | ".join(head), " | ".join(["---"] * len(head)), *lines]
    return "\n".join(f"| {line} |" for line in lines)


def section(title: str, *parts: str, level: int = 2) -> str:
    """Return a heading with its content, or an empty string without content."""
    below = [part for part in parts if part]
    return "\n\n".join([f"{'#' * level} {title}", *below]) if below else ""


def page(title: str, *parts: str) -> str:
    """Return the text of a page."""
    return "\n\n".join([f"# {title}", *(part for part in parts if part)]) + "\n"


def cell(text: object) -> str:
    """Return text as a table cell."""
    return plain(" ".join(str(text).split())).replace("|", "\\|")


def code(text: object) -> str:
    """Return text as code in a table cell, or an empty string."""
    shown = str(text).replace("|", "\\|")
    return f"`{shown}`" if shown else ""


def plain(text: str) -> str:
    """Escape HTML, emphasis and links outside of code."""
    parts = re.split(r"(`[^`\n]*`)", text)
    special = r"([<*\[\]]|(?<!\w)_|_(?!\w))"
    return "".join(
        part if number % 2 else re.sub(special, r"\\\1", part) for number, part in enumerate(parts)
    )


def docstring(text: str | None) -> str:
    """Convert a docstring to Markdown: lines that start with a name become list items, indented lines are kept."""
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
