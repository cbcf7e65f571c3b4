"""What a policy can do, clip by clip: rollouts, metrics, intervals, evaluation.json, tables, plots and the verdict.

The page of the report command is in `reporting`; runs and their checkpoints are in `training`.
"""
