"""Performance tests: acceptance rules with declared error rates, baselines, and trained agents."""
