"""Motion clips of a robot: reading files, fitting, mirroring, measuring, drawing, and the library that training reads.

How the shipped clips were made from human ones is in `retarget`; the reference of an episode is in `tracking`.
"""
