"""Proximal policy optimisation: one iteration, as a pure function of one pytree.

The loop around it is in `training`; what an unlearning method changes is in `unlearning`.
"""
