"""Policies that come from other projects or go to a robot: ONNX, rsl_rl, and the closed loop in plain MuJoCo.

The project's own checkpoints are in `training`.
"""
