"""Many unlearning runs that differ in one thing: trials, one JSON, a page with its claims, and a figure.

The studies, of the paper and ours, are in `experiments/`, a file each; a single run is in `training`.
"""
