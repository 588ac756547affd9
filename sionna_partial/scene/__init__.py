"""Partial maps as Mitsuba scenes: wall outlines, XML and PLY."""
