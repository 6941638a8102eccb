"""Output of commands: samples, tables, progress and the log, for a terminal, a pipe or a program."""
