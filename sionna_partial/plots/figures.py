"""What all figures share: the colours of link states, and files that are equal for equal figures."""

import io

from matplotlib.figure import Figure

from sionna_partial.constants import LinkState

YELLOW, RED, BLUE = "#ddaa33", "#bb5566", "#004488"
"""Paul Tol's high-contrast colours: told apart with any colour vision and in grey."""

STATE_COLOURS = {LinkState.LOS: YELLOW, LinkState.NLOS: RED, LinkState.OUTAGE: BLUE}
"""The better the link, the brighter."""


def figure_png(figure: Figure) -> bytes:
    """Return a figure as a PNG file; equal figures give equal bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
