"""Proximal policy optimisation on one pytree."""
