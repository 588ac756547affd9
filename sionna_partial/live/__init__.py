"""Live coverage: a robot's messages, by DDS, rosbridge or from a recording -> grids for its planner."""
