"""Figures of merit, baselines and the evaluation of predictors."""
