"""Channels of links: antenna arrays, responses in delay and frequency, beams, spreads, files."""
