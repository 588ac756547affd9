"""Channels of links: responses of antenna arrays, beams, spreads, files."""
