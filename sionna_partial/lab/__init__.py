"""Data sets of links, training of networks, their evaluation, and reports of it."""
