from .poses import find_poses as find_poses
from .record import FoundPoses as FoundPoses
from .sources import photos_of as photos_of
from .sources import refuse_panoramas as refuse_panoramas
