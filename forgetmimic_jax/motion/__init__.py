"""Clips: reading, checking, mirroring, and the library that training reads.

How the shipped clips were made is in `retarget`; the reference of an episode is in `tracking`.
"""
