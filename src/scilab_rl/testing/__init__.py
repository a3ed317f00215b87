"""Tools to test an algorithm: tiny environments, and a contract test for any algorithm.

Importing this package registers the environments, so that they can be made from the command line
too: ``env=scilab_rl.testing:TinyReach-v0``. The contract test is in
    ``scilab_rl.testing.algorithms``.
"""

from scilab_rl.testing.environments import TINY_ENVIRONMENTS, decode_frame, register

__all__ = ["TINY_ENVIRONMENTS", "decode_frame", "register"]

register()
