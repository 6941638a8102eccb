"""Examples of generated code in docstrings, for tests that compare them with what is compiled."""

import inspect
import re
import textwrap


def printed_block(documented: object) -> str:
    """Return the indented block of a docstring."""
    lines = (inspect.getdoc(documented) or "").splitlines()
    return textwrap.dedent("\n".join(line for line in lines if line.startswith("    ")))


def printed_line(documented: object) -> str:
    """Return the indented block of a docstring, which shows one line of code in several, as one line."""
    line = " ".join(printed_block(documented).split())
    return line.replace("( ", "(")


def printed_inline(documented: object) -> str:
    """Return the last text in backticks in a docstring."""
    inline: list[str] = re.findall(r"`([^`]+)`", inspect.getdoc(documented) or "")
    return inline[-1]
