"""The configuration of a run: its keys, how it is composed, and how it is read back."""
