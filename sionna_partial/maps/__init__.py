"""Partial maps of buildings: PartialMap, its files, ROS maps, arrays, and meshes; `importers` for other formats."""
