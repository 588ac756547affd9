"""From homes to a trained and judged predictor: links of many homes, shards, training, evaluation."""
