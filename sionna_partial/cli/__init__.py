"""The command line."""

from sionna_partial.cli.app import app, main

__all__ = ["app", "main"]
