"""The backend that the README shows fulfils the contract as it stands there, with the contract's own choice of a config."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

from bidnerf_core.testing import BackendContract

README = Path(__file__).parents[2] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
(SOURCE,) = (block for block in BLOCKS if "backend = Fog()" in block)

fog = sys.modules["fog_of_the_readme"] = ModuleType("fog_of_the_readme")
exec(compile(SOURCE, str(README), "exec"), vars(fog))


class TestFog(BackendContract):
    backend = fog.backend
