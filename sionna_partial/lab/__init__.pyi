"""Data sets of links, training of networks, their evaluation, and reports of it."""

from sionna_partial.lab.datasets.dataset import build_dataset as build_dataset
from sionna_partial.lab.datasets.settings import DatasetSettings as DatasetSettings
from sionna_partial.lab.datasets.shards import read_dataset as read_dataset
from sionna_partial.lab.evaluation import evaluate as evaluate
from sionna_partial.lab.training.predictor import train as train
from sionna_partial.settings import PredictorSettings as PredictorSettings
