"""What a policy can do, clip by clip: rollouts, metrics, intervals, evaluation.json, tables and plots.

The page of the report command is in `reporting`; runs and their checkpoints are in `training`.
"""
