"""The motion-tracking task: reference, observation, reward, termination, sampling, wrench, randomisation, environment."""
