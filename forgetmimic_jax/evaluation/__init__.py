"""What a policy can do, clip by clip: rollouts, metrics, intervals, tables and plots."""
