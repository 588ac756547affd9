"""Channels of links: responses of antenna arrays, beams, spreads, files."""

from sionna_partial.channels.files import load_channels as load_channels
from sionna_partial.channels.files import save_channels as save_channels
from sionna_partial.channels.samples import sample_channels as sample_channels
from sionna_partial.tracing.antennas import dft_codebook as dft_codebook
