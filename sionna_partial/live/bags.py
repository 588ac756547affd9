"""Recordings of a robot, replayed to a LiveCoverage."""

import os
import time

from sionna_partial.errors import MapError
from sionna_partial.live.topics import Listener
from sionna_partial.maps.bags import GRID, open_recording


def replay(listener: Listener, path: str | os.PathLike[str], rate: float = 0.0) -> None:
    """Hand over the messages of a recording, `rate` times as fast as they came; 0 waits for each map's answer.

    Raises
    ------
    MapError
        If it is no rosbag or damaged, or has no topic of the map.
    """
    with open_recording(path, MapError) as recording:
        recording.topic_of(listener.topics.map, (GRID,))
        start_s = time.monotonic()
        for message in recording.messages(*listener.topics.types()):
            if rate:
                time.sleep(max(0.0, start_s + message.time_s / rate - time.monotonic()))
            listener.take(message.topic, message.content, message.time_s)
            while not rate and listener.live.step():
                pass
