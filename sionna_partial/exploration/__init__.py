"""Next views of a robot, and simulated exploration."""
