"""Training: the epoch loop, the one evaluation loop, and what is saved."""
