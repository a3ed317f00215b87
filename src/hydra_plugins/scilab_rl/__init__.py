"""Adapters through which Hydra discovers our sweeper and launchers."""
