"""Algorithms: one file each, and what it takes to build any of them from a configuration."""
