"""The command line, one module a group of verbs."""

from gsx.cli.dispatch import VERBS, main

__all__ = ["VERBS", "main"]
