"""Metrics: recorded by algorithms, kept in one store, judged by pure functions."""
