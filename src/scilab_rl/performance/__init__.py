"""Tests that guard learning: gates with declared error rates, baselines, and comparisons."""
