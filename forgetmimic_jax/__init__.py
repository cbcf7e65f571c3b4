"""ForgetMimic-JAX: make a humanoid's motion-tracking policy forget chosen motions, and show that it did."""
