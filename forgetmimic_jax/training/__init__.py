"""A run: what it starts from, its loop, its log, its folder and its checkpoints; distillation and the search.

One iteration of learning is in `ppo`; what a policy can do is measured in `evaluation`.
"""
