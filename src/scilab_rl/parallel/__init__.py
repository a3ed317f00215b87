"""Training many runs: worker processes of this machine, or jobs of Ray and SLURM."""
