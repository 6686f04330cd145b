"""How torch's idle threads wait: import this before torch.

By default they spin for milliseconds after every operation and take the cores from the physics
and from whatever else runs: two training runs on two cores then go ten times slower than one, not
twice. Sleeping at once costs a few microseconds per operation. A setting of the user's is kept.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
