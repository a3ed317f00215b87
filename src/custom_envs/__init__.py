"""Your environments: one file each, made known here with ``gymnasium.register(...)``."""
