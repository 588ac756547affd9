"""Figures of results that other packages compute."""

from sionna_partial.plots.coverage_plot import plot_coverage as plot_coverage
from sionna_partial.plots.coverage_plot import plot_network as plot_network
from sionna_partial.plots.exploration_plot import animate_exploration as animate_exploration
from sionna_partial.plots.exploration_plot import plot_exploration as plot_exploration
from sionna_partial.plots.exploration_plot import plot_next_views as plot_next_views
from sionna_partial.plots.report import plot_report as plot_report
from sionna_partial.plots.result_plots import plot_calibration as plot_calibration
from sionna_partial.plots.result_plots import plot_network_placement as plot_network_placement
from sionna_partial.plots.result_plots import plot_placement as plot_placement
from sionna_partial.plots.style import plot_map as plot_map
