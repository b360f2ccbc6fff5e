"""XFeat, a learned detector of keypoints, for the landmarks of bidnerf."""
