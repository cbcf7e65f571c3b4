"""Every setting of a run: the dataclasses, their presets and checks, and the flags that commands share.

What a setting does is in the folder that uses it.
"""
