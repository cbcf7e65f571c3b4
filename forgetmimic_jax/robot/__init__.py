"""A robot: its MJCF compiled, and its roles, motors and names from the YAML beside it.

Clips are in `motion`, simulation is in `physics`.
"""
