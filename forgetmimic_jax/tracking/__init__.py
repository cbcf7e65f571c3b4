"""The tracking task: reference, observation, reward, termination, sampling, wrench, randomisation, environment."""
