"""One seed reaches everything that draws random numbers."""

from __future__ import annotations

import random
import secrets
import sys
import zlib

import numpy as np

MAX_SEED = 2**31 - 1


def resolve_seed(seed: int) -> int:
    """Return the seed itself, or a freshly drawn one for 0 (so that it can be recorded)."""
    return seed if seed != 0 else secrets.randbelow(MAX_SEED - 1) + 1


def derive_seed(seed: int, *purpose: str | int) -> int:
    """Return a seed for one purpose that is unrelated to those of all other purposes.

    Args:
        seed: The seed of the run.
        purpose: For example ``("evaluation", 3)``.
    """
    words = [seed] + [zlib.crc32(str(word).encode()) for word in purpose]
    return int(np.random.SeedSequence(words).generate_state(1)[0] % MAX_SEED)


def seed_everything(seed: int) -> None:
    """Seed Python, NumPy and, when it has been imported, PyTorch."""
    random.seed(seed)
    np.random.seed(seed)
    if "torch" in sys.modules:
        import torch

        torch.manual_seed(seed)
