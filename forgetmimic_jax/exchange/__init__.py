"""Policies in other projects' formats: ONNX out and in, rsl_rl in, and an ONNX policy at work in plain MuJoCo."""
