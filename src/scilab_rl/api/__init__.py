"""What ``import scilab_rl`` offers: training, trained agents, runs and comparisons from Python."""
