"""ForgetMimic-JAX: make a humanoid's motion-tracking policy forget chosen motions, and show that it did."""

import os

# XLA's CPU thread pool can deadlock on the vmapped MJX step when cores are few; without this pool inside one
# operation it does not. A user's own choice for the flag stands. It must be set before JAX first starts.
_FLAG = "--xla_cpu_multi_thread_eigen"
if _FLAG not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_FLAG}=false".strip()
