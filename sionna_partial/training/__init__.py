"""Train and fit what predicts: networks on data sets, the path model, walls that were not seen."""
