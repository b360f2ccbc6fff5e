from .lidar import LidarDepth as LidarDepth
