"""Worlds to learn from: homes, large buildings, robots and cameras that explore them."""
