"""Live coverage: messages of a robot by DDS, rosbridge or from a recording -> grids for its planner."""
