"""What a policy can do, clip by clip: rollouts, metrics, statistics, tables, plots and the verdict.

Studies over many runs are in `studies`, the page about one run is in `reporting`.
"""
