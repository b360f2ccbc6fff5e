"""XFeat, a learned keypoint detector, for bidnerf's landmarks."""
