"""Parsing of command lines: an option given twice is an error, and an unknown option suggests one of like meaning."""

from collections import Counter
from collections.abc import Mapping
from typing import Any, Final, cast

import typer
from typer.core import TyperCommand, TyperGroup

_MEANT: Final[Mapping[str, str]] = {
    "--limit": "--count", "--number": "--count", "--max-count": "--count", "--lines": "--count",
    "--timeout": "--duration", "--seconds": "--duration", "--time": "--duration",
    "--rate": "--max-rate", "--hz": "--max-rate", "--fields": "--field", "--topics": "--topic",
    "--vehicles": "--vehicle", "--id": "--vehicle", "--host": "--connect", "--router": "--connect",
    "--endpoint": "--connect", "--out": "--output", "--file": "--output", "--port": "--http",
}  # fmt: skip
"""The option meant by a name that no command has: other tools call it so."""


# Click's, which newer releases of Typer contain
_UsageError = cast("type[Exception]", typer.BadParameter.__mro__[1])


class _StrictParsing:
    """Reject a repeated option that takes one value: the parser would silently use the last one."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments of a command; raise a usage error, with exit code 2."""
        command: Any = self
        try:
            _, _, parsed = command.make_parser(ctx).parse_args(args=list(args))
            times_of = Counter(parsed)
            for option, times in times_of.items():
                if times > 1 and _takes_one_value(option):
                    text = f"given {times} times, but it takes one value"
                    raise typer.BadParameter(text, ctx=ctx, param=option)
            parsed_args: list[str] = super().parse_args(ctx, args)  # type: ignore[misc] # of the command
        except _UsageError as exc:
            name = getattr(exc, "option_name", "")
            meant = _MEANT.get(name)
            known = set[str]()
            for option in command.get_params(ctx):
                known.update(option.opts)
            if meant in known:
                exc.possibilities = [meant]  # type: ignore[attr-defined] # of an unknown option
            raise
        return parsed_args


def _takes_one_value(option: Any) -> bool:
    if option.param_type_name != "option":
        return False
    return not option.multiple and not option.is_flag


class Command(_StrictParsing, TyperCommand):
    """A command with strict parsing."""


class Group(_StrictParsing, TyperGroup):
    """A group of commands with strict parsing of its own options."""
