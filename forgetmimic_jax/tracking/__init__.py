"""The tracking task: reference, observation, reward, termination, starts, wrench, randomisation, environment.

How a policy learns it is in `ppo`; how clips become a library is in `motion`.
"""
