"""Performance tests: acceptance rules with declared error rates, and baselines."""
