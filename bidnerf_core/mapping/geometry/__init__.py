"""Unknown points that images see: triangulation, and bundle adjustment of the points together with the poses."""
