"""Attacks on an unlearned policy: what could bring a forgotten clip back, a module each, and the verdict from them.

The command is `evidence.py` at the top. Metrics and intervals are in `evaluation`; the page of a run is in `reporting`.
"""
