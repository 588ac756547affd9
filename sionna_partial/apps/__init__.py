"""Programs that run for hours: live coverage for a robot, and a page in the browser."""
