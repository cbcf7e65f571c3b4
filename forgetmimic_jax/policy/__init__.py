"""A policy: actor, critic and their observation normalisers, as one value.

How it learns is in `ppo`, how it is stored is in `training`.
"""
