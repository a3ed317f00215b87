"""Small tasks to begin one's own from: ``scilab-rl new environment NAME --from minimal``."""
