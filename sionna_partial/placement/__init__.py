"""Where to put a transmitter."""
