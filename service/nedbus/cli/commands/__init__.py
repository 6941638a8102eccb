"""The commands, a file for each or for a family of them; `nedbus.cli.app` lists them all."""
