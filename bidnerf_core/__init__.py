"""The core of bidnerf: what a radiance field is, what a map is, and how a pose is found and judged.

Users import ``bidnerf``. Authors of plugins import the packages in here: ``bidnerf_core.backend`` for backends, and the
package that owns each other name.
"""

import os

# Waiting OpenMP threads should sleep, not spin: on cores shared with other work, spinning made training more than ten
# times slower. The variable must be set before torch is loaded; a value set by the user is kept.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
