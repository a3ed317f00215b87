"""Frames and metrics, side by side."""
