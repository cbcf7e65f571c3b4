"""Many unlearning runs that differ in one thing, and one JSON of what came out. The studies are in `experiments/`.

A single run is in `training`.
"""
