from .poses import find_poses as find_poses
from .record import FoundPoses as FoundPoses
from .sources import lacks_poses as lacks_poses
