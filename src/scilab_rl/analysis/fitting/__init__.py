"""Fitting cognitive models to choices: estimates, comparison of models, recovery, predictions."""
