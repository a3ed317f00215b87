"""Hyperparameter optimisation made for noisy reinforcement learning, on Optuna's ask and tell."""
