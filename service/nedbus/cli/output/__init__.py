"""Output of commands: samples, tables, progress and the log, for a terminal, a pipe or a program."""

from typing import Literal

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]
