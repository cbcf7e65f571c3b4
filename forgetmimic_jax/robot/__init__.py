"""A robot: its MJCF compiled, and its roles (which body, joint and motor is which) from the YAML beside it.

Clips are in `motion`, simulation is in `physics`.
"""
