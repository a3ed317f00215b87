"""Rewards that an agent gives itself, to be combined with any algorithm: one file each.

``algorithm.intrinsic=rnd`` switches one on, ``algorithm.intrinsic={name: rnd, weight: 0.5}`` with
settings. It works with ``cleansac``, ``cleanppo`` and all off-policy algorithms of
Stable-Baselines3 and sb3-contrib, hindsight replay included; see `build` for how.

Your own is a subclass of `base.IntrinsicReward` in ``src/custom_algorithms/my_curiosity.py``, used
with ``algorithm.intrinsic=custom_algorithms.my_curiosity.MyCuriosity``.
"""
