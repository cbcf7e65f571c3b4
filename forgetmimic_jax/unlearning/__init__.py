"""Unlearning: the anti-reward, and (later) every baseline as a named bundle of pure functions."""
