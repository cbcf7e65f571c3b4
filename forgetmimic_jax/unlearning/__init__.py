"""Unlearning methods: one module each, a small bundle of pure functions that says where it differs from PPO."""
