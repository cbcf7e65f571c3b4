"""Motion clips: reading, retargeting to a robot, checking, and the library the training reads."""
