"""Tracking: one file per place where metrics can go."""
