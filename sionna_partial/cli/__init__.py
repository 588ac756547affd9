"""The command line."""

import sys

from sionna_partial.process import signals_held

try:
    with signals_held():
        from sionna_partial.cli.app import app, main
except KeyboardInterrupt:  # earlier than `main`, which takes it from then on
    print("interrupted", file=sys.stderr)
    raise SystemExit(130) from None

__all__ = ["app", "main"]
