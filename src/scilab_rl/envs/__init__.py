"""Environments: finding them by id, wrapping, vectorising and observing them."""
