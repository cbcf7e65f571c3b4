"""The unlearning methods: one module each, which says where its rule differs from PPO.

A file that is put here is a method; the iteration that they share is in `ppo`.
"""
